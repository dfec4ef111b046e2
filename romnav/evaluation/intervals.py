"""How sure a number is: bootstrap sums, Wilson's interval and McNemar's test."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from romnav.threads import cores

FEWEST = 6
"""Units of which an interval can be told: of fewer, a sign test at 5 % proves nothing even if all of them agree."""
_BLOCK = 128  # resamples at a time: their counts stay in the cache


def resampled_sums(values: NDArray, resamples: int, seed: int = 0) -> NDArray:
    """Sums over units drawn with replacement, the same draws for every quantity.

    Args:
        values: Values per unit, shape (..., n).
        resamples: Number of resamples of n units each.
        seed: Seed; block k of the resamples has the stream (seed, k), so more resamples extend fewer.

    Returns:
        Sums, shape (..., resamples). Values are rounded to single precision; counts are summed exactly.
    """
    n = values.shape[-1]
    flat = values.reshape(-1, n).astype(np.float32)
    offsets = n * np.arange(_BLOCK)[:, None]

    def block(k: int) -> NDArray:
        stream = np.random.Generator(np.random.SFC64(np.random.SeedSequence(seed, spawn_key=(k,))))
        drawn = stream.integers(0, n, (_BLOCK, n), dtype=np.uint16 if n <= 2**16 else np.uint32)
        counts = np.bincount((drawn + offsets).ravel(), minlength=_BLOCK * n).reshape(_BLOCK, n)
        return flat @ counts.T.astype(np.float32)

    with ThreadPoolExecutor(cores()) as pool:
        sums = np.concatenate(list(pool.map(block, range(-(-resamples // _BLOCK)))), axis=1)
    return sums[:, :resamples].reshape(*values.shape[:-1], resamples).astype(float)


def percentile_interval(draws: NDArray, units: int, confidence: float = 0.95) -> tuple[float, float]:
    """Interval of a statistic from its values in resamples of ``units``, those in which it exists.

    NaN where there are fewer than `FEWEST` units: of a few that agree every resample agrees, which proves nothing.
    """
    draws = draws[np.isfinite(draws)]
    if units < FEWEST or not len(draws):
        return math.nan, math.nan
    lo, hi = np.percentile(draws, (50 * (1 - confidence), 50 * (1 + confidence)))
    return float(lo), float(hi)


def mcnemar_mid_p(a_only: int, b_only: int) -> float:
    """Two-sided exact McNemar test with the mid-p correction (Fagerland et al. 2013).

    Args:
        a_only: Pairs in which only a succeeded.
        b_only: Pairs in which only b succeeded.
    """
    n, k = a_only + b_only, min(a_only, b_only)
    term, below = 1, 0  # binomial coefficient of n over i, and the sum of those before
    for i in range(k):
        below += term
        term = term * (n - i) // (i + 1)
    return (2 * below + term) / 2**n


def wilson(successes: int, n: int, confidence: float = 0.95) -> tuple[float, float]:
    """Wilson score interval of a proportion (Wilson 1927), in 0..1; NaN where n is zero."""
    if n == 0:
        return math.nan, math.nan
    z = NormalDist().inv_cdf(0.5 + confidence / 2)
    p, shrink = successes / n, 1 + z * z / n
    centre = (p + z * z / (2 * n)) / shrink
    half = z / shrink * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    return max(0.0, centre - half), min(1.0, centre + half)
