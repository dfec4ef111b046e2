"""The task: mirror symmetry, rewards, curriculum, and a run that is killed and resumed."""

from __future__ import annotations

import csv
import math
import signal
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from romnav.errors import RomnavError
from romnav.robot.g1 import Humanoids
from romnav.robot.heights import HeightMap
from romnav.robot.locomotion.control import Controller, has_fallen
from romnav.robot.locomotion.evaluate import Cycles, Row, rows, run_row
from romnav.robot.locomotion.lane_task import LocomotionEnv
from romnav.robot.locomotion.legs import rotation
from romnav.robot.locomotion.mirror import ACTION_MIRROR, MIRROR, PRIVILEGED_MIRROR
from romnav.robot.locomotion.planar import turn_xy
from romnav.robot.locomotion.task import tracking_error
from romnav.robot.locomotion.terrain import curriculum, flat, stairs
from romnav.robot.locomotion.tile_task import TileEnv
from romnav.robot.locomotion.train import KIND, load_policy, train
from romnav.robot.spec import LocomotionSpec, PpoSpec, RewardSpec, TaskSpec, TileTaskSpec
from romnav.robot.statics import Geoms
from romnav.stopping import Stopped
from romnav.world.build import build
from romnav.world.spec import WorldSpec
from tests.test_journal import told

SHARES = {"flat": 0.5, "stairs": 0.5}
SPEC = LocomotionSpec(
    task=TaskSpec(robots=8, shares=SHARES), ppo=PpoSpec(steps=6, epochs=2, minibatches=2, hidden=(16,)), iterations=2
)


def lanes() -> list:
    return [flat(), stairs(0, 0.05, 0.3, 0.3, 3), stairs(1, 0.10, 0.3, 0.3, 3)]


@pytest.mark.parametrize("table", [MIRROR, ACTION_MIRROR, PRIVILEGED_MIRROR])
def test_mirroring_twice_changes_nothing(table: tuple[torch.Tensor, torch.Tensor]) -> None:
    index, sign = table
    x = torch.randn(3, len(index))
    torch.testing.assert_close((x[:, index] * sign)[:, index] * sign, x)


def test_the_mirrored_robot_sees_the_same_and_does_the_mirror_image() -> None:
    """Two robots on the flat, one the other's mirror image in every state, over both halves of a gait cycle."""
    spec = SPEC.model_copy(update={"task": SPEC.task.model_copy(update={"robots": 2, "shares": {"flat": 1.0}})})
    env = LocomotionEnv(spec, [flat()], threads=1)
    control, ids = env.control, torch.arange(2)
    command = torch.tensor([[0.4, 0.1, 0.3], [0.4, -0.1, -0.3]])
    start = torch.tensor([[-60.0, 1.0, 0.0], [-60.0, -1.0, 0.0]])
    env.robots.randomize(torch.full((2,), 0.8), torch.zeros(2))
    control.stand(ids, start, torch.tensor([0.2, -0.2]), torch.tensor([0, spec.gait.step_ticks]), command)
    generator = torch.Generator().manual_seed(0)
    for k in range(spec.gait.step_ticks + 6):
        control.refer(command, env.ground.map, torch.full((2,), k == 0))
        seen = control.observe(command, env.ground.map)
        torch.testing.assert_close(seen[1:], seen[:1], atol=2e-2, rtol=0)
        control.act((0.3 * torch.randn(1, 15, generator=generator)).expand(2, -1))
    assert (env.robots.pelvis[0] * torch.tensor([1, -1, 1]) - env.robots.pelvis[1]).abs().max() < 2e-3


def test_a_torso_that_leans_costs_whichever_way() -> None:
    spec = SPEC.model_copy(update={"reward": RewardSpec(torso=2.0)})
    env = LocomotionEnv(spec, lanes(), threads=1)
    for turn in (rotation(1, torch.tensor(0.3)), rotation(0, torch.tensor(-0.3))):
        env.robots.torso_rotation = turn.expand(8, 3, 3)
        assert env.rewards()["torso"].numpy() == pytest.approx(-2.0 * math.sin(0.3) ** 2)


