from __future__ import annotations

import numpy as np
import pytest

from romnav.evaluation.difficulty import Goals, draw_goals, measure, tally
from romnav.evaluation.spec import EvaluationSpec
from romnav.navigation.spec import EnvSpec
from romnav.world.build import build
from romnav.world.geodesic import fields
from romnav.world.spec import SamplerSpec, WorldSpec
from romnav.world.world import World

CLASSES = ("building", "outdoor", "room")


@pytest.fixture(scope="module")
def world() -> World:
    """A world of a side that no scale has."""
    return build(WorldSpec(tiles=3, side=24.0, seed=3, goals_per_tile=8, classes=CLASSES))


def test_shares_are_counted_by_hand() -> None:
    goals = Goals(
        geodesic=np.array([10.0, 20.0, 31.0, 50.0, 5.0]),
        climb=np.array([0.0, 3.5, 7.6, 1.0, 0.2]),
        cross=np.array([False, True, True, True, False]),
        on_connector=np.array([True, False, False, False, False]),
    )
    third = pytest.approx(1 / 3)
    assert goals.shares() == {
        "mean_geodesic": pytest.approx(23.2),
        "cross_share": 0.6,
        "storey_share": pytest.approx(2 / 3),
        "two_storey_share": third,
        "beyond_30": pytest.approx(2 / 3),
        "beyond_45": third,
        "on_connector": 0.2,
    }


def test_shares_of_no_goals_across_levels_are_zero() -> None:
    one = np.ones(1)
    shares = Goals(one, 0 * one, np.array([False]), np.array([False])).shares()
    assert [shares[k] for k in ("cross_share", "storey_share", "beyond_30")] == [0.0, 0.0, 0.0]


def test_draws_are_what_the_sampler_promises(world: World) -> None:
    specs = [SamplerSpec(cap=cap, max_distance=12.0) for cap in ("geodesic", "euclidean")]
    capped, free = (draw_goals(world, spec, 3000) for spec in specs)
    # beyond the cap lie only the goals of cells that have none within it
    lone, stairs = [], []
    for t, grids in enumerate(world.grids):
        goals = world.goal[world.goal_start[t] : world.goal_start[t + 1]] - world.node_start[t]
        lone.append((fields(grids, goals.numpy()).min(axis=0) > 12 * 256).mean())
        stairs.append(int(world.spawn_start[t + 1] - world.spawn_start[t]) / len(grids.position))
    assert (capped.geodesic > 12.0).mean() == pytest.approx(np.mean(lone), abs=0.03)
    assert (free.geodesic > 12.0).mean() > np.mean(lone) + 0.1
    assert np.array_equal(capped.cross, capped.climb > 0.5)
    assert capped.on_connector.mean() == pytest.approx(np.mean(stairs), abs=0.02)
    # starts are uniform whatever the share of stairs
    again = draw_goals(world, SamplerSpec(max_distance=12.0, stair_probability=0.0), 3000)
    assert np.array_equal(again.geodesic, capped.geodesic)


def test_the_oracle_arrives_in_the_time_of_the_path_and_straight_arms_mostly_do_not(world: World) -> None:
    samplers = {"a": SamplerSpec(), "b": SamplerSpec(cap="euclidean")}
    measured = measure(world, samplers, EnvSpec(), EvaluationSpec())
    assert list(measured.goals) == ["a", "b"]
    mean = measured.goals["a"].shares()["mean_geodesic"]
    assert measured.oracle_t2g is not None
    assert mean - 1.5 < measured.oracle_t2g < 1.5 * mean + 2.0  # at up to 1 m/s, and turning
    assert measured.straight_sr_120_same is not None
    assert 10.0 < measured.straight_sr_120_same < 90.0


def test_a_world_is_tallied(world: World) -> None:
    told = tally(world)
    assert told["tiles"] == {"building": 1, "outdoor": 1, "room": 1}
    assert told["solids"] == sum(len(tile.solids) for tile in world.tiles)
    assert told["nodes"] == sum(len(g.position) for g in world.grids)
    assert told["goals"] == 24
    assert told["draws_per_tile"] >= 1.0
    assert told["build_s"] > 0.0
    assert told["memory_mb"] > 2 * 2e-6 * 8 * told["nodes"] / 3
