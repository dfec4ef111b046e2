"""The runner sees what the simulator shows, and never moves a robot that it should not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from romnav.deploy import export as exporting
from romnav.deploy.export import export
from romnav.deploy.replay import Stream, replay
from romnav.deploy.runner import OWN, Runner, Sensed
from romnav.errors import RomnavError
from romnav.navigation.observations import goal_observation
from romnav.navigation.spec import CommandSpec
from romnav.robot.g1 import HEAD, build_spec
from romnav.robot.humanoid import _head_on
from romnav.robot.spec import RobotSpec
from romnav.robot.statics import NOTHING
from romnav.safety.barrier import Status
from romnav.safety.spec import SafetySpec
from romnav.sensing.image import directions
from romnav.sensing.spec import LidarSpec
from tests.deploy.conftest import DEPTH, FELT, LIDAR, actor, card, encoders


@pytest.fixture(scope="module")
def runner(exported: Path) -> Runner:
    return Runner(exported)


def room(distance: float = 3.0) -> np.ndarray:
    """Range image (rows, columns) of flat ground in a round room."""
    ray = directions(LIDAR).numpy()
    horizontal = np.hypot(ray[..., 0], ray[..., 1])
    to_ground = np.where(ray[..., 2] < 0, LIDAR.height / np.maximum(-ray[..., 2], 1e-6), np.inf)
    return np.minimum(to_ground, distance / horizontal).astype(np.float32)


def sensed(**changes: object) -> Sensed:
    usual = {
        "position": [1.0, 2.0, 0.0],
        "yaw": 0.5,
        "goal": [4.0, 1.0, 3.0],
        "goal_yaw": -1.0,
        "ranges": room(),
        "depth": np.full((DEPTH.rows, DEPTH.columns), 1.5),
        "proprioception": np.linspace(-1, 1, FELT),
    }
    return Sensed(**{**usual, **changes})


def cloud(ranges: np.ndarray, roll: float = 0.0, pitch: float = 0.0) -> np.ndarray:
    """The points of an image as a torso sees them that is tilted."""
    points = (ranges[..., None] * directions(LIDAR).numpy())[ranges > 0]
    turned = np.array(
        [[np.cos(pitch), 0.0, np.sin(pitch)], [0.0, 1.0, 0.0], [-np.sin(pitch), 0.0, np.cos(pitch)]]
    ) @ np.array([[1.0, 0.0, 0.0], [0.0, np.cos(roll), -np.sin(roll)], [0.0, np.sin(roll), np.cos(roll)]])
    return points @ turned


def test_it_observes_as_the_simulator_does(runner: Runner, monkeypatch: pytest.MonkeyPatch) -> None:
    fed: list[dict[str, np.ndarray]] = []
    real = runner.session

    class Session:
        def run(self, names: list[str], inputs: dict[str, np.ndarray]) -> list[np.ndarray]:
            fed.append(inputs)
            return real.run(names, inputs)

    monkeypatch.setattr(runner, "session", Session())
    runner.reset()
    first, _ = runner(sensed()), runner(sensed())
    position, yaw, goal, goal_yaw = (torch.tensor([x]) for x in ([1.0, 2.0, 0.0], 0.5, [4.0, 1.0, 3.0], -1.0))
    task = goal_observation(position, yaw, goal, goal_yaw, runner.card.max_goal_distance)[0].numpy()
    for inputs, previous in zip(fed, (np.zeros(3), first.wanted), strict=True):
        np.testing.assert_allclose(inputs["state"][0], [*task, *previous, *np.linspace(-1, 1, FELT)], atol=1e-6)
        np.testing.assert_allclose(inputs["lidar"][0], room())
    assert not fed[0]["memory"].any()
    assert fed[1]["memory"].any()


def test_points_of_a_leaning_robot_are_as_good_as_the_image(exported: Path) -> None:
    first, second = Runner(exported), Runner(exported)
    tilt = (0.05, 0.2)
    by_image, by_points = first(sensed(tilt=tilt)), second(sensed(ranges=None, points=cloud(room(), *tilt), tilt=tilt))
    np.testing.assert_allclose(by_points.wanted, by_image.wanted, atol=1e-5)
    np.testing.assert_allclose(by_points.command, by_image.command, atol=1e-4)


def arms() -> np.ndarray:
    """(N, 3) returns of a G1's own arms in the axes of its torso, origin at the sensor."""
    model = build_spec(RobotSpec(), NOTHING, visual=True).compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    torso = data.body("torso_link")
    axes = torso.xmat.reshape(3, 3)
    ray = directions(LidarSpec()).double().numpy().reshape(-1, 3)
    unit = ray / np.linalg.norm(ray, axis=1, keepdims=True)
    of_arms = [any(part in model.body(b).name for part in ("shoulder", "elbow", "wrist")) for b in model.geom_bodyid]
    model.geom_group[:] = np.where(of_arms, 5, 0)
    geom, distance = np.full(len(unit), -1, np.int32), np.zeros(len(unit))
    group = np.array([0, 0, 0, 0, 0, 1], np.uint8)
    head = torso.xpos + axes @ HEAD
    mujoco.mj_multiRay(model, data, head, (unit @ axes.T).ravel(), group, 1, -1, geom, distance, None, len(unit), 2.0)
    return (unit * distance[:, None])[geom >= 0]


