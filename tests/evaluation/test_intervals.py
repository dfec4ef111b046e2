"""Resampling, Wilson's interval and McNemar's test against SciPy and closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.stats
from hypothesis import given, settings
from hypothesis import strategies as st

from romnav.evaluation.intervals import mcnemar_mid_p, resampled_sums, wilson


def test_resampled_sums_have_the_moments_of_the_bootstrap() -> None:
    values = np.random.default_rng(0).normal(size=(2, 50))
    sums = resampled_sums(values, 20_000)
    np.testing.assert_allclose(sums.mean(1), values.sum(1), atol=5 * np.sqrt(50 / 20_000))
    np.testing.assert_allclose(np.cov(sums), 50 * np.cov(values, ddof=0), rtol=0.05, atol=1)


@given(st.integers(1, 300), st.integers(0, 10), st.integers(1, 300))
@settings(max_examples=25, deadline=None)
def test_a_resample_draws_as_many_units_as_there_are(n: int, seed: int, resamples: int) -> None:
    np.testing.assert_array_equal(resampled_sums(np.ones(n), resamples, seed), np.full(resamples, n))
    units = resampled_sums(np.eye(n), resamples, seed)
    assert (units >= 0).all()
    np.testing.assert_array_equal(units, np.rint(units))
    np.testing.assert_array_equal(resampled_sums(np.eye(n), resamples + 200, seed)[:, :resamples], units)


@given(st.integers(0, 200), st.integers(0, 200))
def test_mcnemar_mid_p(b: int, c: int) -> None:
    n, k = b + c, min(b, c)
    expected = scipy.stats.binomtest(k, n).pvalue - scipy.stats.binom.pmf(k, n, 0.5) if n else 1.0
    if b == c:
        expected = 1.0  # the two tails meet in the middle
    assert mcnemar_mid_p(b, c) == pytest.approx(expected, abs=1e-12)
    assert mcnemar_mid_p(b, c) == mcnemar_mid_p(c, b)


@given(st.integers(1, 2000), st.data())
def test_wilson(n: int, data: st.DataObject) -> None:
    k = data.draw(st.integers(0, n))
    theirs = scipy.stats.binomtest(k, n).proportion_ci(method="wilson")
    assert wilson(k, n) == pytest.approx((theirs.low, theirs.high), abs=1e-12)


def test_wilson_of_nothing_is_nan() -> None:
    assert all(map(math.isnan, wilson(0, 0)))
