"""The gain that a doubling of the steps brings."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
from scipy.stats import linregress

from romnav.report.paired.progress import slope


def test_slope_is_the_regression_on_the_logarithm_of_steps() -> None:
    rng = np.random.default_rng(0)
    steps, rate = np.geomspace(1e6, 3e8, 9), rng.uniform(20, 90, 9)
    assert math.isclose(slope(pd.Series(steps), pd.Series(rate)), linregress(np.log2(steps), rate).slope)
    assert math.isclose(slope(pd.Series([1e6, 4e6]), pd.Series([50.0, 62.0])), 6.0)
    assert math.isnan(slope(pd.Series([1e6]), pd.Series([50.0])))
