"""A policy on a robot: sensors and odometry in, a safe velocity out, once a control period."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from pydantic import ValidationError
from torch import Tensor

from romnav.deploy import card as cards
from romnav.deploy.card import Card
from romnav.deploy.export import need
from romnav.errors import RomnavError
from romnav.navigation.observations import observe, rotate
from romnav.robot.g1 import HEAD
from romnav.safety.barrier import Status
from romnav.safety.filter import SafetyFilter
from romnav.safety.spec import SafetySpec
from romnav.sensing.image import directions, level, project

OWN = 0.26
"""Returns nearer than this to the sensor are the robot's own, m: a G1 sees its arms at 0.17 to 0.24 m, and no solid
comes nearer to a body of this radius."""


@dataclass(frozen=True)
class Sensed:
    """What a robot knows in one control period.

    The goal is in the frame of the odometry: horizontal, z up, origin anywhere. Positions are of the point on the
    ground beneath the robot.
    """

    position: ArrayLike
    """(3,) m."""
    yaw: float
    """Heading of the torso, rad."""
    goal: ArrayLike
    """(3,) m."""
    goal_yaw: float
    """Heading to arrive with, rad."""
    points: ArrayLike | None = None
    """(N, 3) returns of the LiDAR in the axes of the torso (x ahead, y left, z up), origin at the sensor, m; those on
    the robot's own arms may be among them."""
    ranges: ArrayLike | None = None
    """(rows, columns) range image in place of the points, m, levelled; 0 is no return."""
    tilt: tuple[float, float] = (0.0, 0.0)
    """Roll and pitch of the torso, rad: by them the points are levelled, and they tell where the head is."""
    depth: ArrayLike | None = None
    """(rows, columns) depth image, m, for a policy that sees one."""
    proprioception: ArrayLike = ()
    """(P,) what the robot feels, for a policy that was trained with it."""


@dataclass(frozen=True)
class Velocity:
    """A command, to be held until the next one."""

    command: NDArray[np.float32]
    """(3,) forward, left, m/s, and turn, rad/s: safe. A blocked robot only turns; one whose sensors fail stands."""
    wanted: NDArray[np.float32]
    """(3,) what the policy wants."""
    status: Status
    """What the filter did."""
    seconds: float
    """Time that it took to compute."""


@dataclass
class _Robot:
    """One robot, as `observe` asks for it."""

    position: Tensor
    yaw: Tensor
    proprioception: Tensor


