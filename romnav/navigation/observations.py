"""Observations of the navigation policy and its privileged critic (paper, Sec. III-B): one function, whoever asks."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol, TypeVar

import torch
from tensordict import TensorDict
from torch import Tensor

from romnav.robot.dynamics import Dynamics
from romnav.world.world import World

PATCH = 9
"""Cells along each side of the critic's local occupancy patch."""
PATCH_STEP = 0.4
"""Spacing of the patch, m."""
GOAL_SIZE = 6
ACTIONS = 3
STATE_SIZE = GOAL_SIZE + ACTIONS
"""Non-visual observation on the reduced-order model; on the humanoid, proprioception follows."""
PRIVILEGED_SIZE = PATCH * PATCH + 8


class Located(Protocol):
    """What an observation takes of a robot, simulated or not."""

    position: Tensor
    """(E, 3) m."""
    yaw: Tensor
    """(E,) rad."""

    @property
    def proprioception(self) -> Tensor:
        """(E, P)."""
        ...


R = TypeVar("R", bound=Located)
Perceive = Callable[[Dynamics, Tensor], dict[str, Tensor]]
"""(robots, counters (E, 2) naming environment and step) -> tokens or images (E, ...) by sensor."""


def wrap(angle: Tensor) -> Tensor:
    """Angle in [-pi, pi), rad."""
    return torch.remainder(angle + torch.pi, 2 * torch.pi) - torch.pi


def rotate(xy: Tensor, yaw: Tensor) -> Tensor:
    """Rotate (E, ..., 2) into frames turned by ``yaw`` (E,) from the frame of ``xy``."""
    shape = (-1,) + (1,) * (xy.dim() - 2)
    c, s = torch.cos(yaw).view(shape), torch.sin(yaw).view(shape)
    return torch.stack([c * xy[..., 0] + s * xy[..., 1], c * xy[..., 1] - s * xy[..., 0]], dim=-1)


def goal_observation(position: Tensor, yaw: Tensor, goal: Tensor, goal_yaw: Tensor, d_max: float) -> Tensor:
    """``[dx, dy, log|d| / log d_max, dz, sin g, cos g]`` (E, 6) in the robot's yaw frame, m.

    ``position`` and ``goal`` (E, 3) are in the tile frame. The logarithm is cut at 0.1 m, where it diverges.
    """
    d = goal - position
    planar = rotate(d[:, :2], yaw)
    distance = torch.linalg.vector_norm(d, dim=1).clamp(min=0.1)
    gamma = goal_yaw - yaw
    return torch.stack(
        [
            planar[:, 0],
            planar[:, 1],
            distance.log() / math.log(d_max),
            d[:, 2],
            torch.sin(gamma),
            torch.cos(gamma),
        ],
        dim=1,
    )


def observe(
    robot: R,
    goal: Tensor,
    goal_yaw: Tensor,
    previous: Tensor,
    counters: Tensor,
    perceive: Callable[[R, Tensor], dict[str, Tensor]],
    d_max: float,
) -> TensorDict:
    """What a policy may know, in training, evaluation, trials and on a robot alike.

    Args:
        robot: ``E`` of them.
        goal: (E, 3) positions, tile frame or whatever frame the robots are in, m.
        goal_yaw: (E,) headings to arrive with, rad.
        previous: (E, 3) commands of the step before, m/s and rad/s.
        counters: (E, 2) environment and step, which name the sensors' noise.
        perceive: The sensors.
        d_max: Of the goal observation, m.

    Returns:
        "state" (E, `STATE_SIZE` + P): goal, previous command, proprioception; and what the sensors see, by their names.
        So the reduced-order model's observation is the beginning of the humanoid's.
    """
    own = goal_observation(robot.position, robot.yaw, goal, goal_yaw, d_max)
    state = torch.cat([own, previous, robot.proprioception], dim=1)
    return TensorDict({**perceive(robot, counters), "state": state}, batch_size=[len(state)])


class PrivilegedObservation:
    """What only the critic sees: the geodesic, the wavefront's heading and the occupancy around the robot."""

    def __init__(self, world: World) -> None:
        self.world = world
        offset = (torch.arange(PATCH, device=world.node.device) - PATCH // 2) * PATCH_STEP
        self.offsets = torch.stack(torch.meshgrid(offset, offset, indexing="ij"), dim=-1).reshape(-1, 2)

    def __call__(
        self,
        tile: Tensor,
        layer: Tensor,
        position: Tensor,
        yaw: Tensor,
        geodesic: Tensor,
        best: Tensor,
        direction: Tensor,
        remaining: Tensor,
        arrived: Tensor,
        cross: Tensor,
    ) -> Tensor:
        """(E, `PRIVILEGED_SIZE`).

        ``best`` is the least geodesic so far, beyond which alone progress pays; ``direction`` (E, 2) of the shortest
        path in the tile frame; ``remaining`` in [0, 1].
        """
        heading = rotate(direction, yaw)
        points = position[:, None, :2] + rotate(self.offsets.expand(len(yaw), -1, -1), -yaw)
        count = len(self.offsets)
        node = self.world.node_at(tile.repeat_interleave(count), layer.repeat_interleave(count), points.reshape(-1, 2))
        occupied = (node < 0).view(len(yaw), count).to(torch.float32)
        scalars = torch.stack(
            [geodesic / 30.0, torch.log(geodesic.clamp(min=0.05)), remaining, arrived, cross, (geodesic - best) / 30.0],
            dim=1,
        )
        return torch.cat([scalars, heading, occupied], dim=1)


def privileged_way(critic: Tensor) -> tuple[Tensor, Tensor]:
    """Direction (..., 2) of the shortest path in the robot's frame, and log of its length in m, of the critic's
    observations (..., C), which end in a `PrivilegedObservation`."""
    privileged = critic[..., -PRIVILEGED_SIZE:]
    return privileged[..., 6:8], privileged[..., 1]
