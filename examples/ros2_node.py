"""A ROS 2 node that drives a robot by an exported policy: clouds, odometry and a goal in, velocities out at 5 Hz.
A policy of the humanoid also needs depth images and, from whatever walks the robot, its proprioception.

    python examples/ros2_node.py policy.onnx --ros-args -r cloud:=/livox/lidar -r odom:=/odom

It can be imported without ROS; `Navigator` is all of it but the wiring.
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from romnav.deploy import Runner, Sensed

STALE = 0.5
"""A robot whose cloud, odometry, depth or proprioception is older stands, s."""
BASE = 0.79
"""Height of the odometry's frame above the ground, m: the pelvis of a standing G1."""
STAND = (0.0, 0.0, 0.0)


def points(cloud: Any) -> NDArray[np.float32]:
    """(N, 3) of a ``sensor_msgs/PointCloud2`` of float32 x, y and z, in its own frame, m."""
    offsets = {field.name: field.offset for field in cloud.fields}
    order = ">" if cloud.is_bigendian else "<"
    layout = np.dtype(
        {
            "names": ["x", "y", "z"],
            "formats": [f"{order}f4"] * 3,
            "offsets": [offsets[axis] for axis in "xyz"],
            "itemsize": cloud.point_step,
        }
    )
    rows = np.frombuffer(bytes(cloud.data), layout, cloud.width * cloud.height)
    return np.stack([rows["x"], rows["y"], rows["z"]], axis=1).astype(np.float32)


def image(message: Any) -> NDArray[np.float32]:
    """(rows, columns) depth in m of a ``sensor_msgs/Image``, 32FC1 in m or 16UC1 in mm; 0 is no return."""
    kind, scale = {"32FC1": ("f4", 1.0), "16UC1": ("u2", 1e-3)}[message.encoding]
    layout = np.dtype(f"{'>' if message.is_bigendian else '<'}{kind}")
    rows = np.frombuffer(bytes(message.data), np.uint8).reshape(message.height, message.step)
    depth = rows[:, : message.width * layout.itemsize].copy().view(layout).astype(np.float32) * scale
    return np.nan_to_num(depth, nan=0.0, posinf=0.0, neginf=0.0)


def angles(quaternion: Any) -> tuple[float, float, float]:
    """Roll, pitch and yaw of a ``geometry_msgs/Quaternion``, rad."""
    x, y, z, w = quaternion.x, quaternion.y, quaternion.z, quaternion.w
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
    return roll, pitch, math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def subsample(depth: NDArray[np.float32], rows: int, columns: int) -> NDArray[np.float32]:
    """The pixels nearest to the centres of a coarser image."""
    i, j = (((np.arange(n) + 0.5) * m / n).astype(int) for n, m in zip((rows, columns), depth.shape, strict=True))
    return depth[np.ix_(i, j)]


@dataclass
class _Latest:
    """A message and when it came, s."""

    value: Any
    at: float


class Navigator:
    """Keeps the latest messages and turns them into velocities."""

    def __init__(self, runner: Runner) -> None:
        self.runner = runner
        pitch = runner.card.lidar.mount_pitch
        s, c = math.sin(pitch), math.cos(pitch)
        # the Mid-360 hangs upside down in the head
        self._mount = np.array([[c, 0.0, -s], [0.0, -1.0, 0.0], [-s, 0.0, -c]], np.float32)
        self._latest: dict[str, _Latest] = {}
        self._goal: tuple[NDArray[np.float64], float] | None = None

    def hear(self, topic: str, message: Any, now: float) -> None:
        """A message of "cloud", "odom", "depth", "proprioception" or "goal" at the time ``now``, s."""
        if topic == "goal":
            p = message.pose.position
            self._goal = np.array([p.x, p.y, p.z]), angles(message.pose.orientation)[2]
        else:
            self._latest[topic] = _Latest(message, now)

    def velocity(self, now: float) -> tuple[float, float, float]:
        """Forward, left, m/s, and turn, rad/s, for the next period; the robot stands where something is missing."""
        card = self.runner.card
        needed = {"cloud": True, "odom": True, "depth": card.depth, "proprioception": card.proprioception}
        wanted = {topic for topic, need in needed.items() if need}
        fresh = {topic for topic, latest in self._latest.items() if now - latest.at <= STALE}
        if self._goal is None or wanted - fresh:
            return STAND
        pose = self._latest["odom"].value.pose.pose
        roll, pitch, yaw = angles(pose.orientation)
        depth = None
        if (spec := card.depth) is not None:
            depth = subsample(image(self._latest["depth"].value), spec.rows, spec.columns)
        out = self.runner(
            Sensed(
                position=[pose.position.x, pose.position.y, pose.position.z - BASE],
                yaw=yaw,
                goal=self._goal[0],
                goal_yaw=self._goal[1],
                points=points(self._latest["cloud"].value) @ self._mount.T,
                tilt=(roll, pitch),
                depth=depth,
                proprioception=self._latest["proprioception"].value.data if card.proprioception else (),
            )
        )
        forward, left, turn = map(float, out.command)
        return forward, left, turn


def main() -> None:
    """Wire a `Navigator` to ROS."""
    try:
        import rclpy
        from geometry_msgs.msg import PoseStamped, Twist
        from nav_msgs.msg import Odometry
        from rclpy.qos import qos_profile_sensor_data
        from sensor_msgs.msg import Image, PointCloud2
        from std_msgs.msg import Float32MultiArray
    except ImportError as error:
        sys.exit(f"error: {error.name} is missing; source a ROS 2 installation first")
    rclpy.init()
    node = rclpy.create_node("romnav")
    navigator = Navigator(Runner(Path(sys.argv[1])))

    def now() -> float:
        return node.get_clock().now().nanoseconds * 1e-9

    kinds = {"cloud": PointCloud2, "odom": Odometry, "goal": PoseStamped}
    if navigator.runner.card.depth:
        kinds["depth"] = Image
    if navigator.runner.card.proprioception:
        kinds["proprioception"] = Float32MultiArray
    for topic, kind in kinds.items():
        quality = 10 if topic == "goal" else qos_profile_sensor_data
        node.create_subscription(kind, topic, lambda m, topic=topic: navigator.hear(topic, m, now()), quality)
    publisher = node.create_publisher(Twist, "cmd_vel", 10)

    def tick() -> None:
        twist = Twist()
        twist.linear.x, twist.linear.y, twist.angular.z = navigator.velocity(now())
        publisher.publish(twist)

    node.create_timer(navigator.runner.card.period, tick)
    rclpy.spin(node)


if __name__ == "__main__":
    main()
