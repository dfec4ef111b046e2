"""What turns a velocity command into a `Reference` for the joints, batched."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from romnav.kernels import wp
from romnav.robot.g1 import SOLE, Robots
from romnav.robot.heights import Heights
from romnav.robot.locomotion.legs import Legs
from romnav.robot.locomotion.lip import gait_of
from romnav.robot.locomotion.reference import State, Targets, refer
from romnav.robot.spec import GaitSpec

plain = partial(wp.from_torch, return_ctype=True)
vec3, mat33 = (partial(plain, dtype=dtype) for dtype in (wp.vec3, wp.mat33))


@dataclass
class Reference:
    """What the gait asks for now; world frame unless said otherwise, metres, seconds, radians.

    Attributes:
        side: (n,) +1 where the left foot stands.
        phase: (n,) part of the step done.
        joints: (n, 2, 6) leg joint angles from inverse kinematics.
        torque: (n, 2, 6) that carries the weight, N m.
        com, com_velocity: (n, 2) orbit relative to the stance foot, heading frame.
        height: (n,) of the pelvis.
        heading: (n,) reference heading.
        swing: (n, 3) swing sole now.
        foothold: (n, 3) where it is to land.
        sole: (n, 2, 3) both soles as they are.
        ground: (n,) mean ground height under both feet.
    """

    side: Tensor
    phase: Tensor
    joints: Tensor
    torque: Tensor
    com: Tensor
    com_velocity: Tensor
    height: Tensor
    heading: Tensor
    swing: Tensor
    foothold: Tensor
    sole: Tensor
    ground: Tensor


class Walker:
    """Phase clock, footholds and swing of a batch of robots: turns a velocity command into a `Reference`.

    `STATE` names what it remembers of each robot: the clock, where the swing foot left the ground, where it is
    to land, where the stance foot was to land and whether it has, the mean ground height at the start of the
    step, the heading and velocity it follows, the integral of the velocity's error, and the last solution of the
    inverse kinematics. These tensors and those of the `reference` are changed in place, every control step.

    Attributes:
        gait: the specification, for kernels.
        reference, targets: of the last control step; the latter for kernels.
    """

    STATE = ("clock", "lift", "foothold", "planted", "landed", "base", "heading", "command", "integral", "joints")

    def __init__(self, spec: GaitSpec, legs: Legs, control_dt: float, count: int) -> None:
        self.spec, self.legs = spec, legs
        self.gait = gait_of(spec, control_dt)
        self.clock = torch.zeros(count, dtype=torch.long)
        self.lift = torch.zeros(count, 3)
        self.foothold = torch.zeros(count, 3)
        self.planted = torch.zeros(count, 3)
        self.landed = torch.ones(count, dtype=torch.bool)
        self.base = torch.zeros(count)
        self.heading = torch.zeros(count)
        self.command = torch.zeros(count, 3)
        self.integral = torch.zeros(count, 2)
        self.joints = self.stance().expand(count, 2, 6).clone()
        n, zeros = count, torch.zeros
        self._ankle, self._ankle_rotation = zeros(n, 2, 3), zeros(n, 2, 3, 3)
        self.reference = Reference(
            side=zeros(n), phase=zeros(n), joints=self.joints, torque=zeros(n, 2, 6), com=zeros(n, 2),
            com_velocity=zeros(n, 2), height=zeros(n), heading=zeros(n), swing=zeros(n, 3), foothold=zeros(n, 3),
            sole=zeros(n, 2, 3), ground=zeros(n),
        )  # fmt: skip
        self._state = _struct(State, vars(self))
        ankles = {"ankle": self._ankle, "ankle_rotation": self._ankle_rotation}
        self.targets = _struct(Targets, vars(self.reference) | ankles)

    def stance(self) -> Tensor:
        """Leg joints (1, 2, 6) of standing at the nominal height with the feet apart."""
        y = self.spec.width / 2
        ankle = torch.tensor(
            [[[-SOLE[0], y, -self.spec.pelvis - SOLE[2]], [-SOLE[0], -y, -self.spec.pelvis - SOLE[2]]]]
        )
        start = torch.tensor([-0.3, 0.0, 0.0, 0.6, -0.3, 0.0]).expand(1, 2, 6)
        return self.legs.inverse(ankle, torch.eye(3).expand(1, 2, 3, 3), start, iterations=20)

    def reset(self, ids: Tensor, clock: Tensor, heading: Tensor, velocity: Tensor) -> None:
        """Start robots `ids` at `clock` (k,), a multiple of the step's ticks, with their feet side by side and
        `velocity` (k, 2), m/s, in the heading frame."""
        self.command[ids, :2] = velocity
        self.command[ids, 2] = 0.0
        self.integral[ids] = 0.0
        self.clock[ids] = clock
        self.heading[ids] = heading
        self.joints[ids] = self.stance().expand(len(ids), 2, 6)

    def soles(self, robots: Robots) -> Tensor:
        """Centres (n, 2, 3) of the soles, left and right, world."""
        return robots.ankle + robots.ankle_rotation @ torch.tensor(SOLE)

    def update(self, robots: Robots, command: Tensor, ground: Heights, first: Tensor) -> Reference:
        """The reference of this control step, also in `reference` until the next one.

        Args:
            robots: their states.
            command: (n, 3) forward, lateral, m/s, and yaw rate, rad/s, heading frame.
            ground: walking surfaces.
            first: (n,) robots that were just reset.
        """
        r = robots
        inputs = [
            self.gait, ground.maps, vec3(command), plain(first), r.mass, vec3(r.pelvis), mat33(r.orientation),
            vec3(r.velocity), vec3(r.com), vec3(r.com_velocity), vec3(r.ankle), mat33(r.ankle_rotation),
            vec3(r.anchor), vec3(r.axis), plain(r.touch), wp.vec2i(r.feet),
        ]  # fmt: skip
        wp.launch(refer, len(command), inputs, [self._state, self.targets], device="cpu")
        self.joints.copy_(self.legs.inverse(self._ankle, self._ankle_rotation, self.joints))
        return self.reference


def _struct(kind: Any, tensors: Mapping[str, Tensor]) -> Any:
    """A Warp struct of arrays that are tensors."""
    struct = kind()
    for name, variable in kind.vars.items():
        setattr(struct, name, wp.from_torch(tensors[name], dtype=variable.type.dtype))
    return struct