def test_tracking_errors_are_the_state_less_the_reference() -> None:
    """Two robots that face along y: one on its left foot, one, tipped forward and turned on, on its right."""
    quarter = math.pi / 2
    facing = rotation(2, torch.tensor(quarter))
    tipped = rotation(2, torch.tensor(quarter + 0.2)) @ rotation(1, torch.tensor(0.3))
    toe_down, level = rotation(1, torch.tensor(0.1)), torch.eye(3)
    robots = SimpleNamespace(
        count=2,
        com=torch.tensor([[1.0, 2.5, 0.7], [0.0, 0.0, 0.7]]),
        com_velocity=torch.tensor([[0.1, 0.6, 0.0], [-0.2, 0.4, 0.0]]),
        orientation=torch.stack([facing, tipped]),
        pelvis=torch.tensor([[9.0, 9.0, 0.75], [9.0, 9.0, 0.70]]),
        velocity=torch.tensor([[9.0, 9.0, 0.05], [9.0, 9.0, -0.1]]),
        spin=torch.tensor([[0.1, 0.2, 0.5], [0.0, 0.0, -0.3]]),
        ankle_rotation=torch.stack([torch.stack([level, toe_down]), torch.stack([level, toe_down])]),
    )
    reference = SimpleNamespace(
        side=torch.tensor([1.0, -1.0]),
        com=torch.tensor([[0.3, 0.1], [0.0, 0.0]]),
        com_velocity=torch.tensor([[0.5, 0.0], [0.0, 0.0]]),
        height=torch.tensor([0.73, 0.73]),
        heading=torch.tensor([quarter, quarter]),
        swing=torch.tensor([[1.2, 2.4, 0.10], [0.2, -0.1, 0.05]]),
        sole=torch.tensor(
            [[[0.8, 2.1, 0.0], [1.25, 2.35, 0.13]], [[0.3, -0.3, 0.04], [-0.1, 0.2, 0.0]]],
        ),
    )
    foot_rate = torch.tensor([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]])
    error, rate = tracking_error(robots, reference, foot_rate, torch.tensor([0.02, 0.0]), torch.tensor([0.4, 0.0]))
    expected = torch.tensor(
        [
            # 0.4 m ahead of the left sole, 0.2 m right of it; 2 cm too high; upright; the right sole off by 5, -5, 3 cm
            [0.4 - 0.3, -0.2 - 0.1, 0.02, 0.0, 0.0, 0.0, 0.05, -0.05, 0.03, -math.sin(0.1), 0.0],
            # 0.2 m behind the right sole, 0.1 m right of it; 3 cm too low; tipped by 0.3, turned by 0.2; the left sole
            [-0.2, -0.1, -0.03, -math.sin(0.3), 0.0, 0.2, 0.1, -0.2, -0.01, 0.0, 0.0],
        ]
    )
    torch.testing.assert_close(error, expected, atol=1e-6, rtol=0)
    # the pelvis rolls at 0.1 and pitches at 0.2: its view of the vertical moves by (-pitch, roll)
    rates = torch.tensor(
        [
            [0.6 - 0.5, -0.1, 0.05 - 0.02, -0.2, 0.1, 0.5 - 0.4, 0.1, 0.2, 0.3, 0.0, 0.0],
            [0.4, 0.2, -0.1, 0.0, 0.0, -0.3, 0.4, 0.5, 0.6, 0.0, 0.0],
        ]
    )
    torch.testing.assert_close(rate, rates, atol=1e-6, rtol=0)


