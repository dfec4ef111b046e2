"""The humanoid on MuJoCo Warp: the same robots as `g1.Humanoids`, in float32, for CUDA (and the CPU, to compare)."""

from __future__ import annotations

import mujoco_warp
import torch
import warp as wp
from torch import Tensor

from romnav.robot.g1 import Robots, Statics
from romnav.robot.spec import RobotSpec

CONTACTS, CONSTRAINTS = 48, 256
"""Room for contacts and constraint rows of one robot."""


class WarpHumanoids(Robots):
    """`Robots` stepped by MuJoCo Warp, all on one ground. Tensors that are passed and kept lie on the CPU.

    Args:
        spec: of the robot.
        ground: of all.
        count: of robots.
        device: of Warp.
    """

    def __init__(self, spec: RobotSpec, ground: Statics, count: int, *, device: str = "cuda") -> None:
        super().__init__(spec, ground, count)
        self.device = device
        with wp.ScopedDevice(device):
            self._warp = mujoco_warp.put_model(self.model)
            self._data = mujoco_warp.make_data(self.model, nworld=count, nconmax=CONTACTS, njmax=CONSTRAINTS)
        self._derive()
        self._read()

    def _array(self, name: str) -> Tensor:
        view: Tensor = wp.to_torch(getattr(self._data, name))
        return view

    def _field(self, name: str) -> Tensor:
        return self._array(name).to("cpu", copy=True)

    def _derive(self) -> None:
        """Everything that depends on positions and velocities."""
        with wp.ScopedDevice(self.device):
            mujoco_warp.fwd_position(self._warp, self._data)
            mujoco_warp.sensor_pos(self._warp, self._data)
            mujoco_warp.fwd_velocity(self._warp, self._data)
            mujoco_warp.sensor_vel(self._warp, self._data)

    def step(self, target: Tensor, ids: Tensor | None = None) -> None:
        """Drive the joints towards position targets (n, 15), rad, for one control step (20 ms); all, or only `ids`."""
        names = ("qpos", "qvel", "qacc_warmstart", "actuator_force")
        rest = torch.ones(self.count, dtype=torch.bool)
        rest[slice(None) if ids is None else ids] = False
        kept = {name: self._array(name)[rest].clone() for name in names}
        self._array("ctrl").copy_(target)
        with wp.ScopedDevice(self.device):
            for _ in range(self.spec.decimation):
                mujoco_warp.step(self._warp, self._data)
        touch = self._field("sensordata")[:, self._touch] > 0
        for name, value in kept.items():
            self._array(name)[rest] = value
        self.touch = torch.where(rest[:, None], self.touch, touch)
        self.torque = self._field("actuator_force")
        self._derive()
        self._read()

    def set_state(self, ids: Tensor, qpos: Tensor, qvel: Tensor) -> None:
        """Put robots `ids` into states (k, 22) and (k, 21); they touch nothing until they are stepped."""
        for name, value in (("qpos", qpos), ("qvel", qvel)):
            self._array(name)[ids] = value.float().to(self.device)
        self._array("qacc_warmstart")[ids] = 0.0
        self.touch[ids], self.torque[ids] = False, 0.0
        self._derive()
        self._read()

    def state(self, ids: Tensor) -> tuple[Tensor, Tensor]:
        """States (k, 22) and (k, 21) of robots `ids`, float32."""
        return self._field("qpos")[ids], self._field("qvel")[ids]
