"""The safety filter before robots that are driven: a LiDAR of its own, and what it makes of their commands."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from romnav.evaluation.spec import TrialSpec
from romnav.navigation.observations import rotate
from romnav.navigation.perception import viewpoint
from romnav.navigation.spec import EnvSpec
from romnav.robot.arms import OwnArms
from romnav.robot.dynamics import Body, Dynamics
from romnav.robot.spec import RobotSpec
from romnav.safety.barrier import Filtered
from romnav.safety.filter import SafetyFilter
from romnav.sensing.corruption import Corruption
from romnav.sensing.lidar import Lidar
from romnav.world.spawns import Start
from romnav.world.world import World

SCAN_NOISE = 2_000_003
"""Added to the seed of the trials for that of the scans' noise: it is not to depend on where a trial starts."""


class Shield:
    """The safety filter of ``robots`` robots, fed by a LiDAR of its own."""

    def __init__(
        self, world: World, robots: int, spec: TrialSpec, env: EnvSpec, robot: RobotSpec | None = None
    ) -> None:
        """A filter that guards ``robots`` bodies without arms, or humanoids of the kind ``robot``."""
        device = str(world.node.device)
        limits = {"forward": env.command.forward, "reverse": env.command.reverse, "lateral": env.command.lateral}
        barrier = spec.filter.filter.model_copy(update={"period": env.period, **limits})
        self._lidar = Lidar([tile.solids for tile in world.tiles], spec.sensor, device)
        self._arms = OwnArms(robot, self._lidar.directions, levelled=True, device=device) if robot else None
        self._corruption = Corruption(spec.corruption, spec.seed + SCAN_NOISE, device)
        self._filter = SafetyFilter(robots, spec.filter.model_copy(update={"filter": barrier}), device)
        self._mount = torch.tensor([0.0, 0.0, spec.sensor.height], device=device)
        self._pose = torch.full((robots, 4), torch.nan, device=device)

    def __call__(self, robot: Dynamics, guarded: Tensor, velocity: Tensor, noise: Tensor, step: int) -> Filtered:
        """Filter velocities (B, 2) of the robots ``guarded`` (B,), with sensor noise ``noise`` (B,)."""
        tile, position, yaw = robot.tile[guarded], robot.position[guarded], robot.yaw[guarded]
        origin, heading, tilt = viewpoint(robot, self._mount)
        origin, heading, tilt = origin[guarded], heading[guarded], None if tilt is None else tilt[guarded]
        ranges = self._lidar.scan(tile.to(torch.int32), origin, heading, tilt=tilt)
        if self._arms is not None and tilt is not None:
            ranges = torch.where(self._arms(tilt), 0.0, ranges)
        ranges = self._corruption(ranges, noise, torch.full_like(noise, step))
        points = ranges[..., None] * self._lidar.directions
        if tilt is None:
            points = points + self._mount
        else:
            # the image is levelled, but the head is turned and ahead of the feet
            above = torch.cat([rotate((origin - position)[:, :2], yaw), (origin - position)[:, 2:]], dim=1)
            turned = rotate(points[..., :2].flatten(1, 2), yaw - heading).view_as(points[..., :2])
            points = torch.cat([turned, points[..., 2:]], dim=-1) + above[:, None, None]
        pose = torch.cat([position, yaw[:, None]], dim=1)
        moved = pose - self._pose
        motion = torch.cat([rotate(moved[:, :2], self._pose[:, 3]), moved[:, 2:]], dim=1)
        self._pose = pose
        return self._filter(points.flatten(1, 2), velocity, (ranges > 0).flatten(1), motion)

    def reset(self, robots: Tensor) -> None:
        """Forget what the robots ``robots`` (K,) have seen: they are somewhere else."""
        moved = torch.zeros(len(self._pose), dtype=torch.bool, device=self._pose.device)
        moved[robots] = True
        self._filter.reset(moved)
        self._pose[robots] = torch.nan

    def select(self, keep: Tensor) -> None:
        """Keep only the robots ``keep`` (K,)."""
        self._filter.select(keep)
        self._pose = self._pose[keep]


class Guarded:
    """Robots that `body` makes behind the safety filter: they follow what it lets through of a command.

    Whoever drives them knows its own commands, not the filtered ones. Sensor noise is named by robot and step.
    """

    def __init__(
        self,
        body: Body,
        spec: TrialSpec,
        env: EnvSpec,
        robot: RobotSpec | None,
        world: World,
        robots: int,
        period: float,
    ) -> None:
        """Arguments as of `Shield`; ``robots`` in ``world``, commanded every ``period`` s."""
        self._robot: Dynamics = body(world, robots, period)
        self._shield = Shield(world, robots, spec, env, robot)
        self._noise = torch.arange(robots, device=self._robot.position.device)
        self._step = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._robot, name)

    def reset(self, envs: Tensor, start: Start) -> None:
        """Put the robots ``envs`` (K,) at their starts."""
        self._robot.reset(envs, start)
        self._shield.reset(envs)

    def select(self, envs: Tensor) -> None:
        """Keep only the robots ``envs`` (K,), in that order."""
        self._robot.select(envs)
        self._shield.select(envs)
        self._noise = self._noise[envs]

    def step(self, command: Tensor) -> None:
        """Track what the filter leaves of the command (E, 3) for one period."""
        self._step += 1
        every = torch.arange(len(command), device=command.device)
        safe = self._shield(self._robot, every, command[:, :2], self._noise, self._step)
        self._robot.step(torch.cat([safe.velocity, command[:, 2:]], dim=1))
