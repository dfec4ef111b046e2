"""The locomotion task on lanes: each kind of terrain has robots and levels of its own."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from romnav.robot.g1 import Humanoids
from romnav.robot.locomotion.planar import heading_of
from romnav.robot.locomotion.task import WalkingEnv
from romnav.robot.locomotion.terrain import Ground, Lane, steer
from romnav.robot.spec import LocomotionSpec


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
