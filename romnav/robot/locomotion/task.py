"""The locomotion task: velocity tracking over the terrain curriculum, as a vectorised environment for rsl-rl."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict
from torch import Tensor

from romnav.robot.g1 import JOINTS, Humanoids, Robots
from romnav.robot.locomotion.clf import Clf
from romnav.robot.locomotion.legs import Legs
from romnav.robot.locomotion.lip import Reference, Walker, turn_xy, wrap
from romnav.robot.locomotion.terrain import Ground, Heights, Lane, steer
from romnav.robot.spec import LocomotionSpec

SCAN = tuple((x, y) for y in (-0.15, 0.15) for x in np.linspace(-0.4, 1.0, 15))
"""Height scan ahead of and beside the pelvis in the heading frame, m."""
TARGETS = len(JOINTS)


def heading_of(orientation: Tensor) -> Tensor:
    """Yaw (n,) of rotations (n, 3, 3)."""
    return torch.atan2(orientation[:, 1, 0], orientation[:, 0, 0])


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
        self._scan = torch.tensor(SCAN, dtype=torch.float32)
        self._rest = torch.cat([self.walker.stance().reshape(12), torch.zeros(3)])

    def stand(self, ids: Tensor, position: Tensor, heading: Tensor, clock: Tensor, command: Tensor) -> None:
        """Put robots `ids` on their feet at `position` (k, 3) (the ground's height), beginning a step.

        They start with the sideways velocity the gait has at the beginning of a step, and half the commanded one.
        """
        k, gait = len(ids), self.spec.gait
        half = torch.stack([torch.cos(heading / 2), torch.zeros(k), torch.zeros(k), torch.sin(heading / 2)], dim=1)
        lift = position + torch.tensor([0.0, 0.0, gait.pelvis + 0.003])
        qpos = torch.cat([lift, half, self._rest.expand(k, -1)], dim=1)
        side = torch.where(clock < gait.step_ticks, 1.0, -1.0)
        w = self.walker.w
        sway = side * gait.width / 2 * w * np.tanh(w * self.walker.duration / 2)
        start = 0.5 * command[:, :2].clamp(-0.5, 0.5)
        velocity = start + torch.stack([torch.zeros(k), sway], dim=1)
        qvel = torch.zeros(k, 6 + TARGETS)
        qvel[:, :2] = turn_xy(velocity, heading)
        self.robots.set_state(ids, qpos, qvel)
        self.walker.reset(ids, clock, heading, start)
        self.action[ids] = 0.0

    def refer(self, command: Tensor, ground: Heights, first: Tensor) -> Reference:
        """Reference of this control step, (n,) `first` for robots just placed."""
        self.reference = self.walker.update(self.robots, command, ground, first=first)
        return self.reference

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
        r, ref = self.robots, self.reference
        yaw = heading_of(r.orientation)
        angle = 2 * torch.pi * (ref.phase + (ref.side < 0)) / 2
        local = turn_xy(r.com_velocity[:, :2], -yaw)
        feet = torch.cat([turn_xy((ref.sole - r.pelvis[:, None])[..., :2], -yaw[:, None]),
                          (ref.sole - r.pelvis[:, None])[..., 2:]], dim=-1)  # fmt: skip
        goal = ref.sole.clone()
        goal[torch.arange(len(yaw)), (ref.side > 0).long()] = ref.foothold
        goal = goal - ref.sole
        goal = torch.cat([turn_xy(goal[..., :2], -yaw[:, None]), goal[..., 2:]], dim=-1)
        points = r.pelvis[:, None, :2] + turn_xy(self._scan.expand(len(yaw), -1, -1), yaw[:, None])
        level = ref.sole[..., 2].amin(1)
        scan = ground(points, (level + 0.8)[:, None]) - level[:, None]
        seen = torch.cat(
            [
                command,
                torch.stack([torch.sin(angle), torch.cos(angle)], dim=1),
                r.orientation[:, 2],
                0.25 * r.spin,
                local,
                5.0 * (r.pelvis[:, 2] - ref.height)[:, None],
                wrap(ref.heading - yaw)[:, None],
                r.joints - self._rest,
                0.05 * r.joint_velocity,
                self.action,
                ref.joints.flatten(1) - self._rest[:12],
                feet.flatten(1),
                goal.flatten(1),
                scan.clamp(-1.0, 1.0),
            ],
            dim=1,
        )
        return reflect(seen, MIRROR, ref.side)

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
            setattr(part.walker, name, getattr(self.walker, name)[ids])
        part.action = self.action[ids]
        return part

    def state_dict(self) -> dict[str, Any]:
        """State besides the robots'."""
        return {name: getattr(self.walker, name).clone() for name in Walker.STATE} | {
            "action": self.action.clone(), "reference": dict(vars(self.reference)),
        }  # fmt: skip

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from `state_dict`."""
        for name in Walker.STATE:
            setattr(self.walker, name, state[name].clone())
        self.action, self.reference = state["action"].clone(), Reference(**state["reference"])


_LEG = ((0, 1), (1, -1), (2, -1), (3, 1), (4, 1), (5, -1))


def _legs_mirror() -> list[tuple[int, int]]:
    return [(6 + i, s) for i, s in _LEG] + [(i, s) for i, s in _LEG]


def _joints_mirror() -> list[tuple[int, int]]:
    return [*_legs_mirror(), (12, -1), (13, -1), (14, 1)]


def _mirror(*blocks: list[tuple[int, int]]) -> tuple[Tensor, Tensor]:
    index, sign, start = [], [], 0
    for block in blocks:
        index += [start + i for i, _ in block]
        sign += [s for _, s in block]
        start += len(block)
    return torch.tensor(index), torch.tensor(sign, dtype=torch.float32)


_FEET = [(3, 1), (4, -1), (5, 1), (0, 1), (1, -1), (2, 1)]
_SCAN_MIRROR = [(15 + i, 1) for i in range(15)] + [(i, 1) for i in range(15)]
_POLICY = (
    [(0, 1), (1, -1), (2, -1)], [(0, -1), (1, -1)], [(0, 1), (1, -1), (2, 1)], [(0, -1), (1, 1), (2, -1)],
    [(0, 1), (1, -1)], [(0, 1)], [(0, -1)], _joints_mirror(), _joints_mirror(), _joints_mirror(), _legs_mirror(),
    _FEET, _FEET, _SCAN_MIRROR,
)  # fmt: skip
MIRROR = _mirror(*_POLICY)
"""Index and sign of the observation of the mirrored state."""
ACTION_MIRROR = _mirror(_joints_mirror())
# Privileged: contacts of both feet, friction, payload, averaged velocity (3), V, unsigned outputs are left out.
PRIVILEGED_MIRROR = _mirror([(1, 1), (0, 1)], [(0, 1), (1, 1)], [(0, 1), (1, -1), (2, -1)], [(0, 1)])


def reflect(values: Tensor, table: tuple[Tensor, Tensor], side: Tensor) -> Tensor:
    """Rows of values (n, d) mirrored where `side` (n,) is negative."""
    index, sign = table
    return torch.where(side[:, None] < 0, values[:, index] * sign, values)


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
        self._last.update(sole=sole, swing=ref.swing, height=ref.height)
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


class LocomotionEnv(WalkingEnv):
    """Robots on the lanes of a `Ground`, each kind of terrain with its own robots and levels.

    A robot on a lane walks it from a level place to the end under `steer`; it moves up a level when it has
    covered most of the way in good time and down when it falls early. Distance counts along the lane's path only.
    """

    STATE = (*WalkingEnv.STATE, "level", "tried", "lane", "arc", "start", "forward", "speed")

    def __init__(self, spec: LocomotionSpec, lanes: list[Lane], *, threads: int = 0) -> None:
        t, n = spec.task, spec.task.robots
        self.ground = Ground(lanes)
        robots = Humanoids(spec.robot, [self.ground.geoms], n, threads=threads)
        super().__init__(spec, robots, self.ground.map, spec.seed)
        self.kinds = list(t.shares)
        self._by_kind = [[i for i, lane in enumerate(lanes) if lane.kind == kind] for kind in self.kinds]
        edges = np.round(np.cumsum([0.0, *t.shares.values()]) / sum(t.shares.values()) * t.robots).astype(int)
        self.kind = torch.zeros(t.robots, dtype=torch.long)
        for k, (a, b) in enumerate(pairwise(edges)):
            self.kind[a:b] = k
        self.flat = self.kind == self.kinds.index("flat")
        self._top = torch.tensor([len(group) - 1 for group in self._by_kind])[self.kind]
        self._lane_table = torch.tensor([g + [g[-1]] * (max(map(len, self._by_kind)) - len(g)) for g in self._by_kind])

        self.level = torch.zeros(n, dtype=torch.long)
        self.tried = torch.zeros(n, dtype=torch.long)
        self.lane = torch.zeros(n, dtype=torch.long)
        self.arc, self.start, self.forward, self.speed = (
            torch.zeros(n),
            torch.zeros(n),
            torch.ones(n),
            torch.zeros(n),
        )
        self._begin()

    def _start(self, ids: Tensor) -> tuple[Tensor, Tensor]:
        k = len(ids)
        t, g = self.spec.task, self.ground
        any_level = (self._uniform(0.0, 1.0, k) * (self._top[ids] + 1)).long()
        own = self._uniform(0.0, 1.0, k) >= t.explore
        self.tried[ids] = torch.where(own, self.level[ids], any_level)
        self.lane[ids] = self._lane_table[self.kind[ids], self.tried[ids]]
        lane = self.lane[ids]
        pick = (self._uniform(0.0, 1.0, k) * g.spawn.shape[1]).long()
        arc = g.spawn[lane].gather(1, pick[:, None])[:, 0] + self._uniform(-0.4, 0.4, k)
        coin = torch.where(self._uniform(0.0, 1.0, k) < 0.5, -1.0, 1.0)
        ends = torch.where(arc < 1.3, 1.0, torch.where(arc > g.length[lane] - 1.3, -1.0, coin))
        self.forward[ids] = torch.where(self.flat[ids], 1.0, ends)
        self.arc[ids] = self.start[ids] = arc
        self.speed[ids] = self._uniform(*t.lane_speed, k)
        self.command[ids] = 0.0
        flat = ids[self.flat[ids]]
        self.command[flat] = self._draw_commands(len(flat))
        self.command[ids, 0] = torch.where(self.flat[ids], self.command[ids, 0], self.speed[ids])
        at, ahead = g.at(lane, arc), g.at(lane, arc + 0.1 * self.forward[ids])
        to = ahead - at
        heading = torch.atan2(to[:, 1], to[:, 0]) + self._uniform(-0.2, 0.2, k)
        heading = torch.where(self.flat[ids], self._uniform(-torch.pi, torch.pi, k), heading)
        at = at + self._uniform(-0.2, 0.2, 2 * k).reshape(k, 2) * torch.tensor([0.0, 1.0])
        z = g.map(at, torch.full((k,), 9.0))
        return torch.cat([at, z[:, None]], 1), heading

    def _drive(self) -> None:
        yaw = heading_of(self.robots.orientation)
        xy = self.robots.pelvis[:, :2]
        self.arc = torch.where(self.flat, self.arc, self.ground.project(self.lane, xy, self.arc))
        lane_command = steer(self.ground, self.lane, self.arc, self.forward, xy, yaw, self.speed)
        self.command = torch.where(self.flat[:, None], self.command, lane_command)

    def _judge(self, fell: Tensor) -> tuple[Tensor, Tensor]:
        away = (self.robots.pelvis[:, :2] - self.ground.at(self.lane, self.arc)).norm(dim=1)
        fell = fell | (~self.flat & (away > 1.0))
        left = torch.where(self.forward > 0, self.ground.length[self.lane] - self.arc, self.arc)
        return fell, ~self.flat & (left < 0.35) & ~fell

    def _renew(self, done: Tensor) -> None:
        due = self.episode_length_buf % round(self.spec.task.resample / self.dt) == 0
        flat = (self.flat & ~done & due).nonzero()[:, 0]
        self.command[flat] = self._draw_commands(len(flat))

    def _finish(self, ids: Tensor, fell: Tensor, over: Tensor) -> dict[str, float]:
        """Move levels by what the finished episodes covered along their paths."""
        log = {}
        covered = (self.arc - self.start).abs()[ids]
        time = self.episode_length_buf[ids] * self.dt
        quick = covered > 0.66 * self.speed[ids] * time
        part = covered / self.ground.length[self.lane[ids]]
        own = self.tried[ids] == self.level[ids]
        up, down = own & (part > 0.45) & quick, own & fell[ids] & (part < 0.3)
        level = self.level[ids] + up.long() - down.long()
        top = self._top[ids]
        # Beyond the top, practise the harder half of the levels.
        wander = (self._uniform(0.5, 1.0, len(ids)) * (top + 1)).long()
        self.level[ids] = torch.where(level > top, wander, level.clamp(min=0))
        for k, kind in enumerate(self.kinds):
            mine = self.kind[ids] == k
            of_kind = self.level[self.kind == k]
            log[f"/level/{kind}"] = of_kind.float().mean().item() if len(of_kind) else 0.0
            log[f"/ended/{kind}"] = int(mine.sum())
            log[f"/arrived/{kind}"] = int((over[ids] & mine).sum())
            log[f"/fallen/{kind}"] = int((fell[ids] & mine).sum())
        return log


def has_fallen(robots: Robots) -> Tensor:
    """(n,) pelvis less than 0.42 m over the lower foot, or tipped by more than about 55 degrees; or lost."""
    up = robots.pelvis[:, 2] - robots.ankle[..., 2].amin(1) >= 0.42
    finite = robots.joint_velocity.isfinite().all(1) & robots.velocity.isfinite().all(1)
    return ~(up & (robots.orientation[:, 2, 2] >= 0.57) & finite) | robots.lost