class Runner:
    """Runs an exported policy behind the safety filter; it keeps memory, so there is one for every robot.

    Args:
        path: File of `romnav export`.
        safety: Settings of the filter, whose limits and period are the policy's; None for no filter.
        threads: Of the network.

    Raises:
        RomnavError: The file is missing or no exported policy; onnxruntime is not installed.
    """

    def __init__(self, path: Path, safety: SafetySpec | None = SafetySpec(), threads: int = 1) -> None:  # noqa: B008
        runtime = need("onnxruntime")
        options = runtime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = threads
        self.session, self.card = _open(runtime, path, options)
        self._directions = directions(self.card.lidar)
        self._filter: SafetyFilter | None = None
        if safety is not None:
            command = self.card.command
            limits = {"forward": command.forward, "reverse": command.reverse, "lateral": command.lateral}
            barrier = safety.filter.model_copy(update={"period": self.card.period, **limits})
            self._filter = SafetyFilter(1, safety.model_copy(update={"filter": barrier}))
        self.reset()

    def reset(self) -> None:
        """Forget everything, as at a start or after a jump of the odometry. A new goal needs no reset."""
        self._memory = np.zeros(self.card.memory, np.float32)
        self._previous = torch.zeros(1, 3)
        self._pose: Tensor | None = None
        if self._filter is not None:
            self._filter.reset()

    def __call__(self, sensed: Sensed) -> Velocity:
        """The velocity for the next period.

        A number of the odometry or the goal that is not finite stops the robot, and changes no memory.

        Raises:
            RomnavError: Something that the policy needs is missing or of another shape.
        """
        began = time.perf_counter()
        position, goal = (_array(name, getattr(sensed, name), (3,)) for name in ("position", "goal"))
        angles = torch.tensor([sensed.yaw, sensed.goal_yaw, *sensed.tilt], dtype=torch.float32)
        felt = _array("proprioception", sensed.proprioception, (self.card.proprioception,))
        if not all(bool(x.isfinite().all()) for x in (position, goal, angles, felt)):
            stop = np.zeros(3, np.float32)
            return Velocity(stop, stop, Status.NOT_FINITE, time.perf_counter() - began)
        images, points = self._see(sensed)
        robot = _Robot(position[None], angles[None, 0], felt[None])
        counters = torch.zeros(1, 2, dtype=torch.int64)
        d_max = self.card.max_goal_distance
        seen = observe(robot, goal[None], angles[None, 1], self._previous, counters, lambda *_: images, d_max)
        fed = {name: seen[name].numpy() for name in (*images, "state")} | {"memory": self._memory}
        command, self._memory = self.session.run(list(cards.OUTPUTS), fed)
        self._previous = torch.from_numpy(command.copy())
        safe, status = self._guard(robot, points, self._previous)
        return Velocity(safe, command[0], status, time.perf_counter() - began)

    def _see(self, sensed: Sensed) -> tuple[dict[str, Tensor], Tensor]:
        """Images (1, rows, columns) by sensor, and returns (N, 3), levelled, from the ground beneath the robot."""
        lidar = self.card.lidar
        if (sensed.points is None) == (sensed.ranges is None):
            raise RomnavError("sensed: give the LiDAR's points or its ranges, one of them")
        if sensed.points is not None:
            points = level(_array("points", sensed.points, (None, 3)), *sensed.tilt)
            points = points[points.isfinite().all(dim=1)]
            points = points[torch.linalg.vector_norm(points, dim=1) > OWN]
            ranges = project(points, lidar)
        else:
            ranges = _array("ranges", sensed.ranges, (lidar.rows, lidar.columns)).nan_to_num(0.0, 0.0, 0.0)
            ranges = torch.where(ranges > OWN, ranges, 0.0)
            points = (ranges[..., None] * self._directions)[ranges > 0]
        images = {"lidar": ranges[None]}
        if (depth := self.card.depth) is not None:
            if sensed.depth is None:
                raise RomnavError("sensed: the policy sees through a depth camera; give its image as depth")
            images["depth"] = _array("depth", sensed.depth, (depth.rows, depth.columns)).nan_to_num(0.0, 0.0, 0.0)[None]
        return images, points + self._head(sensed.tilt)

    def _head(self, tilt: tuple[float, float]) -> Tensor:
        """(3,) of the sensor above the ground beneath the robot: it leans ahead with the torso."""
        upright = torch.tensor([HEAD])
        return torch.tensor([0.0, 0.0, self.card.lidar.height]) + (level(upright, *tilt) - upright)[0]

    def _guard(self, robot: _Robot, points: Tensor, wanted: Tensor) -> tuple[NDArray[np.float32], Status]:
        if self._filter is None:
            return wanted[0].numpy(), Status.UNCHANGED
        pose = torch.cat([robot.position, robot.yaw[:, None]], dim=1)
        before = pose if self._pose is None else self._pose
        moved = pose - before
        motion = torch.cat([rotate(moved[:, :2], before[:, 3]), moved[:, 2:]], dim=1)
        self._pose = pose
        safe = self._filter(points[None], wanted[:, :2], None, motion)
        status = Status(int(safe.status[0]))
        turn = torch.zeros(1) if status >= Status.OUTSIDE else wanted[0, 2:]
        return torch.cat([safe.velocity[0], turn]).numpy(), status


def _open(runtime: Any, path: Path, options: Any) -> tuple[Any, Card]:
    if not path.is_file():
        raise RomnavError(f"{path}: no such policy; make it by `romnav export ARM`")
    try:
        session = runtime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        return session, Card.model_validate_json(session.get_modelmeta().custom_metadata_map[cards.KEY])
    except (KeyError, ValidationError) as error:
        raise RomnavError(f"{path}: not of `romnav export` of this version; export the policy again") from error
    except Exception as error:  # onnxruntime has no class of its own for all of them
        raise RomnavError(f"{path}: truncated or no ONNX file; export the policy again") from error


def _array(name: str, value: ArrayLike | None, shape: tuple[int | None, ...]) -> Tensor:
    array = torch.from_numpy(np.ascontiguousarray(value, dtype=np.float32))
    if array.ndim != len(shape) or any(n is not None and n != m for n, m in zip(shape, array.shape, strict=True)):
        expected = ", ".join("N" if n is None else str(n) for n in shape)
        raise RomnavError(f"sensed: {name} has shape {tuple(array.shape)}; expected ({expected})")
    return array
