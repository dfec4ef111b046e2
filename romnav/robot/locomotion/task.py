"""The locomotion task: robots that are to walk as commanded, as a vectorised environment for rsl-rl."""

from __future__ import annotations

from typing import Any

import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict
from torch import Tensor

from romnav.robot.g1 import Humanoids, Robots
from romnav.robot.heights import Heights
from romnav.robot.locomotion.clf import Clf
from romnav.robot.locomotion.control import TARGETS, Controller, has_fallen
from romnav.robot.locomotion.mirror import PRIVILEGED_MIRROR, reflect
from romnav.robot.locomotion.planar import heading_of, turn_xy, wrap
from romnav.robot.locomotion.walker import Reference
from romnav.robot.spec import LocomotionSpec


def tracking_error(
    robots: Robots, ref: Reference, foot_rate: Tensor, height_rate: Tensor, turn: Tensor
) -> tuple[Tensor, Tensor]:
    """Errors and their rates (n, 11) of the outputs: centre of mass (2), height, tilt and yaw (3), swing sole (3),
    its roll and pitch (2).

    Args:
        foot_rate: (n, 3) velocity of the swing sole less its reference's, m/s.
        height_rate: (n,) of the reference, m/s.
        turn: (n,) commanded yaw rate, rad/s.
    """
    rows = torch.arange(robots.count)
    stance, swing = (ref.side < 0).long(), (ref.side > 0).long()
    x = turn_xy(robots.com[:, :2] - ref.sole[rows, stance, :2], -ref.heading)
    v = turn_xy(robots.com_velocity[:, :2], -ref.heading)
    yaw = heading_of(robots.orientation)
    foot_down = robots.ankle_rotation[rows, swing][:, 2, :2]
    error = torch.cat(
        [x - ref.com, (robots.pelvis[:, 2] - ref.height)[:, None], robots.orientation[:, 2, :2],
         wrap(yaw - ref.heading)[:, None], ref.sole[rows, swing] - ref.swing, foot_down], dim=1,
    )  # fmt: skip
    spin = robots.spin
    rate = torch.cat(
        [v - ref.com_velocity, (robots.velocity[:, 2] - height_rate)[:, None], -spin[:, 1:2], spin[:, :1],
         (spin[:, 2] - turn)[:, None], foot_rate, torch.zeros_like(foot_down)], dim=1,
    )  # fmt: skip
    return error, rate


