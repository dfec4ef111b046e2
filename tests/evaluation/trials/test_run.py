from __future__ import annotations

from functools import partial

import numpy as np
import pytest
import torch

from romnav.evaluation.rollout import Oracle, Straight, View
from romnav.evaluation.shield import Guarded, Shield
from romnav.evaluation.spec import TrialSpec
from romnav.evaluation.trials import run as trials
from romnav.navigation.spec import EnvSpec
from romnav.robot.body import BodyModel
from romnav.robot.dynamics import Head
from romnav.robot.rom import ReducedOrderModel
from romnav.safety.barrier import Status
from romnav.sensing.spec import LidarSpec
from romnav.world.scenes.deployments import deployment_scenes
from romnav.world.scenes.obstacles import obstacle_scenes
from romnav.world.scenes.scene import Scene, scene_world
from romnav.world.spawns import Start
from romnav.world.world import World

SPEC = TrialSpec(trials=4, duration=25.0, sensor=LidarSpec(rows=30, columns=110))


@pytest.fixture(scope="module")
def scenes() -> tuple[Scene, ...]:
    return obstacle_scenes()


@pytest.fixture(scope="module")
def world(scenes: tuple[Scene, ...]) -> World:
    return scene_world(scenes)


@pytest.fixture(scope="module")
def straight(scenes: tuple[Scene, ...], world: World) -> dict:
    return trials.run(Straight(), scenes, world, EnvSpec(), SPEC)


@pytest.fixture(scope="module")
def oracle(scenes: tuple[Scene, ...], world: World) -> dict:
    return trials.run(Oracle(), scenes, world, EnvSpec(), SPEC)


def test_starts_and_goals_are_shared_by_the_sets_and_lead_across_the_hall(scenes, world: World) -> None:
    drawn = trials.draw(scenes, world, TrialSpec(trials=40)).columns
    for name in ("spawn_x", "spawn_y", "goal_x", "goal_y", "goal_yaw"):
        first, *others = np.split(drawn[name], 3)
        assert all(np.allclose(first, other) for other in others)
    assert (np.abs(drawn["goal_x"] - drawn["spawn_x"]) > 6.0).all()
    rightward = (drawn["goal_x"] > drawn["spawn_x"])[:40]
    assert np.array_equal(rightward, np.arange(40) % 2 == 0)
    # more trials extend fewer
    few = trials.draw(scenes, world, TrialSpec(trials=10)).columns
    assert np.array_equal(few["spawn_x"][:10], drawn["spawn_x"][:10])
    bearing = np.arctan2(drawn["goal_y"] - drawn["spawn_y"], drawn["goal_x"] - drawn["spawn_x"])
    off = np.abs((drawn["spawn_yaw"] - bearing + np.pi) % (2 * np.pi) - np.pi)
    assert (off < np.pi / 4 + 1.0).all()
    assert np.ptp(off) > 0.3


def test_the_shortest_paths_touch_nothing(oracle: dict) -> None:
    off = ~oracle["filter"]
    assert (oracle["outcome"][off] == "success").all()
    assert (oracle["collisions"][off] == 0).all()
    assert (oracle["path_length"][off] <= 1.1 * oracle["geodesic"][off]).all()


def test_the_filter_keeps_a_blind_driver_off_what_it_can_see(straight: dict) -> None:
    seen = np.isin(straight["scene"], ("in-distribution", "adversarial"))
    hit = straight["collisions"] > 0
    assert hit[seen & ~straight["filter"]].mean() > 0.6
    assert hit[seen & straight["filter"]].mean() < 0.1
    assert (straight["acting_time"][~straight["filter"]] == 0).all()
    assert (straight["acting_time"][seen & straight["filter"]] > 0).all()