def test_the_robots_own_arms_are_no_obstacles(exported: Path) -> None:
    own, around = arms(), cloud(room())
    assert len(own) > 100
    clean, with_arms = Runner(exported), Runner(exported)
    for _ in range(3):
        one = clean(sensed(ranges=None, points=around))
        other = with_arms(sensed(ranges=None, points=np.concatenate([around, own])))
        np.testing.assert_array_equal(other.command, one.command)


def test_the_filter_knows_where_the_head_of_a_leaning_robot_is(exported: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    roll, pitch = 0.1, 0.4
    turned = Rotation.from_euler("xyz", [roll, pitch, 0.0]).as_matrix()
    joint = np.array([0.0, 0.0, LIDAR.height]) - HEAD
    head = _head_on(torch.tensor(joint[None], dtype=torch.float32), torch.tensor(turned[None], dtype=torch.float32))
    around = np.random.default_rng(0).uniform([-3, -3, 0], [3, 3, 2], (500, 3))  # from the ground beneath the robot
    seen = (around - head.origin[0].numpy()) @ turned
    runner = Runner(exported)
    given: list[torch.Tensor] = []
    real = runner._filter

    def guard(points: torch.Tensor, *rest: Any) -> Any:
        given.append(points)
        assert real is not None
        return real(points, *rest)

    monkeypatch.setattr(runner, "_filter", guard)
    runner(sensed(ranges=None, points=seen, tilt=(roll, pitch)))
    kept = np.linalg.norm(seen, axis=1) > OWN
    np.testing.assert_allclose(given[0][0].numpy(), around[kept], atol=1e-4)


def test_a_command_keeps_the_limits_and_the_turn(runner: Runner) -> None:
    runner.reset()
    out = runner(sensed())
    assert out.status in (Status.UNCHANGED, Status.FILTERED)
    assert -0.5 <= out.command[0] <= 1.0
    assert abs(out.command[1]) <= 0.25
    assert out.command[2] == out.wanted[2]


def test_it_does_not_walk_into_a_wall(runner: Runner) -> None:
    """A round room that closes in leaves no way to go."""
    runner.reset()
    speeds = [np.linalg.norm(runner(sensed(ranges=room(distance))).command[:2]) for distance in (3.0, 0.45)]
    assert speeds[1] < 0.1


def test_without_a_filter_the_policy_has_its_way(exported: Path) -> None:
    out = Runner(exported, safety=None)(sensed(ranges=room(0.45)))
    np.testing.assert_array_equal(out.command, out.wanted)


@pytest.mark.parametrize(
    ("change", "status"),
    [
        ({"position": [np.nan, 0.0, 0.0]}, Status.NOT_FINITE),
        ({"goal": [np.inf, 0.0, 0.0]}, Status.NOT_FINITE),
        ({"tilt": (np.inf, 0.0), "ranges": None, "points": np.ones((4, 3))}, Status.NOT_FINITE),
        ({"ranges": np.zeros((15, 55))}, Status.NO_POINTS),
        ({"ranges": None, "points": np.empty((0, 3))}, Status.NO_POINTS),
    ],
)
def test_a_robot_that_is_blind_or_lost_stands(runner: Runner, change: dict[str, object], status: Status) -> None:
    runner.reset()
    out = runner(sensed(**change))
    assert out.status is status
    assert not out.command.any()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"ranges": None}, "give the LiDAR's points or its ranges"),
        ({"points": np.zeros((4, 3))}, "one of them"),
        ({"ranges": np.zeros((4, 4))}, r"ranges has shape \(4, 4\); expected \(15, 55\)"),
        ({"depth": None}, "give its image as depth"),
        ({"proprioception": ()}, r"proprioception has shape \(0,\); expected \(7\)"),
        ({"position": [0.0, 0.0]}, r"position has shape \(2,\); expected \(3\)"),
    ],
)
def test_what_is_missing_is_named(runner: Runner, change: dict[str, object], message: str) -> None:
    with pytest.raises(RomnavError, match=message):
        runner(sensed(**change))


