from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from romnav.evaluation.paired import metrics, rows
from romnav.evaluation.spec import HORIZONS


def columns(**changes: object) -> dict[str, np.ndarray]:
    """Four episodes: solved at 30 s, solved at 100 s, a fall, a timeout."""
    base: dict[str, object] = {
        "level": ["same", "cross", "cross", "same"],
        "geodesic": [10.0, 20.0, 10.0, 8.0],
        "success_time": [30.0, 100.0, np.nan, np.nan],
        "outcome": ["success", "success", "fall", "timeout"],
        "path_length": [10.0, 40.0, 5.0, 45.0],
        "final_distance": [0.2, 0.4, 5.0, 12.0],
        "collisions": [0, 3, 1, 6],
        "where": ["", "", "on a stair", "same level"],
        "how": ["", "", "fell", "circled"],
    }
    return {name: np.array(value) for name, value in {**base, **changes}.items()}


def test_by_hand() -> None:
    m = metrics.evaluate(columns())
    assert m["sr_45"] == 25
    assert m["sr_120"] == 50
    assert m["t2g"] == 65
    assert m["rmt"] == (30 + 100 + 120 + 120) / 4
    assert m["spl"] == (1 + 0.5) / 4
    assert m["soft_spl"] == pytest.approx(((1 - 0.02) + (1 - 0.02) * 0.5 + 0.5 + 0) / 4)
    assert m["falls"] == 25
    assert m["timeouts"] == 25
    assert m["collisions"] == pytest.approx(10.0)
    assert (m["circled"], m["pressed"], m["on_stair"], m["no_stair"]) == (25, 0, 25, 0)


def test_by_level() -> None:
    same, cross = metrics.evaluate(columns(), "same"), metrics.evaluate(columns(), "cross")
    assert (same["sr_45"], same["sr_120"], same["timeouts"], same["falls"]) == (50, 50, 50, 0)
    assert (cross["sr_45"], cross["sr_120"], cross["timeouts"], cross["falls"]) == (0, 50, 0, 50)


def test_nothing_to_average_is_nan() -> None:
    never = columns(success_time=[np.nan] * 4, outcome=["fall"] * 4, level=["same"] * 4)
    assert math.isnan(metrics.evaluate(never)["t2g"])
    assert all(math.isnan(value) for value in metrics.evaluate(never, "cross").values())


def test_success_counts_up_to_the_horizon_itself() -> None:
    assert metrics.evaluate(columns(success_time=[45.0, 120.0, np.nan, np.nan]))["sr_45"] == 25
    assert metrics.evaluate(columns(success_time=[45.2, 120.0, np.nan, np.nan]))["sr_45"] == 0


def test_a_goal_at_the_spawn_divides_by_nothing() -> None:
    m = metrics.evaluate(columns(geodesic=[0.0] * 4, path_length=[0.0, 0.0, 0.0, 4.0], final_distance=[0.0, 0.1, 9, 9]))
    assert m["spl"] == 0.5
    assert m["soft_spl"] == pytest.approx((1 + 0.8) / 4)


def test_an_unreachable_end_is_no_progress() -> None:
    assert metrics.evaluate(columns(final_distance=[np.inf] * 4))["soft_spl"] == 0


@given(st.integers(1, 40), st.integers(0, 2**32 - 1), st.floats(0, 1))
def test_bounds_and_order(n: int, seed: int, skill: float) -> None:
    rng = np.random.default_rng(seed)
    solved = rng.random(n) < skill
    sample = columns(
        level=np.where(rng.random(n) < 0.5, "same", "cross"),
        geodesic=rng.uniform(0, 30, n) * (rng.random(n) < 0.9),
        success_time=np.where(solved, rng.uniform(0, 120, n), np.nan),
        outcome=np.where(solved, "success", rng.choice(["fall", "timeout"], n)),
        path_length=rng.uniform(0, 60, n),
        final_distance=rng.uniform(0, 40, n),
        collisions=rng.poisson(2, n),
        where=np.where(solved, "", rng.choice(rows.WHERE, n)),
        how=np.where(solved, "", rng.choice(rows.HOW, n)),
    )
    m = metrics.evaluate(sample)
    assert 0 <= m["sr_45"] <= m["sr_120"] <= 100
    assert m["sr_120"] + m["falls"] + m["timeouts"] == pytest.approx(100)
    assert 0 <= 100 * m["spl"] <= m["sr_120"] * (1 + 1e-12)
    assert 0 <= m["soft_spl"] <= 1
    assert m["rmt"] <= 120
    if solved.any():
        assert m["t2g"] <= m["rmt"] + 1e-9
    else:
        assert math.isnan(m["t2g"])
        assert m["rmt"] == 120
    order = rng.permutation(n)
    shuffled = metrics.evaluate({name: column[order] for name, column in sample.items()})
    assert m == pytest.approx(shuffled, nan_ok=True)


def test_every_metric_names_known_quantities() -> None:
    known = metrics.quantities(columns())
    assert all({m.numerator, m.denominator} <= set(known) for m in metrics.METRICS.values())
    assert {f"sr_{h}" for h in HORIZONS} <= set(metrics.METRICS)