def test_rows_are_consistent_with_their_tracks(straight: dict) -> None:
    for k in range(len(straight["scene"])):
        track = straight["track"][k].reshape(-1, 3) / 100.0
        assert len(track) == round(straight["time"][k] / 0.2) + 1
        assert np.allclose(track[0, :2], [straight["spawn_x"][k], straight["spawn_y"][k]], atol=0.006)
        walked = np.linalg.norm(np.diff(track[:, :2], axis=0), axis=1).sum()
        assert walked == pytest.approx(straight["path_length"][k], abs=0.015 * len(track))
        goal = np.array([straight[f"goal_{axis}"][k] for axis in "xyz"])
        near = np.linalg.norm(track - goal, axis=1) < 0.5
        assert near[:-1].sum() <= 1  # within rounding of the last one
        assert (straight["outcome"][k] == "success") == np.isfinite(straight["success_time"][k])
        hits = straight["hits"][k]
        assert len(hits) == straight["collisions"][k]
        assert (np.diff(hits) > 5).all()
        assert (hits >= 1).all()
        assert (hits < len(track)).all()


def test_two_runs_are_the_same_and_a_trial_does_not_depend_on_the_others(scenes, world: World) -> None:
    spec = SPEC.model_copy(update={"trials": 2, "duration": 6.0})
    a, b = (trials.run(Straight(), scenes, world, EnvSpec(), spec) for _ in range(2))
    more = trials.run(Straight(), scenes, world, EnvSpec(), spec.model_copy(update={"trials": 3}))
    same = more["trial"] < 2
    for name in ("path_length", "collisions", "acting_time"):
        assert np.array_equal(a[name], b[name])
    # noise is named by the row, and the filter's way with it; without the filter there is none
    off = ~a["filter"]
    assert np.array_equal(a["path_length"][off], more["path_length"][same][off])


def test_off_the_free_cells_the_oracle_finds_back(scenes, world: World) -> None:
    spec = TrialSpec(trials=1)
    robot = BodyModel(world, 3, 0.2)
    view = View(world, trials.draw(scenes, world, spec), EnvSpec(), robot)
    robot.position[:, :2] = torch.tensor([1.06, 5.0])  # the wall's inner face is at 0.8 m
    assert (world.node_at(robot.tile, robot.layer, robot.position[:, :2]) < 0).all()
    distance, direction = view.geodesic()
    assert torch.isfinite(distance).all()
    assert (direction[:, 0] > 0.3).all()
    assert torch.allclose(torch.linalg.vector_norm(direction, dim=1), torch.ones(3))


def test_blocked_is_held_and_stuck_at_the_end() -> None:
    log = trials._Log.of(100, 3)
    log.track[:, 0, 0] = 7  # stands still, held
    log.holds[:, 0] = True
    log.track[:, 1, 0] = 7  # stands still by itself
    log.track[:, 2, 0] = np.arange(101) * 10  # held now and then, but walks on
    log.holds[::2, 2] = True
    log.contact[[3, 4, 5, 20, 30], 1] = True
    columns = trials._summarise(log, np.full(3, 20.0), np.array(["timeout"] * 3), 0.2)
    assert columns["blocked"].tolist() == [True, False, False]
    assert columns["hits"][1].tolist() == [4, 21, 31]
    assert columns["contact_time"].tolist() == pytest.approx([0.0, 1.0, 0.0])


class Facing(ReducedOrderModel):
    """A robot 0.9 m before the vertical tube at (4.4, 5.5), with a head of its own or none."""

    head: Head | None = None

    def __init__(self, world: World) -> None:
        super().__init__(world, 2, 0.2)
        self.tile = torch.tensor([0, 2])
        self.position = torch.tensor([[1.0, 1.0, 0.0], [3.5, 5.5, 0.0]])


def guarded_velocity(world: World, robot: Facing) -> torch.Tensor:
    shield = Shield(world, 1, TrialSpec(), EnvSpec())
    wanted, noise = torch.tensor([[1.0, 0.0]]), torch.tensor([0])
    safe = shield(robot, torch.tensor([1]), wanted, noise, 1)
    assert safe.status[0] == Status.FILTERED
    return safe.velocity[0]


