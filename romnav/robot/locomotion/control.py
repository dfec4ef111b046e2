"""From a velocity command and a policy's residual to joint targets, and from a state to the policy's observation."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from romnav.kernels import wp
from romnav.robot.g1 import JOINTS, Robots
from romnav.robot.heights import Heights
from romnav.robot.locomotion.legs import Legs
from romnav.robot.locomotion.mirror import ACTION_MIRROR, MIRROR, reflect
from romnav.robot.locomotion.observation import observe
from romnav.robot.locomotion.planar import turn_xy
from romnav.robot.locomotion.walker import Reference, Walker, mat33, plain, vec3
from romnav.robot.spec import LocomotionSpec

SCAN = tuple((x, y) for y in (-0.15, 0.15) for x in np.linspace(-0.4, 1.0, 15))
"""Height scan ahead of and beside the pelvis in the heading frame, m."""
TARGETS = len(JOINTS)


def has_fallen(robots: Robots) -> Tensor:
    """(n,) pelvis less than 0.42 m over the lower foot, or tipped by more than about 55 degrees; or lost."""
    up = robots.pelvis[:, 2] - robots.ankle[..., 2].amin(1) >= 0.42
    finite = robots.joint_velocity.isfinite().all(1) & robots.velocity.isfinite().all(1)
    return ~(up & (robots.orientation[:, 2, 2] >= 0.57) & finite) | robots.lost


class Controller:
    """What turns a velocity command and a policy's residual into joint targets, and a state into an observation.

    Training, evaluation, the gait library and the navigation stage all walk through this one class.
    """

    def __init__(self, spec: LocomotionSpec, robots: Robots) -> None:
        self.spec, self.robots = spec, robots
        self.dt = spec.robot.timestep * spec.robot.decimation
        self.legs = Legs(robots.model)
        self.walker = Walker(spec.gait, self.legs, self.dt, robots.count)
        self.action = torch.zeros(robots.count, TARGETS)
        self._rest = torch.cat([self.walker.stance().reshape(12), torch.zeros(3)])
        scan = wp.array(SCAN, dtype=wp.vec2, device="cpu")
        self._constants = [wp.from_torch(self._rest), scan, *map(wp.from_torch, MIRROR)]

    @property
    def reference(self) -> Reference:
        """That of this control step."""
        return self.walker.reference

    def stand(self, ids: Tensor, position: Tensor, heading: Tensor, clock: Tensor, command: Tensor) -> None:
        """Put robots `ids` on their feet at `position` (k, 3) (the ground's height), beginning a step.

        They start with the sideways velocity the gait has at the beginning of a step, and half the commanded one.
        """
        k, gait = len(ids), self.spec.gait
        half = torch.stack([torch.cos(heading / 2), torch.zeros(k), torch.zeros(k), torch.sin(heading / 2)], dim=1)
        lift = position + torch.tensor([0.0, 0.0, gait.pelvis + 0.003])
        qpos = torch.cat([lift, half, self._rest.expand(k, -1)], dim=1)
        side = torch.where(clock < gait.step_ticks, 1.0, -1.0)
        w, duration = self.walker.gait.w, self.walker.gait.duration
        sway = side * gait.width / 2 * w * np.tanh(w * duration / 2)
        start = 0.5 * command[:, :2].clamp(-0.5, 0.5)
        velocity = start + torch.stack([torch.zeros(k), sway], dim=1)
        qvel = torch.zeros(k, 6 + TARGETS)
        qvel[:, :2] = turn_xy(velocity, heading)
        self.robots.set_state(ids, qpos, qvel)
        self.walker.reset(ids, clock, heading, start)
        self.action[ids] = 0.0

    def refer(self, command: Tensor, ground: Heights, first: Tensor) -> Reference:
        """Reference of this control step, (n,) `first` for robots just placed."""
        return self.walker.update(self.robots, command, ground, first)

    def act(self, action: Tensor, ids: Tensor | None = None) -> None:
        """Step robots with residual actions (n, 15) as seen in the mirror of `observe`; all, or only `ids`."""
        self.action = reflect(action.clamp(-4.0, 4.0), ACTION_MIRROR, self.reference.side)
        target = self.spec.task.action_scale * self.action
        target[:, :12] += self.reference.joints.flatten(1) + self.reference.torque.flatten(1) / self.robots.kp[:12]
        self.robots.step(target, ids)

    def observe(self, command: Tensor, ground: Heights) -> Tensor:
        """Observation (n, d) of the policy, mirrored (by `MIRROR`) while the right foot stands.

        The policy always sees itself standing on the left foot, so it is left-right symmetric by construction
        and learns one step instead of two.
        """
        r, index = self.robots, MIRROR[0]
        seen = torch.empty(len(command), len(index))
        inputs = [
            ground.maps, self.walker.targets, vec3(command), vec3(r.pelvis), mat33(r.orientation), vec3(r.spin),
            vec3(r.com_velocity), plain(r.joints), plain(r.joint_velocity), plain(self.action),
            plain(self.reference.joints.flatten(1)), *self._constants,
        ]  # fmt: skip
        wp.launch(observe, len(command), inputs, [plain(seen)], device="cpu")
        return seen

    def snapshot(self, ids: Tensor) -> dict[str, Tensor]:
        """State of robots `ids` and of their gait, before `refer`: what `restore` needs to go on walking."""
        qpos, qvel = self.robots.state(ids)
        return (
            {"qpos": qpos, "qvel": qvel}
            | {name: getattr(self.walker, name)[ids].clone() for name in Walker.STATE}
            | {"action": self.action[ids].clone()}
        )

    def restore(self, ids: Tensor, state: dict[str, Tensor]) -> None:
        """Put robots `ids` into a `snapshot`."""
        self.robots.set_state(ids, state["qpos"], state["qvel"])
        for name in Walker.STATE:
            getattr(self.walker, name)[ids] = state[name]
        self.action[ids] = state["action"]

    def part(self, ids: Tensor, robots: Robots) -> Controller:
        """That of robots `ids` (k,) alone, which are `robots` now."""
        part = Controller(self.spec, robots)
        for name in Walker.STATE:
            getattr(part.walker, name).copy_(getattr(self.walker, name)[ids])
        part.action = self.action[ids]
        return part

    def state_dict(self) -> dict[str, Any]:
        """State besides the robots'."""
        return {name: getattr(self.walker, name).clone() for name in Walker.STATE} | {
            "action": self.action.clone(),
            "reference": {name: value.clone() for name, value in vars(self.reference).items()},
        }  # fmt: skip

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from `state_dict`."""
        for name in Walker.STATE:
            getattr(self.walker, name).copy_(state[name])
        for name, value in state["reference"].items():
            getattr(self.reference, name).copy_(value)
        self.action = state["action"].clone()