def test_every_reward_term_is_what_its_weight_says() -> None:
    spec = SPEC.model_copy(update={"reward": RewardSpec(torso=2.0)})
    env = LocomotionEnv(spec, lanes(), threads=1)
    robots, decay = env.robots, env.clf.decay
    env.value[:], env._slope[:] = 0.75, -0.75 * decay + 0.3  # V falls too slowly by 0.3 in a second
    env.command[:] = torch.tensor([0.6, 0.2, 0.5])
    env.average[:] = torch.tensor([0.44, 0.08, 0.3])  # 0.2 m/s and 0.2 rad/s off
    robots.orientation = rotation(1, torch.tensor(0.2)).expand(8, 3, 3)
    robots.torso_rotation = rotation(0, torch.tensor(0.1)).expand(8, 3, 3)
    robots.torque = torch.full((8, 15), 10.0)
    robots.touch = torch.zeros_like(robots.touch)
    shins = [robots.touch_names.index(f"{side}_knee_link") for side in ("left", "right")]
    robots.touch[:, [*robots.feet, *shins]] = True
    env.control.action = torch.full((8, 15), 0.5)
    env._last["action"] = torch.full((8, 15), 0.2)
    turning = math.exp(-((0.2 / 0.4) ** 2))
    expected = {
        "clf": 1.0 * (math.exp(-0.75 / 1.5) + 1 / (2 * 1.75)),
        "decrease": -0.2 * 0.3 / 1.5,
        "velocity": 2.0 * math.exp(-1.0) * turning,
        "velocity_linear": -0.6 * 0.2,
        "yaw": 0.6 * turning,
        "upright": -1.5 * math.sin(0.2) ** 2,
        "torso": -2.0 * math.sin(0.1) ** 2,
        "action": -0.01 * 15 * 0.5**2,
        "action_rate": -0.01 * 15 * 0.3**2,
        "torque": -4e-6 * 15 * 10.0**2,
        "collision": -0.3 * 2,  # both shins; feet are for standing on
        "alive": 0.5,
    }
    assert env.rewards().keys() == expected.keys()
    for name, term in env.rewards().items():
        assert term.tolist() == pytest.approx([expected[name]] * 8, rel=1e-4), name
    env._slope[:] = -0.75 * decay - 0.3
    assert (env.rewards()["decrease"] == 0.0).all(), "a V that falls fast enough costs nothing"


def test_spinning_on_the_spot_earns_less_than_walking() -> None:
    env = LocomotionEnv(SPEC, lanes(), threads=1)
    env.command[:] = torch.tensor([0.6, 0.0, 0.0])
    env.average[:] = torch.tensor([0.6, 0.0, 0.0])
    walking = env.rewards()
    env.average[:] = torch.tensor([0.6, 0.0, 3.0])
    spinning = env.rewards()
    env.average[:] = 0.0
    standing = env.rewards()
    total = [sum(r[k] for k in ("velocity", "velocity_linear", "yaw")).mean() for r in (walking, spinning, standing)]
    assert total[0] > total[2] + 0.5
    assert total[0] > total[1] + 1.5
    assert total[2] < 0.5
    env.average[:] = torch.tensor([0.1, 0.0, 0.0])
    assert (env.rewards()["velocity_linear"] > standing["velocity_linear"]).all(), "no gradient out of standing"


def test_levels_follow_the_distance_along_the_path() -> None:
    env = LocomotionEnv(SPEC, lanes(), threads=1)
    stair = env.kind == env.kinds.index("stairs")
    ids = stair.nonzero()[:, 0]
    env.start[ids], env.arc[ids], env.speed[ids] = 0.8, 3.8, 0.5
    env.episode_length_buf[ids] = 300
    env.level[ids] = env.tried[ids] = 0
    env._finish(ids, torch.zeros(8, dtype=torch.bool), stair)
    assert (env.level[ids] == 1).all()
    env.level[ids] = 0
    env.episode_length_buf[ids] = 900
    env._finish(ids, torch.zeros(8, dtype=torch.bool), stair)
    assert (env.level[ids] == 0).all(), "arriving late does not count"
    env.level[ids] = env.tried[ids] = 1
    env._finish(ids, stair, torch.zeros(8, dtype=torch.bool))
    assert (env.level[ids] == 1).all(), "a fall after most of the way is no reason to go down"
    env.arc[ids] = 1.6
    env.tried[ids] = 0
    env._finish(ids, stair, torch.zeros(8, dtype=torch.bool))
    assert (env.level[ids] == 1).all(), "what happens on another level says nothing about this one"
    env.tried[ids] = 1
    env._finish(ids, stair, torch.zeros(8, dtype=torch.bool))
    assert (env.level[ids] == 0).all()


def test_a_robot_that_starts_again_leaves_the_others_alone() -> None:
    a, b = (LocomotionEnv(SPEC, lanes(), threads=1) for _ in range(2))
    b.robots.set_state(torch.tensor([3]), torch.tensor([[0.0, 0, 0.2, 0, 1, 0, 0] + [0.0] * 15]), torch.zeros(1, 21))
    for env in (a, b):
        env.step(torch.zeros(8, 15))
    others = [0, 1, 2, 4, 5, 6, 7]
    torch.testing.assert_close(a.robots.pelvis[others], b.robots.pelvis[others], atol=0, rtol=0)
    assert (a.robots.pelvis[3] - b.robots.pelvis[3]).abs().max() > 1e-3