@pytest.mark.parametrize(
    ("content", "message"),
    [(None, "no such policy"), (b"", "truncated or no ONNX"), (b"x" * 99, "truncated or no ONNX")],
)
def test_another_file_is_refused(tmp_path: Path, content: bytes | None, message: str) -> None:
    path = tmp_path / "policy.onnx"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(RomnavError, match=f"policy.onnx: {message}"):
        Runner(path)


@pytest.mark.parametrize("as_points", [True, False])
def test_a_replayed_stream_is_what_was_driven(exported: Path, tmp_path: Path, as_points: bool) -> None:
    steps = [sensed(position=[0.1 * k, 0.0, 0.0], yaw=0.02 * k, ranges=room(3.0 - 0.1 * k)) for k in range(6)]
    if as_points:
        steps = [replace(s, ranges=None, points=cloud(np.asarray(s.ranges))) for s in steps]
    driver = Runner(exported)
    driven = [driver(step) for step in steps]
    Stream.of(steps).save(tmp_path / "stream.npz")
    out = replay(driver, Stream.load(tmp_path / "stream.npz"))
    np.testing.assert_allclose(out.command, [v.command for v in driven], atol=1e-6)
    np.testing.assert_array_equal(out.status, [v.status for v in driven])
    summary = out.summary()
    assert summary["periods"] == 6
    assert 0.0 < summary["median ms"] <= summary["worst ms"]


def test_another_stream_is_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "other.npz", x=np.zeros(3))
    (tmp_path / "torn.npz").write_bytes(b"PK\x03\x04")
    for name, message in {"other": "truncated, or no stream", "torn": "truncated", "none": "no such stream"}.items():
        with pytest.raises(RomnavError, match=f"{name}.npz: {message}"):
            Stream.load(tmp_path / f"{name}.npz")


def test_the_filter_has_the_limits_of_the_policy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(exporting, "STEPS", 1)
    limits = CommandSpec(forward=0.7, reverse=0.3, lateral=0.15)
    lidar, _ = encoders()
    export(actor(lidar), lidar, None, card(period=0.1, command=limits), tmp_path / "policy.onnx", lambda *_: None)
    runner = Runner(tmp_path / "policy.onnx", SafetySpec())
    assert runner._filter is not None
    barrier = runner._filter.spec.filter
    assert (barrier.period, barrier.forward, barrier.reverse, barrier.lateral) == (0.1, 0.7, 0.3, 0.15)