def test_the_shield_sees_a_tube_and_stops_before_it(world: World) -> None:
    assert guarded_velocity(world, Facing(world))[0] < 0.6


def test_the_shield_looks_through_a_head_that_is_turned_and_ahead_of_the_feet(world: World) -> None:
    """What it sees is where it is, whatever the head does."""
    standing, swaying = Facing(world), Facing(world)
    height = TrialSpec().sensor.height
    for yaw in (0.0, 2.0):
        for robot in (standing, swaying):
            robot.yaw = torch.tensor([0.0, yaw])
        swaying.head = Head(
            swaying.position + torch.tensor([0.06, -0.04, height - 0.05]), swaying.yaw + 0.3, torch.zeros(2, 2)
        )
        if yaw == 0.0:
            a, b = (guarded_velocity(world, robot) for robot in (standing, swaying))
            torch.testing.assert_close(a, b, atol=0.1, rtol=0)
        else:
            # with its back to the tube, nothing is in the way
            shields = [Shield(world, 1, TrialSpec(), EnvSpec()) for _ in range(2)]
            wanted, noise = torch.tensor([[0.3, 0.0]]), torch.tensor([0])
            for shield, robot in zip(shields, (standing, swaying), strict=True):
                assert shield(robot, torch.tensor([1]), wanted, noise, 1).velocity[0, 0] > 0.29


def walked(robots: BodyModel | Guarded, start: Start, rows: list[int], steps: int = 60) -> list[torch.Tensor]:
    """Positions (steps, R, 2) of ``rows``, and whether they touched something (R,); ahead, alone after half the way."""
    robots.reset(torch.arange(len(start.yaw)), start)
    ways, touched = [], torch.zeros(len(rows), dtype=torch.bool)
    for step in range(steps):
        robots.step(torch.tensor([1.0, 0.0, 0.0]).expand(len(robots.yaw), 3))
        if step == steps // 2:
            robots.select(torch.tensor(rows))
        here = slice(None) if step >= steps // 2 else rows
        ways.append(robots.position[here, :2])
        touched |= robots.contacts[here] > 0
    return [torch.stack(ways), touched]


def test_guarded_robots_stop_where_others_touch(scenes: tuple[Scene, ...], world: World) -> None:
    """Straight at what is in the way, for as long as it takes to get there; dropping others changes nothing."""
    episodes = trials.draw(scenes, world, SPEC)
    start = episodes.start("cpu")
    guarded = partial(Guarded, BodyModel, SPEC, EnvSpec(), None)
    _, hit = walked(BodyModel(world, len(episodes), 0.2), start, [*range(12)])
    way, safe = walked(guarded(world, len(episodes), 0.2), start, [*range(12)])
    assert hit.sum() >= 4
    assert not safe.any()
    kept = [k for k in range(12) if hit[k]]
    torch.testing.assert_close(walked(guarded(world, len(episodes), 0.2), start, kept)[0], way[:, kept])
    robots = guarded(world, len(episodes), 0.2)
    walked(robots, start, [*range(12)])
    robots._step = 0  # the same noise
    torch.testing.assert_close(walked(robots, start, [*range(12)])[0], way)


def test_the_filter_lets_pass_who_climbs_two_storeys_of_u_turns() -> None:
    """Their flights are seen from beside, from below and between the wires of railings on the way."""
    scenes = tuple(scene for scene in deployment_scenes() if scene.name == "stairwell")
    drawn = trials.run(Oracle(), scenes, scene_world(scenes), EnvSpec(), TrialSpec(trials=8, duration=100.0, seed=1000))
    on = drawn["filter"]
    assert (drawn["outcome"][on] == "success").all()
    assert drawn["time"][on].mean() < 1.15 * drawn["time"][~on].mean()
    assert not drawn["collisions"][on].any()