def test_a_killed_run_resumes_to_the_bit(tmp_path: Path) -> None:
    whole = train(SPEC, tmp_path / "whole", threads=1)
    train(SPEC.model_copy(update={"iterations": 1}), tmp_path / "parts", threads=1)
    parts = train(SPEC, tmp_path / "parts", threads=2)
    a, b = (KIND.load(path) for path in (whole, parts))
    assert a["iteration"] == b["iteration"] == 2
    for key, value in a["ppo"]["actor_state_dict"].items():
        assert torch.equal(value, b["ppo"]["actor_state_dict"][key]), key
    assert np.array_equal(a["env"]["robots"]["qpos"], b["env"]["robots"]["qpos"])
    with (tmp_path / "parts" / "curve.csv").open() as file:
        rows = list(csv.DictReader(file))
    seen = told(tmp_path / "parts")
    for tag, column in {"run/reward": "reward", "loss/value": "value", "run/fell": "fell"}.items():
        assert seen[tag] == [(int(row["steps"]), pytest.approx(float(row[column]), rel=1e-4)) for row in rows]
    assert len(rows) == 2
    spec, policy, iteration = load_policy(parts)
    assert spec == SPEC
    assert iteration == 2
    assert policy(torch.zeros(3, len(MIRROR[0]))).shape == (3, 15)
    with pytest.raises(RomnavError, match="another specification"):
        train(SPEC.model_copy(update={"seed": 9}), tmp_path / "parts", threads=1)
    with pytest.raises(RomnavError, match="has had 2 iterations, more than"):
        train(SPEC.model_copy(update={"iterations": 1}), tmp_path / "parts", threads=1)
    broken = KIND.load(parts)
    broken["average"]["mlp.0.bias"][0] = torch.nan
    KIND.save(tmp_path / "broken.pt", broken)
    with pytest.raises(RomnavError, match=r"broken\.pt: mlp\.0\.bias not finite"):
        load_policy(tmp_path / "broken.pt")
    with pytest.raises(RomnavError, match="no such locomotion policy"):
        load_policy(tmp_path / "none.pt")