class WalkingEnv(VecEnv):
    """Robots that are to walk as commanded: reward, observation, pushes. Where, and who commands, is a subclass's.

    Args:
        spec: of the task.
        robots: that walk.
        ground: under them.
        seed: of everything random.
    """

    STATE: tuple[str, ...] = (
        "command", "episode_length_buf", "average", "value", "_slope", "_reward", "first",
    )  # fmt: skip
    """What changes besides robots and controller."""

    def __init__(self, spec: LocomotionSpec, robots: Humanoids, ground: Heights, seed: int) -> None:
        self.spec, self.cfg = spec, spec.model_dump()
        self.robots, self.heights = robots, ground
        t, n = spec.task, robots.count
        self.num_envs, self.num_actions, self.device = n, TARGETS, "cpu"
        self.control = Controller(spec, self.robots)
        self.dt = self.control.dt
        self.max_episode_length = round(t.episode / self.dt)
        self.random = torch.Generator().manual_seed(seed)
        self.clf = Clf(spec.clf.rate_time, spec.clf.effort)
        c = spec.clf
        self._tolerance = torch.tensor([c.com] * 2 + [c.height] + [c.tilt] * 3 + [c.swing] * 3 + [c.foot] * 2)
        self.command = torch.zeros(n, 3)
        self.episode_length_buf = torch.zeros(n, dtype=torch.long)
        self.average = torch.zeros(n, 3)
        self.value, self._slope, self._reward = torch.zeros(n), torch.zeros(n), torch.zeros(n)
        self._last = {
            "action": torch.zeros(n, TARGETS),
            "sole": torch.zeros(n, 3),
            "swing": torch.zeros(n, 3),
            "height": torch.zeros(n),
        }
        self.friction = self._uniform(*t.friction)
        self.payload = self._uniform(*t.payload)
        self.robots.randomize(self.friction, self.payload)
        self.first = torch.ones(n, dtype=torch.bool)

    def _begin(self) -> None:
        """Place all robots for the first time."""
        self._place(torch.arange(self.num_envs))
        self._refer()

    def _start(self, ids: Tensor) -> tuple[Tensor, Tensor]:
        """Begin episodes of robots `ids` and command them; position (k, 3) of the ground and heading (k,) there."""
        raise NotImplementedError

    def _drive(self) -> None:
        """Command the robots in the state that they are in now."""
        raise NotImplementedError

    def _judge(self, fell: Tensor) -> tuple[Tensor, Tensor]:
        """(n,) who has failed, of those that fell and others, and (n,) whose episode is over without a failure."""
        raise NotImplementedError

    def _finish(self, ids: Tensor, fell: Tensor, over: Tensor) -> dict[str, float]:
        """Learn from episodes `ids` that have ended; what to log."""
        raise NotImplementedError

    def _renew(self, done: Tensor) -> None:
        """New commands for robots that are in the middle of an episode, not `done`."""

    def _uniform(self, low: float, high: float, count: int | None = None) -> Tensor:
        return low + (high - low) * torch.rand(self.num_envs if count is None else count, generator=self.random)

    def _draw_commands(self, k: int) -> Tensor:
        """(k, 3) commands over the whole limits: a tenth stands still, a fifth walks straight, two fifths are at the
        corners, the hardest to track."""
        t = self.spec.task
        draw = torch.stack(
            [
                self._uniform(*t.forward, k),
                self._uniform(-t.lateral, t.lateral, k),
                self._uniform(-t.turn, t.turn, k),
            ],
            1,
        )
        u = self._uniform(0.0, 1.0, k)
        draw[u < 0.1] = 0.0
        draw[(u > 0.1) & (u < 0.3), 1:] = 0.0
        corner = torch.tensor([[t.forward[0]], [t.forward[1]]])[(self._uniform(0, 1, k) < 0.5).long()]
        signs = torch.sign(self._uniform(-1.0, 1.0, 2 * k)).reshape(k, 2) * torch.tensor([t.lateral, t.turn])
        return torch.where((u > 0.6)[:, None], torch.cat([corner, signs], 1), draw)

    def _place(self, ids: Tensor) -> None:
        """Start new episodes."""
        k = len(ids)
        if k == 0:
            return
        at, heading = self._start(ids)
        clock = (self._uniform(0.0, 2.0, k)).long() * self.spec.gait.step_ticks
        self.control.stand(ids, at, heading, clock, self.command[ids])
        self.episode_length_buf[ids] = 0
        self.average[ids] = self.command[ids]
        self._last["action"][ids] = 0.0
        self.first[ids] = True

    def _refer(self) -> None:
        """Commands, the reference and V of the state as it is now."""
        self._drive()
        ref = self.control.refer(self.command, self.heights, self.first)
        rows, swing = torch.arange(self.num_envs), (ref.side > 0).long()
        sole = ref.sole[rows, swing]
        begin = self.first | (ref.phase == 0)
        rate = ((sole - self._last["sole"]) - (ref.swing - self._last["swing"])) / self.dt
        rise = (ref.height - self._last["height"]) / self.dt
        rate = torch.where(begin[:, None], 0.0, rate)
        rise = torch.where(begin, 0.0, rise).clamp(-1.0, 1.0)
        error, rates = tracking_error(self.robots, ref, rate, rise, self.command[:, 2])
        value = self.clf(error, rates, self._tolerance)
        self._slope = torch.where(begin, -self.clf.decay * value, (value - self.value) / self.dt)
        self.value = value
        self._last.update(sole=sole, swing=ref.swing.clone(), height=ref.height.clone())
        self.first = torch.zeros_like(self.first)

    def get_observations(self) -> TensorDict:
        """Observation groups `policy` and `privileged`."""
        r = self.robots
        privileged = torch.cat(
            [r.touch[:, r.feet].float(), self.friction[:, None], self.payload[:, None], self.average,
             self.value.clamp(max=20.0)[:, None] / 4], dim=1,
        )  # fmt: skip
        side = self.control.reference.side
        privileged = reflect(privileged, PRIVILEGED_MIRROR, side)
        policy = self.control.observe(self.command, self.heights)
        return TensorDict({"policy": policy, "privileged": privileged}, batch_size=[self.num_envs])

    def rewards(self) -> dict[str, Tensor]:
        """Every reward term (n,), unscaled, of the state and reference as they are now."""
        w, r = self.spec.reward, self.robots
        error = (self.average[:, :2] - self.command[:, :2]).norm(dim=1)
        turning = torch.exp(-(((self.average[:, 2] - self.command[:, 2]) / 0.4) ** 2))
        others = r.touch.sum(1) - r.touch[:, r.feet].sum(1)
        v, s = self.value, self.spec.clf.sigma
        return {
            "clf": w.clf * (torch.exp(-v / s) + 0.5 / (1.0 + v)),
            "decrease": -w.decrease * ((self._slope + self.clf.decay * v) / s).clamp(0.0, 1.0),
            "velocity": w.velocity * torch.exp(-((error / 0.2) ** 2)) * turning,
            "velocity_linear": -w.velocity_linear * error,
            "yaw": w.yaw * turning,
            "upright": -w.upright * r.orientation[:, 2, :2].square().sum(1),
            "torso": -w.torso * r.torso_rotation[:, 2, :2].square().sum(1),
            "action": -w.action * self.control.action.square().sum(1),
            "action_rate": -w.action_rate * (self.control.action - self._last["action"]).square().sum(1),
            "torque": -w.torque * r.torque.square().sum(1),
            "collision": -w.collision * others,
            "alive": torch.full_like(v, w.alive),
        }

    def fallen(self) -> Tensor:
        """(n,) pelvis too low over the ground, or tipped by more than about 55 degrees."""
        return has_fallen(self.robots)

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict[str, Any]]:
        """One control step of all robots; those that are done start again."""
        t = self.spec.task
        self._last["action"] = self.control.action
        self.control.act(actions)
        self.episode_length_buf += 1
        yaw = heading_of(self.robots.orientation)
        now = torch.cat([turn_xy(self.robots.com_velocity[:, :2], -yaw), self.robots.spin[:, 2:]], dim=1)
        self.average = self.average + (now - self.average) * (self.dt / 0.4)

        fell, over = self._judge(self.fallen())
        late = self.episode_length_buf >= self.max_episode_length
        done = fell | over | late

        ids = done.nonzero()[:, 0]
        log = {"/fell": fell.float().mean().item() / self.dt} | self._finish(ids, fell, over)
        self._place(ids)
        self._renew(done)
        chance = self._uniform(0.0, 1.0)
        pushed = ((chance < self.dt / t.push_interval) & (self.episode_length_buf > 25)).nonzero()[:, 0]
        self.robots.push(pushed, self._uniform(-t.push, t.push, 2 * len(pushed)).reshape(-1, 2))
        self._refer()

        terms = self.rewards()
        reward = (self.spec.reward.scale * torch.stack(list(terms.values())).sum(0)).clamp(min=self.spec.reward.floor)
        # A robot that has just been placed says nothing about the step that ended its last episode.
        self._reward = torch.where(done, self._reward, reward)
        log |= {f"/reward/{name}": term.mean().item() for name, term in terms.items()}
        extras = {"time_outs": (late | over) & ~fell, "log": log}
        return self.get_observations(), self._reward - self.spec.reward.fall * fell, done, extras

    def state_dict(self) -> dict[str, Any]:
        """Everything that decides the future of the run."""
        return {
            "robots": self.robots.state_dict(), "control": self.control.state_dict(),
            "random": self.random.get_state(),
            "last": {k: v.clone() for k, v in self._last.items()},
        } | {name: getattr(self, name).clone() for name in self.STATE}  # fmt: skip

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from `state_dict`."""
        state = dict(state)
        self.robots.load_state_dict(state.pop("robots"))
        self.control.load_state_dict(state.pop("control"))
        self.random.set_state(state.pop("random"))
        self._last = {k: v.clone() for k, v in state.pop("last").items()}
        for name, value in state.items():
            setattr(self, name, value.clone())
