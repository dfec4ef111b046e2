from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict

from romnav.evaluation import episodes
from romnav.evaluation.episodes import EpisodeSet
from romnav.evaluation.paired import run as paired_run
from romnav.evaluation.paired.run import run
from romnav.evaluation.rollout import Driver, Oracle, Policy, Straight, View, step_limit
from romnav.evaluation.spec import EpisodeSetSpec, EvaluationSpec
from romnav.navigation.ppo import make_actor
from romnav.navigation.spec import EnvSpec, PolicySpec
from romnav.world.build import build
from romnav.world.spec import SamplerSpec, WorldSpec
from romnav.world.world import World
from tests.navigation.conftest import TOKENS, FakePerception

SPEC = EpisodeSetSpec(
    world=WorldSpec(tiles=8, seed=51, goals_per_tile=16),
    episodes=160,
    cross=80,
    sampler=SamplerSpec(stair_probability=0.0),
)


@pytest.fixture(scope="module")
def world() -> World:
    return build(SPEC.world)


@pytest.fixture(scope="module")
def paired(world: World) -> EpisodeSet:
    return episodes.draw("test", SPEC, world)


def policy() -> Policy:
    torch.manual_seed(0)
    obs = TensorDict({"lidar": torch.zeros(1, *TOKENS), "state": torch.zeros(1, 9)}, batch_size=[1])
    return Policy(make_actor(obs, PolicySpec(attention=16, recurrent=16)), FakePerception())


def test_a_policy_with_its_own_encoder_is_shown_images() -> None:
    driver = policy()
    assert not driver.perception.images
    driver.actor.encoder = driver.perception.encoder
    assert Policy(driver.actor, driver.perception).perception.images


def test_oracle_reaches_nearly_every_goal_by_nearly_the_shortest_path(world: World, paired: EpisodeSet) -> None:
    out = run(Oracle(), world, paired, EnvSpec(), EvaluationSpec())
    success = out["outcome"] == "success"
    geodesic = paired.columns["geodesic"]
    spl = np.mean(success * geodesic / np.maximum(geodesic, out["path_length"]))
    assert success.mean() >= 0.99
    assert spl >= 0.95
    # it can be no shorter than the geodesic but for the radius of arrival and the lattice
    assert (out["path_length"][success] >= 0.97 * geodesic[success] - 0.75).all()
    assert (out["success_time"][success] >= out["path_length"][success] / np.hypot(1.0, 0.25) - 0.2).all()
    assert np.nanmax(out["success_time"]) <= 45.0


def test_straight_is_the_lower_bound(world: World, paired: EpisodeSet) -> None:
    straight = run(Straight(), world, paired, EnvSpec(), EvaluationSpec())["outcome"] == "success"
    assert straight[~paired.cross].mean() > 0.25  # some goals lie in plain sight
    assert straight[paired.cross].mean() < 0.3


def test_two_evaluations_give_the_same_rows_at_any_thread_count(world: World, paired: EpisodeSet) -> None:
    threads = torch.get_num_threads()
    short = EvaluationSpec(duration=20.0)
    try:
        runs = []
        for count in (1, 1, 2):
            torch.set_num_threads(count)
            runs.append(run(policy(), world, paired, EnvSpec(), short))
    finally:
        torch.set_num_threads(threads)
    for other in runs[1:]:
        for key, column in runs[0].items():
            assert np.array_equal(column, other[key], equal_nan=column.dtype.kind == "f"), key


def test_memory_follows_its_episode_when_finished_ones_are_dropped(world: World, paired: EpisodeSet) -> None:
    """Dropping rows must not change what the remaining ones do."""

    half = torch.arange(0, 160, 2)
    view, part = View(world, paired, EnvSpec()), View(world, paired, EnvSpec())
    whole_driver, part_driver = policy(), policy()
    for step in range(20):
        if step == 5:
            part.select(half)
            part_driver.select(half)
        for v, d in ((view, whole_driver), (part, part_driver)):
            with torch.inference_mode():
                command = d.command(v)
            v.robot.step(command)
            v.previous, v.step = command, step + 1
    torch.testing.assert_close(view.robot.position[half], part.robot.position, atol=1e-4, rtol=0)


@pytest.mark.parametrize("drive", [Straight, policy])
def test_rows_are_the_same_whether_finished_ones_are_dropped_or_not(
    world: World, paired: EpisodeSet, monkeypatch: pytest.MonkeyPatch, drive: Callable[[], Driver]
) -> None:
    short = EvaluationSpec(duration=20.0, reach=10.0)
    dropped = run(drive(), world, paired, EnvSpec(), short)
    monkeypatch.setattr(paired_run, "BUSY", 0.0)
    kept = run(drive(), world, paired, EnvSpec(), short)
    assert (dropped["outcome"] == "success").mean() > 0.25  # some were dropped
    for key, column in kept.items():
        assert np.array_equal(column, dropped[key], equal_nan=column.dtype.kind == "f"), key


def test_measures_of_a_robot_that_stands_still(world: World, paired: EpisodeSet) -> None:
    class Still:
        def command(self, view: View) -> torch.Tensor:
            return torch.zeros(len(view.episode), 3)

        def select(self, keep: torch.Tensor) -> None:
            pass

    out = run(Still(), world, paired, EnvSpec(), EvaluationSpec(duration=2.0))
    assert (out["outcome"] == "timeout").all()
    assert np.isnan(out["success_time"]).all()
    assert (out["time"] == 2.0).all()
    assert (out["path_length"] == 0.0).all()
    assert (out["collisions"] == 0).all()
    np.testing.assert_allclose(out["final_distance"], paired.columns["geodesic"], atol=0.2 * 2**0.5)


@given(duration=st.floats(1.0, 120.0), period=st.floats(0.05, 1.0))
def test_an_episode_has_as_many_steps_as_fit(duration: float, period: float) -> None:
    steps = step_limit(duration, period)
    assert steps * period <= duration * (1 + 1e-5)
    assert (steps + 1) * period > duration * (1 - 1e-5)


def test_steps_that_fit_exactly_are_all_there() -> None:
    periods = {0.1: 1200, 0.2: 600, 0.35: 342, 0.3: 400}
    assert {period: step_limit(120.0, period) for period in periods} == periods