def test_a_signal_in_an_iteration_saves_first_and_the_run_goes_on_to_the_same_weights(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    step = LocomotionEnv.step

    def terminated(env: LocomotionEnv, actions: torch.Tensor) -> object:
        signal.raise_signal(signal.SIGTERM)
        return step(env, actions)

    whole = train(SPEC, tmp_path / "whole", threads=1)
    monkeypatch.setattr(LocomotionEnv, "step", terminated)
    with pytest.raises(Stopped) as caught:
        train(SPEC, tmp_path / "parts", threads=1, save_every=3600.0)
    assert caught.value.number == signal.SIGTERM
    assert KIND.load(tmp_path / "parts" / "policy.pt")["iteration"] == 1
    monkeypatch.undo()
    parts = train(SPEC, tmp_path / "parts", threads=1)
    a, b = (KIND.load(path) for path in (whole, parts))
    for part in ("actor_state_dict", "critic_state_dict"):
        torch.testing.assert_close(a["ppo"][part], b["ppo"][part], rtol=0, atol=0)
    torch.testing.assert_close(a["average"], b["average"], rtol=0, atol=0)


def test_rows_behind_the_checkpoint_are_not_there_twice(tmp_path: Path) -> None:
    train(SPEC.model_copy(update={"iterations": 1}), tmp_path, threads=1)
    head, row = (tmp_path / "curve.csv").read_text().splitlines()
    place = head.split(",").index("iteration")
    later = ",".join("2" if i == place else cell for i, cell in enumerate(row.split(",")))
    (tmp_path / "curve.csv").write_text("\n".join([head, row, later]) + "\n")
    train(SPEC, tmp_path, threads=1)
    lines = (tmp_path / "curve.csv").read_text().splitlines()
    assert [line.split(",")[place] for line in lines] == ["iteration", "1", "2"]
    assert lines[1] == row
    assert lines[2] != later


def test_robots_join_on_tiles_and_the_run_still_resumes_to_the_bit(tmp_path: Path) -> None:
    """Across the iteration at which they join, from a checkpoint of the specification without them."""
    world = WorldSpec(tiles=2, goals_per_tile=4, classes=("building", "outdoor"))
    tiles = TileTaskSpec(robots=4, begin=1, world=world)
    spec = SPEC.model_copy(update={"tiles": tiles, "iterations": 3})
    whole = train(spec, tmp_path / "whole", threads=1, worlds=tmp_path)
    train(SPEC.model_copy(update={"iterations": 1}), tmp_path / "parts", threads=1)
    train(spec.model_copy(update={"iterations": 2}), tmp_path / "parts", threads=1, worlds=tmp_path)
    parts = train(spec, tmp_path / "parts", threads=2, worlds=tmp_path)
    a, b = (KIND.load(path) for path in (whole, parts))
    for key, value in a["ppo"]["actor_state_dict"].items():
        assert torch.equal(value, b["ppo"]["actor_state_dict"][key]), key
    for part in (lambda env: env, lambda env: env["tiles"]):
        assert np.array_equal(part(a["env"])["robots"]["qpos"], part(b["env"])["robots"]["qpos"])
    assert torch.equal(a["env"]["tiles"]["command"], b["env"]["tiles"]["command"])
    lines = [line.split(",") for line in (tmp_path / "parts" / "curve.csv").read_text().splitlines()]
    assert len(lines) == 4
    assert len({len(line) for line in lines}) == 1
    assert spec.steps(3) == 6 * (3 * 8 + 2 * 4)
    for other in (TileTaskSpec(), tiles.model_copy(update={"burst": 0.5})):
        with pytest.raises(RomnavError, match="another specification"):
            train(spec.model_copy(update={"tiles": other}), tmp_path / "parts", threads=1)


def test_commands_on_tiles_are_held_and_within_the_limits(tmp_path: Path) -> None:
    world = build(WorldSpec(tiles=2, goals_per_tile=4, classes=("building", "outdoor")), tmp_path)
    spec = SPEC.model_copy(
        update={"tiles": TileTaskSpec(robots=12, drivers={"steps": 1.0, "smooth": 1.0, "oracle": 1.0})}
    )
    env = TileEnv(spec, world, threads=1)
    t, kept = spec.task, env.command.clone()
    for _ in range(60):
        env.step(torch.zeros(12, 15))
        changed = (env.command != kept).any(1)
        assert not (changed & (env.episode_length_buf % 10 != 0)).any()
        kept = env.command.clone()
        assert (kept[:, 0] >= t.forward[0]).all()
        assert (kept[:, 0] <= t.forward[1]).all()
        assert (kept[:, 1:].abs() <= torch.tensor([t.lateral, t.turn])).all()


def test_a_state_that_is_not_finite_counts_as_a_fall() -> None:
    env = LocomotionEnv(SPEC, lanes(), threads=1)
    assert not env.fallen().any()
    env.robots.joint_velocity[3, 2] = torch.nan
    assert env.fallen().nonzero().tolist() == [[3]]


def test_training_stops_at_what_is_not_finite(tmp_path: Path) -> None:
    broken = SPEC.model_copy(update={"ppo": SPEC.ppo.model_copy(update={"gamma": float("nan")})})
    with pytest.raises(RomnavError, match=r"iteration 1: .* not finite"):
        train(broken, tmp_path, threads=1, save_every=0.0)
    assert not list(tmp_path.glob("*.pt"))


def test_the_policy_that_is_used_has_the_weights_averaged_over_iterations(tmp_path: Path) -> None:
    first, second = (KIND.load(train(SPEC.model_copy(update={"iterations": n}), tmp_path, threads=1)) for n in (1, 2))
    actor, keep = second["ppo"]["actor_state_dict"], SPEC.ppo.average
    assert set(second["average"]) == {name for name in actor if not name.startswith("obs_normalizer")}
    for name, value in second["average"].items():
        torch.testing.assert_close(value, keep * first["average"][name] + (1 - keep) * actor[name])
    second["average"] = {name: torch.zeros_like(value) for name, value in second["average"].items()}
    KIND.save(tmp_path / "policy.pt", second)
    assert (load_policy(tmp_path / "policy.pt")[1](torch.rand(3, len(MIRROR[0]))) == 0).all()


class _Glide:
    """A body that follows a command exactly, or not at all."""

    def __init__(self, count: int) -> None:
        self.count = count
        self.pelvis, self.yaw = torch.zeros(count, 3), torch.zeros(count)

    @property
    def orientation(self) -> torch.Tensor:
        c, s, o, i = torch.cos(self.yaw), torch.sin(self.yaw), torch.zeros_like(self.yaw), torch.ones_like(self.yaw)
        return torch.stack([c, -s, o, s, c, o, o, o, i], dim=1).view(-1, 3, 3)

    def move(self, velocity: torch.Tensor, dt: float) -> None:
        mid = self.yaw + velocity[:, 2] * dt / 2
        self.pelvis[:, :2] += turn_xy(velocity[:, :2], mid) * dt
        self.yaw = self.yaw + velocity[:, 2] * dt


def test_cycles_measure_net_motion() -> None:
    """A body that obeys covers all of its command; one that spins or stands covers none of its way."""
    command = torch.tensor([[0.8, 0.2, 1.0], [0.8, 0.0, 0.0], [0.8, 0.0, 0.0]])
    does = torch.tensor([[0.8, 0.2, 1.0], [0.8, 0.0, 7.85], [0.0, 0.0, 0.0]])
    body = _Glide(3)
    cycles = Cycles(body, 40, 0.02)
    for _ in range(400):
        body.move(does, 0.02)
        cycles.add(command, torch.ones(3, dtype=torch.bool))
    share = cycles.covered / cycles.wanted.clamp(min=1e-6)
    assert share[0].numpy() == pytest.approx([1.0, 1.0], abs=0.04)
    assert share[1, 0].abs() < 0.1
    assert share[2, 0] == 0.0
    error = cycles.error / cycles.count
    assert error[0] < 0.05
    assert error[1] > 0.7
    assert error[2] == pytest.approx(0.8, abs=1e-4)


def test_nothing_is_crossed_by_a_robot_that_cannot_walk() -> None:
    """Limp residuals against the gait: every trial falls or stays, none arrives."""
    row = Row("stairs-low", "-", 0.95, (stairs(0, 0.1, 0.3, 0.3, 3),), ((0, 1), (1, 2)), (0.4, 0.8))
    limp = torch.tensor([4.0, 0, 0, 4.0, 4.0, 0] * 2 + [0.0] * 3)
    result = run_row(row, SPEC, lambda obs: limp.expand(len(obs), -1), 4, 0, threads=1)
    assert result["crossed"] == 0.0
    assert result["fell"] == 1.0


def test_the_test_terrain_is_not_the_training_terrain() -> None:
    def shapes(all_lanes: list) -> set:
        return {
            (round(abs(s.z1 - s.z0), 3), round(s.x1 - s.x0, 3), round(min(lane.slabs[0].z0, lane.slabs[0].z1), 3))
            for lane in all_lanes
            for s in lane.slabs[:1]
            if lane.kind != "rough"
        }

    assert not shapes(curriculum(np.random.default_rng(1))) & shapes([lane for row in rows() for lane in row.lanes])
    assert {row.terrain for row in rows()} == {"flat", "ramp", "stairs-low", "stairs-high", "u-stair"}
    assert all(len(lane.slabs) >= 39 for row in rows() if row.terrain.startswith("stairs") for lane in row.lanes)


@pytest.mark.parametrize("wall", [False, True])
def test_the_gait_does_not_wind_up_against_a_wall(wall: bool) -> None:
    spec = LocomotionSpec()
    upright, half = np.array([[1.0, 0.0, 0.0, 0.0]]), np.array([[0.1, 3.0, 1.5]])
    ahead = Geoms.boxes(np.array([[0.5 if wall else 50.0, 0.0, 1.5]]), half, upright)
    control = Controller(spec, Humanoids(spec.robot, [ahead], 1, threads=1))
    command = torch.tensor([[0.8, 0.0, 0.0]])
    control.stand(torch.arange(1), torch.zeros(1, 3), torch.zeros(1), torch.zeros(1, dtype=torch.long), command)

    ground = HeightMap((0.0, 0.0), 1.0, torch.zeros(1, 1))
    asked = []
    for tick in range(150):
        control.refer(command, ground, torch.tensor([tick == 0]))
        control.act(torch.zeros(1, 15))
        asked.append(float(control.walker.command[0, 0] + control.walker.integral[0, 0]))
    assert not has_fallen(control.robots)
    assert (np.mean(asked[50:]) < 0.6 and max(asked) < 0.8) if wall else np.mean(asked[50:]) > 0.7
