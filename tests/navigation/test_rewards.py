from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from romnav.navigation.rewards import TERMS, Transition, progress, terms, weights
from romnav.navigation.spec import RewardSpec

PERIOD = 0.2

PAPER = {
    "position": 0.2,
    "heading": 0.2,
    "height": 0.2,
    "stand": 0.2,
    "geodesic_progress": 0.1,
    "height_progress": 0.1,
    "collision": -1.0,
    "action_rate": -0.01,
}
"""Weights of Table I, before the switch."""


def value(name: str, spec: RewardSpec | None = None, **changes: object) -> float:
    """One term of a robot that stands far off, touches nothing and makes no progress, but for ``changes``."""
    far: dict[str, object] = {
        "planar": 20.0,
        "geodesic": 20.0,
        "best_geodesic": 20.0,
        "heading_error": math.pi,
        "height_error": 8.0,
        "best_height_error": 8.0,
        "command": [0.0, 0.0, 0.0],
        "previous": [0.0, 0.0, 0.0],
        "contacts": 0.0,
    }
    transition = Transition(**{k: torch.tensor([v]) for k, v in {**far, **changes}.items()})
    return terms(transition, spec or RewardSpec(), PERIOD)[name].item()


def test_table_weights() -> None:
    assert weights(RewardSpec(scale=1.0), 0.0) == PAPER
    assert set(PAPER) == set(TERMS)


@pytest.mark.parametrize(("done", "expected"), [(0.0, -0.01), (0.4999, -0.01), (0.5, -0.1), (1.0, -0.1)])
def test_action_rate_weight_switches_half_way(done: float, expected: float) -> None:
    assert weights(RewardSpec(scale=1.0), done)["action_rate"] == expected


@pytest.mark.parametrize(("late", "expected"), [(None, (-0.1, -0.1)), (-1.0, (-0.1, -1.0))])
def test_collision_weight_switches_with_it_where_asked(late: float | None, expected: tuple[float, float]) -> None:
    spec = RewardSpec(scale=1.0, collision=-0.1, collision_late=late)
    assert tuple(weights(spec, done)["collision"] for done in (0.49, 0.5)) == expected


@pytest.mark.parametrize("planar", [0.0, 0.1, 0.5, 1.9])
def test_position(planar: float) -> None:
    expected = 1 + math.exp(-(planar**2) / 0.25) + math.exp(-(planar**2) / 0.01)
    assert value("position", planar=planar, geodesic=1.9) == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("error", [0.0, -0.5, 3.0])
def test_heading(error: float) -> None:
    assert value("heading", heading_error=error, geodesic=0.5) == pytest.approx(math.exp(-(error**2) / 0.25), rel=1e-5)


@pytest.mark.parametrize("height", [0.0, 0.5, 4.0])
def test_height_pays_without_gate(height: float) -> None:
    expected = math.exp(-(height**2) / 6.25) + math.exp(-(height**2) / 0.25)
    assert value("height", height_error=height) == pytest.approx(expected, rel=1e-5)


def test_stand_pays_for_zero_command() -> None:
    assert value("stand", geodesic=1.0) == pytest.approx(1.0)
    assert value("stand", geodesic=1.0, command=[0.1, 0.0, 0.0]) == pytest.approx(math.exp(-1), rel=1e-5)


@pytest.mark.parametrize("name", ["position", "heading", "stand"])
def test_gate_closes_at_two_metres_of_geodesic(name: str) -> None:
    at_goal = {"planar": 0.0, "heading_error": 0.0}
    assert value(name, geodesic=1.99, **at_goal) > 0.9
    # a goal one floor up is near in the plane and far by foot
    assert value(name, geodesic=2.0, **at_goal) == 0.0


def test_geodesic_progress() -> None:
    full = RewardSpec().progress_speed * PERIOD
    assert value("geodesic_progress", geodesic=20.0 - full / 2) == pytest.approx(0.5, rel=1e-3)
    assert value("geodesic_progress", geodesic=20.0 - 2 * full) == 1.0
    # near the goal the full reward takes 80 % of what is left
    assert value("geodesic_progress", best_geodesic=0.1, geodesic=0.06) == pytest.approx(0.5, rel=1e-4)


def test_height_progress() -> None:
    full = RewardSpec().climb_speed * PERIOD
    assert value("height_progress", height_error=8.0 - full / 4) == pytest.approx(0.25, rel=1e-3)
    assert value("height_progress", height_error=9.0) == 0.0


@given(st.lists(st.floats(0.0, 30.0), min_size=2, max_size=60))
def test_circling_earns_no_progress(distances: list[float]) -> None:
    """The best-so-far gate bounds the sum of progress by the net gain, however the robot wanders."""
    full, best, total = 0.15, distances[0], 0.0
    for now in distances[1:]:
        total += progress(torch.tensor([best]), torch.tensor([now]), full).item() * full
        best = min(best, now)
    assert total <= distances[0] - min(distances) + 1e-3


def test_collision_counts_bodies() -> None:
    assert value("collision", contacts=3.0) == 3.0


def test_action_rate() -> None:
    change = value("action_rate", command=[1.0, 0.0, -1.0], previous=[0.5, 0.25, 0.0])
    assert change == pytest.approx(0.25 + 0.0625 + 1.0)
