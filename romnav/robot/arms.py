"""What the robot's own arms hide from the sensors in its head."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import torch
from torch import Tensor

from romnav.robot.g1 import HEAD, build_spec
from romnav.robot.spec import RobotSpec
from romnav.robot.statics import NOTHING

STEP = math.radians(3.0)
"""Spacing of the table, rad."""
ROLL, PITCH = (-5, 5), (-4, 12)
"""First and last roll and pitch of the torso in the table, steps: a walking torso leans forward by 0.1 to 0.55 rad."""
_ARM = ("shoulder", "elbow", "wrist")
_ARM_GROUP = 5


class OwnArms:
    """Pixels that the fixed arms hide, tabulated over the torso's tilt.

    A camera turns with the torso and the arms, so its table has one entry. The LiDAR's image is levelled: the arms move
    in it as the torso tilts.

    Args:
        robot: The arms are its visual meshes, at its elbow angle.
        directions: (rows, columns, 3) of the pixels, levelled or in the torso frame.
        levelled: Which of the two.
        device: Of tilts and masks.
    """

    def __init__(self, robot: RobotSpec, directions: Tensor, *, levelled: bool, device: str = "cpu") -> None:
        self._low, self._high = torch.tensor([ROLL, PITCH] if levelled else [(0, 0), (0, 0)], device=device).T
        rolls, pitches = (
            np.arange(a, b + 1) * STEP for a, b in zip(self._low.tolist(), self._high.tolist(), strict=True)
        )
        model = build_spec(robot, NOTHING, visual=True).compile()
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        own = [
            model.geom_contype[g] == model.geom_conaffinity[g] == 0
            and any(part in model.body(model.geom_bodyid[g]).name for part in _ARM)
            for g in range(model.ngeom)
        ]
        model.geom_group[:] = np.where(own, _ARM_GROUP, 0)
        head = data.body("torso_link").xpos + HEAD
        rays = directions.double().cpu().numpy()
        hidden = [[_hits(model, data, head, rays @ _turn(roll, pitch)) for pitch in pitches] for roll in rolls]
        self._hidden = torch.from_numpy(np.array(hidden)).to(device)

    def __call__(self, tilt: Tensor) -> Tensor:
        """(E, rows, columns) whether an arm is in the way, for the nearest roll and pitch (E, 2), rad, of the table."""
        index = (tilt / STEP).round().long().clamp(self._low, self._high) - self._low
        return self._hidden[index[:, 0], index[:, 1]]


def _turn(roll: float, pitch: float) -> np.ndarray:
    """Rotation from the torso's to the levelled frame: pitch, then roll."""
    (cr, sr), (cp, sp) = ((math.cos(a), math.sin(a)) for a in (roll, pitch))
    about_y = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
    return about_y @ about_x


def _hits(model: mujoco.MjModel, data: mujoco.MjData, origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Whether rays (rows, columns, 3) meet an arm."""
    unit = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    count = rays[..., 0].size
    geom, distance = np.full(count, -1, np.int32), np.zeros(count)
    group = np.zeros(6, np.uint8)
    group[_ARM_GROUP] = 1
    mujoco.mj_multiRay(model, data, origin, unit.ravel(), group, True, -1, geom, distance, None, count, 2.0)
    return geom.reshape(rays.shape[:-1]) >= 0
