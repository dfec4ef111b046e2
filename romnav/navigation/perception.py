"""From robots to tokens: what the sensors in their heads see, corrupted and encoded once per step."""

from __future__ import annotations

import torch
from torch import Tensor

from romnav.robot.arms import OwnArms
from romnav.robot.dynamics import Dynamics
from romnav.sensing.corruption import Corruption
from romnav.sensing.depth import DepthCamera
from romnav.sensing.encoder import Encoder
from romnav.sensing.lidar import Lidar


def viewpoint(robot: Dynamics, mount: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
    """Origin (E, 3), m, yaw (E,) and tilt (E, 2), rad, of the sensors in the heads of ``robot``.

    A body without a head has them upright at ``mount`` (3,) above the ground that it stands on (paper, Sec. III-C).
    """
    head = robot.head
    if head is None:
        return robot.position + mount, robot.yaw, None
    return head.origin, head.yaw, head.tilt


class Eye:
    """One sensor, what is done to its images, and the frozen encoder of them.

    Args:
        sensor: LiDAR or depth camera.
        corruption: Of its images.
        encoder: Of its images.
        arms: What the robot's own arms hide, where it has any.
    """

    def __init__(
        self, sensor: Lidar | DepthCamera, corruption: Corruption, encoder: Encoder, arms: OwnArms | None = None
    ) -> None:
        self.sensor = sensor
        self.corruption = corruption
        self.encoder = encoder
        self.arms = arms
        self.mount = torch.tensor([0.0, 0.0, sensor.spec.height], device=encoder.directions.device)
        """(3,) of a sensor without a head, above the ground, m."""

    def ranges(self, robot: Dynamics, counters: Tensor) -> Tensor:
        """(E, rows, columns) images in m, 0 where there is no return.

        Args:
            robot: Carries the sensor in its head.
            counters: (E, 2) environment and step, which name the random numbers of the corruption.
        """
        origin, yaw, tilt = viewpoint(robot, self.mount)
        ranges = self.sensor.scan(robot.tile.to(torch.int32), origin, yaw, tilt=tilt)
        if self.arms is not None and tilt is not None:
            ranges = torch.where(self.arms(tilt), 0.0, ranges)
        return self.corruption(ranges, counters[:, 0], counters[:, 1])


class Perception:
    """What a policy sees of the world: "lidar", and "depth" if it has a camera.

    While the LiDAR's encoder is frozen, rollouts keep its tokens in bfloat16, never images: they are all that learning
    needs.
    """

    def __init__(self, lidar: Eye, depth: Eye | None = None) -> None:
        self.lidar = lidar
        self.depth = depth
        self.images = False
        """Whether "lidar" is images, for a policy that has an encoder of its own."""

    @property
    def encoder(self) -> Encoder:
        """The LiDAR's."""
        return self.lidar.encoder

    def __call__(self, robot: Dynamics, counters: Tensor) -> dict[str, Tensor]:
        """(E, K, C) bfloat16 tokens of each sensor; of the LiDAR (E, rows, columns) float16 images in m, 8 mm exact at
        16 m, if it is to be `images`. ``counters`` (E, 2) are environment and step."""
        ranges = self.lidar.ranges(robot, counters)
        seen = {"lidar": ranges.half() if self.images else self.encoder.tokens(ranges).to(torch.bfloat16)}
        if self.depth is not None:
            seen["depth"] = self.depth.encoder.tokens(self.depth.ranges(robot, counters)).to(torch.bfloat16)
        return seen
