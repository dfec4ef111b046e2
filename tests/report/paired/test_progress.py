"""The gain that a doubling of the steps brings."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy.stats import linregress

from romnav.report.paired.progress import slope


def test_slope_is_the_regression_on_the_logarithm_of_steps() -> None:
    rng = np.random.default_rng(0)
    steps, rate = np.geomspace(1e6, 3e8, 9), rng.uniform(20, 90, 9)
    assert math.isclose(slope([_run(steps, rate)], "rate"), linregress(np.log2(steps), rate).slope)
    assert math.isclose(slope([_run([1e6, 4e6], [50.0, 62.0])], "rate"), 6.0)
    assert math.isnan(slope([_run([1e6], [50.0])], "rate"))


def test_a_seed_that_is_behind_bends_no_slope() -> None:
    ahead, behind = _run([1e6, 2e6], [90.0, 92.0]), _run([1e6], [50.0])
    assert math.isclose(slope([ahead, behind], "rate"), 2.0)
    steps, rates = np.geomspace(1e6, 1e8, 5), np.random.default_rng(1).uniform(20, 90, (2, 5))
    # an intercept for each run, by the normal equations
    design = np.kron(np.eye(2), np.ones((5, 1)))
    design = np.column_stack([np.tile(np.log2(steps), 2), design])
    expected = np.linalg.lstsq(design, rates.ravel())[0][0]
    assert math.isclose(slope([_run(steps, rate) for rate in rates], "rate"), expected)


def _run(steps: ArrayLike, rate: ArrayLike) -> pd.DataFrame:
    return pd.DataFrame({"steps": np.asarray(steps), "rate": np.asarray(rate)})
