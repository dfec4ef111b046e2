"""What turns a velocity command into a `Reference` for the joints, batched."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from romnav.kernels import wp
from romnav.robot.g1 import SOLE, Robots
from romnav.robot.heights import Heights
from romnav.robot.locomotion.legs import Legs
from romnav.robot.locomotion.lip import gait_of
from romnav.robot.locomotion.reference import State, carry, refer
from romnav.robot.spec import GaitSpec

_scalar = partial(wp.from_torch, return_ctype=True)
_vec2, _vec3, _mat33 = (partial(_scalar, dtype=dtype) for dtype in (wp.vec2, wp.vec3, wp.mat33))


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
    inverse kinematics. These tensors are changed in place.
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
        self._state = State()
        for name, variable in State.vars.items():
            setattr(self._state, name, wp.from_torch(getattr(self, name), dtype=variable.type.dtype))

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
        """The reference of this control step.

        Args:
            robots: their states.
            command: (n, 3) forward, lateral, m/s, and yaw rate, rad/s, heading frame.
            ground: walking surfaces.
            first: (n,) robots that were just reset.
        """
        n, r = len(command), robots
        side, phase, height, heading, mean = (torch.empty(n) for _ in range(5))
        com, com_velocity = torch.empty(n, 2), torch.empty(n, 2)
        swing, foothold = torch.empty(n, 3), torch.empty(n, 3)
        sole, position = torch.empty(n, 2, 3), torch.empty(n, 2, 3)
        turn, torque = torch.empty(n, 2, 3, 3), torch.empty(n, 2, 6)
        inputs = [
            self.gait, ground.maps, _vec3(command), _scalar(first), _vec3(r.pelvis), _mat33(r.orientation),
            _vec3(r.velocity), _vec3(r.com), _vec3(r.com_velocity), _vec3(r.ankle), _mat33(r.ankle_rotation),
            _scalar(r.touch), wp.vec2i(r.feet),
        ]  # fmt: skip
        outputs = [
            self._state, _scalar(side), _scalar(phase), _vec2(com), _vec2(com_velocity), _scalar(height),
            _scalar(heading), _vec3(swing), _vec3(foothold), _vec3(sole), _scalar(mean), _vec3(position), _mat33(turn),
        ]  # fmt: skip
        wp.launch(refer, n, inputs, outputs, device="cpu")
        inputs = [
            self.gait, r.mass, _vec3(r.com), _vec3(sole), _vec3(r.anchor), _vec3(r.axis), _scalar(side), _scalar(phase),
        ]  # fmt: skip
        wp.launch(carry, (n, 2), inputs, [_scalar(torque)], device="cpu")
        joints = self.legs.inverse(position, turn, self.joints)
        self.joints.copy_(joints)
        return Reference(side, phase, joints, torque, com, com_velocity, height, heading, swing, foothold, sole, mean)
