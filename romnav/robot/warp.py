"""The humanoid on MuJoCo Warp: the same robots as `g1.Humanoids`, in float32, for CUDA (and the CPU, to compare)."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco_warp
import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from romnav.robot.g1 import Robots
from romnav.robot.spec import RobotSpec
from romnav.robot.statics import FIELDS, Geoms

CONTACTS, CONSTRAINTS = 48, 256
"""Room for contacts and constraint rows of one robot."""


class WarpHumanoids(Robots):
    """`Robots` stepped by MuJoCo Warp. Tensors that are passed and kept lie on the CPU.

    Args:
        spec: of the robot.
        grounds: that robots may be on.
        count: of robots.
        device: of Warp.
    """

    def __init__(self, spec: RobotSpec, grounds: Sequence[Geoms], count: int, *, device: str = "cuda") -> None:
        super().__init__(spec, grounds, count)
        self.device = device
        with wp.ScopedDevice(device):
            self._warp = mujoco_warp.put_model(self.model)
            self._data = mujoco_warp.make_data(self.model, nworld=count, nconmax=CONTACTS, njmax=CONSTRAINTS)
            self._held = {name: self._each(name) for name in FIELDS}
        self._derive()

    def _each(self, name: str) -> NDArray:
        """A field of the model, from now on of each robot's own: a copy (n, ...) on the CPU."""
        shared = getattr(self._warp, name)
        each = np.repeat(shared.numpy(), self.count, axis=0)
        setattr(self._warp, name, wp.array(each, dtype=shared.dtype, ndim=shared.ndim))
        return each.reshape(self.count, *getattr(self.model, name).shape)

    def _surround(self, pelvis: NDArray[np.float64]) -> NDArray[np.int64]:
        moved = super()._surround(pelvis)
        if len(moved):
            rows = torch.from_numpy(moved).to(self.device)
            for name, held in self._held.items():
                own: Tensor = wp.to_torch(getattr(self._warp, name))
                own[rows] = torch.from_numpy(held[moved]).reshape(len(moved), *own.shape[1:]).to(self.device)
            # geoms of bodies that do not move are placed once for all by MuJoCo Warp
            place = np.ix_(moved, self._slots.ids)
            turn = Rotation.from_quat(self._held["geom_quat"][place].reshape(-1, 4), scalar_first=True).as_matrix()
            for name, value in (("geom_xpos", self._held["geom_pos"][place]), ("geom_xmat", turn)):
                at = self._array(name)
                to = torch.from_numpy(value).reshape(len(moved), -1, *at.shape[2:]).to(at)
                at[rows[:, None], torch.from_numpy(self._slots.ids).to(self.device)] = to
        return moved

    def _array(self, name: str) -> Tensor:
        view: Tensor = wp.to_torch(getattr(self._data, name))
        return view

    def _field(self, name: str) -> Tensor:
        return self._array(name).to("cpu", copy=True)

    def _derive(self, ids: NDArray | None = None) -> None:
        self._surround(self._field("qpos")[:, :3].double().numpy())
        with wp.ScopedDevice(self.device):
            mujoco_warp.fwd_position(self._warp, self._data)
            mujoco_warp.sensor_pos(self._warp, self._data)
            mujoco_warp.fwd_velocity(self._warp, self._data)
            mujoco_warp.sensor_vel(self._warp, self._data)
        self._read()

    def step(self, target: Tensor, ids: Tensor | None = None) -> None:
        """Drive the joints towards position targets (n, 15), rad, for one control step (20 ms); all, or only `ids`."""
        names = ("qpos", "qvel", "qacc_warmstart", "actuator_force")
        rest = torch.ones(self.count, dtype=torch.bool)
        rest[slice(None) if ids is None else ids] = False
        kept = {name: self._array(name)[rest].clone() for name in names}
        self._array("ctrl").copy_(target)
        self._surround(self.pelvis.double().numpy())
        with wp.ScopedDevice(self.device):
            for _ in range(self.spec.decimation):
                mujoco_warp.step(self._warp, self._data)
        touch = self._field("sensordata")[:, self._touch] > 0
        for name, value in kept.items():
            self._array(name)[rest] = value
        self.touch = torch.where(rest[:, None], self.touch, touch)
        self.torque = self._field("actuator_force")
        self._derive()

    def set_state(self, ids: Tensor, qpos: Tensor, qvel: Tensor) -> None:
        """Put robots `ids` into states (k, 22) and (k, 21); they touch nothing until they are stepped."""
        for name, value in (("qpos", qpos), ("qvel", qvel)):
            self._array(name)[ids] = value.float().to(self.device)
        self._array("qacc_warmstart")[ids] = 0.0
        self.touch[ids], self.torque[ids] = False, 0.0
        self._derive()

    def state(self, ids: Tensor) -> tuple[Tensor, Tensor]:
        """States (k, 22) and (k, 21) of robots `ids`, float32."""
        return self._field("qpos")[ids], self._field("qvel")[ids]
