"""The ROS 2 node without ROS: messages are whatever has their fields."""

from __future__ import annotations

import importlib.util
import math
import sys
from pathlib import Path
from types import SimpleNamespace as Message
from typing import Any

import numpy as np
import pytest

from romnav.deploy.runner import Runner
from romnav.safety.barrier import Status
from romnav.sensing.spec import DepthSpec, LidarSpec

FILE = Path(__file__).parents[2] / "examples" / "ros2_node.py"


def load() -> Any:
    spec = importlib.util.spec_from_file_location("ros2_node", FILE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


node = load()


class FakeRunner:
    """Remembers what it sensed."""

    def __init__(self, depth: DepthSpec | None = None, proprioception: int = 0) -> None:
        self.card = Message(lidar=LidarSpec(), depth=depth, proprioception=proprioception, period=0.2)
        self.sensed: Any = None

    def __call__(self, sensed: Any) -> Any:
        self.sensed = sensed
        return Message(command=np.array([0.5, 0.1, -0.2], np.float32), status=Status.UNCHANGED)


def turned(roll: float, pitch: float, yaw: float) -> Message:
    """A quaternion."""
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(a / 2), math.sin(a / 2)) for a in (roll, pitch, yaw))
    return Message(
        w=cr * cp * cy + sr * sp * sy,
        x=sr * cp * cy - cr * sp * sy,
        y=cr * sp * cy + sr * cp * sy,
        z=cr * cp * sy - sr * sp * cy,
    )


def cloud(points: np.ndarray) -> Message:
    """With an intensity between, and two bytes at the end of each point."""
    layout = np.dtype({"names": ["x", "y", "z"], "formats": ["<f4"] * 3, "offsets": [0, 4, 12], "itemsize": 18})
    rows = np.zeros(len(points), layout)
    rows["x"], rows["y"], rows["z"] = points.T
    fields = [Message(name=n, offset=o) for n, o in {"x": 0, "y": 4, "intensity": 8, "z": 12}.items()]
    return Message(fields=fields, is_bigendian=False, point_step=18, width=len(points), height=1, data=rows.tobytes())


def odometry(x: float, y: float, z: float, *tilt: float) -> Message:
    return Message(pose=Message(pose=Message(position=Message(x=x, y=y, z=z), orientation=turned(*tilt))))


def goal(x: float, y: float, z: float, yaw: float) -> Message:
    return Message(pose=Message(position=Message(x=x, y=y, z=z), orientation=turned(0.0, 0.0, yaw)))


def test_messages_become_what_the_policy_knows() -> None:
    runner = FakeRunner(DepthSpec())
    navigator = node.Navigator(runner)
    navigator.hear("goal", goal(5.0, 1.0, 3.0, 1.2), 0.0)
    navigator.hear("odom", odometry(1.0, 2.0, 0.79, 0.05, -0.1, 2.5), 9.9)
    navigator.hear("cloud", cloud(np.array([[0.0, 0.0, 1.0], [1.0, 2.0, 0.0]])), 9.8)
    depth = np.tile(np.arange(60, dtype="<u2") * 10, (52, 1))
    rows = np.zeros((52, 128), np.uint8)
    rows[:, :120] = depth.view(np.uint8)
    message = Message(encoding="16UC1", is_bigendian=0, height=52, width=60, step=128, data=rows.tobytes())
    navigator.hear("depth", message, 9.7)
    assert navigator.velocity(10.0) == pytest.approx((0.5, 0.1, -0.2))
    sensed = runner.sensed
    assert sensed.position == pytest.approx([1.0, 2.0, 0.0])
    assert (sensed.yaw, *sensed.tilt, sensed.goal_yaw) == pytest.approx((2.5, 0.05, -0.1, 1.2))
    assert sensed.goal == pytest.approx([5.0, 1.0, 3.0])
    # what is above the upside-down sensor is below the robot's head, a little behind as the sensor looks down
    pitch = LidarSpec().mount_pitch
    np.testing.assert_allclose(sensed.points[0], [-math.sin(pitch), 0.0, -math.cos(pitch)], atol=1e-6)
    assert sensed.points[1][1] == pytest.approx(-2.0)
    assert sensed.depth.shape == (26, 30)
    np.testing.assert_allclose(sensed.depth[0, :3], [0.01, 0.03, 0.05])


@pytest.mark.parametrize("missing", ["goal", "odom", "cloud"])
def test_a_robot_stands_while_anything_is_missing_or_old(missing: str) -> None:
    runner = FakeRunner()
    navigator = node.Navigator(runner)
    heard = {
        "goal": goal(5.0, 1.0, 0.0, 0.0),
        "odom": odometry(0.0, 0.0, 0.79, 0.0, 0.0, 0.0),
        "cloud": cloud(np.ones((4, 3))),
    }
    for topic, message in heard.items():
        if topic != missing:
            navigator.hear(topic, message, 1.0)
    assert navigator.velocity(1.0) == (0.0, 0.0, 0.0)
    navigator.hear(missing, heard[missing], 1.2)
    assert navigator.velocity(1.4) != (0.0, 0.0, 0.0)
    assert navigator.velocity(1.8) == (0.0, 0.0, 0.0)


def test_a_policy_of_the_humanoid_is_driven_by_the_real_runner(exported: Path) -> None:
    navigator = node.Navigator(Runner(exported))
    card = navigator.runner.card
    assert card.depth is not None
    shape = card.depth.rows, card.depth.columns
    message = Message(encoding="32FC1", is_bigendian=0, height=shape[0], width=shape[1], step=4 * shape[1])
    message.data = np.ones(shape, "<f4").tobytes()
    navigator.hear("goal", goal(5.0, 1.0, 0.0, 0.0), 1.0)
    navigator.hear("odom", odometry(0.0, 0.0, 0.79, 0.0, 0.0, 0.0), 1.0)
    navigator.hear("cloud", cloud(np.random.default_rng(0).normal(0.0, 3.0, (500, 3))), 1.0)
    navigator.hear("depth", message, 1.0)
    assert navigator.velocity(1.0) == (0.0, 0.0, 0.0)  # it does not feel itself yet
    navigator.hear("proprioception", Message(data=np.linspace(-1, 1, card.proprioception)), 1.0)
    assert navigator.velocity(1.0) != (0.0, 0.0, 0.0)


def test_without_ros_it_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(SystemExit, match="error: rclpy is missing; source a ROS 2 installation first"):
        node.main()
