"""The locomotion task as navigation sets it: on tiles of a world, commanded at 5 Hz by drivers blind to the gait."""

from __future__ import annotations

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from romnav.robot.g1 import Humanoids
from romnav.robot.heights import TileHeights
from romnav.robot.locomotion.planar import heading_of
from romnav.robot.locomotion.task import WalkingEnv
from romnav.robot.spec import DRIVERS, LocomotionSpec
from romnav.robot.tiles import change_layer, geoms
from romnav.world.geodesic import UNIT
from romnav.world.lookup import GeodesicLookup
from romnav.world.world import LEVEL_GAP, MOUTH_RADIUS, World

OVER_EDGE = 0.35
"""A robot whose lower foot is this far above the surface under its pelvis has walked over an edge, m."""
STEP_UP = 0.3
"""The surface that a robot is over lies at most this far above its lower foot, m."""
REACHED = 0.5
"""Distance to a goal at which an episode is over, m."""
BESIDE = 0.5
"""A start is beside an obstacle or an edge when an occupied cell is this near, m."""
_TURN_GAIN = 4.0


class TileEnv(WalkingEnv):
    """Robots on the tiles of a world, each on its own, in turn.

    They start on level cells, many of them beside stairs or walls. Their drivers (see `TileTaskSpec`) do not mind
    what is in the way: walls are run into and leant on. Who is led over an edge begins anew, and that is no fall.
    """

    STATE = (*WalkingEnv.STATE, "layer", "goal", "driver", "drawn", "until", "speed", "stray")

    def __init__(self, spec: LocomotionSpec, world: World, *, threads: int = 0) -> None:
        t, n = spec.tiles, spec.tiles.robots
        robots = Humanoids(spec.robot, [geoms(tile.solids) for tile in world.tiles], n, threads=threads)
        self.tile = torch.arange(n) % len(world.tiles)
        robots.stand_on(self.tile)
        heights = TileHeights(world.tiles)
        heights.place(self.tile)
        super().__init__(spec, robots, heights, spec.seed + 1)
        self.world = world
        self._lookup = GeodesicLookup(world)
        self._starts = [_starts(world, k) for k in range(len(world.tiles))]
        self._hold = round(t.period / self.dt)
        shares = torch.tensor([t.drivers[driver] for driver in DRIVERS])
        self._chances = shares.cumsum(0) / sum(t.drivers.values())
        self.layer = torch.zeros(n, dtype=torch.long)
        self.goal = torch.zeros(n, dtype=torch.long)
        self.driver = torch.zeros(n, dtype=torch.long)
        self.drawn = torch.zeros(n, 3)
        self.until = torch.zeros(n, dtype=torch.long)
        self.speed = torch.zeros(n)
        self.stray = torch.zeros(n)
        self._begin()

    def _start(self, ids: Tensor) -> tuple[Tensor, Tensor]:
        t, world, k = self.spec.tiles, self.world, len(ids)
        u = self._uniform(0.0, 1.0, k)
        kind = torch.where(u < t.mouth, 0, torch.where(u < t.mouth + t.wall, 1, 2))
        draws = self._uniform(0.0, 1.0, 3 * k).reshape(3, k)
        node = torch.zeros(k, dtype=torch.long)
        for i, (tile, which) in enumerate(zip(self.tile[ids].tolist(), kind.tolist(), strict=True)):
            nodes = self._starts[tile][which]
            node[i] = nodes[int(draws[0, i] * len(nodes))]
            self.goal[ids[i]] = self._draw_goal(tile, node[i], bool(draws[1, i] < t.cross), float(draws[2, i]))
        self.layer[ids] = world.layer[node]
        self.driver[ids] = torch.searchsorted(self._chances, self._uniform(0.0, 1.0, k)).clamp(max=len(DRIVERS) - 1)
        fast = self._uniform(0.0, 1.0, k) < t.fast
        self.speed[ids] = torch.where(fast, t.speed[1], self._uniform(*t.speed, k))
        self.stray[ids] = 0.0
        self.drawn[ids] = self._draw_commands(k)
        self.until[ids] = torch.where(self._named("oracle")[ids], 0, self._ticks(k))
        at = world.position[node]
        at = at + torch.cat([self._uniform(-0.08, 0.08, 2 * k).reshape(k, 2), torch.zeros(k, 1)], dim=1)
        _, along = self._lookup(self.tile[ids], self.layer[ids], at[:, :2], self.goal[ids])
        heading = torch.atan2(along[:, 1], along[:, 0]) + self._uniform(-0.5, 0.5, k)
        anyhow = self._uniform(-torch.pi, torch.pi, k)
        heading = torch.where(self._uniform(0.0, 1.0, k) < 0.3, anyhow, heading)
        self.command[ids] = self.drawn[ids] * (~self._named("oracle")[ids])[:, None]
        return at, heading

    def _draw_goal(self, tile: int, node: Tensor, cross: bool, draw: float) -> int:
        """A goal of a tile, within 30 m of the way, on another level if `cross` and there are any."""
        w = self.world
        goals = torch.arange(int(w.goal_start[tile]), int(w.goal_start[tile + 1]))
        way = w.fields[w.field_start[goals] + node - w.node_start[tile]].float() * UNIT
        near = (way > 1.0) & (way < 30.0)
        other = near & ((w.position[w.goal[goals], 2] - w.position[node, 2]).abs() > LEVEL_GAP)
        chosen = goals[other] if cross and other.any() else goals[near] if near.any() else goals
        return int(chosen[int(draw * len(chosen))])

    def _named(self, driver: str) -> Tensor:
        return self.driver == DRIVERS.index(driver)

    def _ticks(self, k: int) -> Tensor:
        """(k,) ticks for which to hold drawn commands."""
        low, high = self.spec.tiles.hold
        return ((low + (high - low) * self._uniform(0.0, 1.0, k).square()) / self.dt).long()

    def _drive(self) -> None:
        t, r = self.spec.tiles, self.robots
        low = self.control.walker.soles(r)[..., 2].amin(1)
        xy = r.pelvis[:, :2]
        self.layer = change_layer(self.world, self.tile, self.layer, xy, self.heights(xy, low + STEP_UP))
        due = self.first | (self.episode_length_buf % self._hold == 0)
        if not due.any():
            return
        oracle = self._named("oracle")
        over = due & (self.episode_length_buf >= self.until)
        burst = over & (~oracle | (self._uniform(0.0, 1.0) < t.burst))
        ids = burst.nonzero()[:, 0]
        self.drawn[ids] = self._draw_commands(len(ids))
        self.until[ids] = self.episode_length_buf[ids] + self._ticks(len(ids))
        self.stray = torch.where(due, (0.9 * self.stray + 0.3 * t.stray * self._uniform(-1.0, 1.0)), self.stray)
        smooth = self.command + 0.25 * (self.drawn - self.command)
        path = self._along_path(self.stray.clamp(-t.stray, t.stray))
        drawn = torch.where(self._named("smooth")[:, None], smooth, self.drawn)
        on_path = oracle & (self.episode_length_buf >= self.until)
        self.command = torch.where(due[:, None], torch.where(on_path[:, None], path, drawn), self.command)

    def _along_path(self, stray: Tensor) -> Tensor:
        """Commands (n, 3) along the shortest paths turned by `stray` (n,), rad.

        The rule is that of the evaluation's scripted oracle (`evaluation.scripted.walk`), with its gain of the turn and
        its angle beyond which robots turn on the spot, but each robot has a speed of its own, and none slows before its
        goal.
        """
        limits = self.spec.task
        xy = self.robots.pelvis[:, :2]
        _, along = self._lookup(self.tile, self.layer, xy, self.goal)
        error = torch.atan2(along[:, 1], along[:, 0]) + stray - heading_of(self.robots.orientation)
        error = torch.atan2(torch.sin(error), torch.cos(error))
        forward = (self.speed * torch.cos(error)).clamp(*limits.forward)
        forward = torch.where(error.abs() > 0.7, 0.0, forward)
        lateral = (self.speed * torch.sin(error)).clamp(-limits.lateral, limits.lateral)
        return torch.stack([forward, lateral, (_TURN_GAIN * error).clamp(-limits.turn, limits.turn)], dim=1)

    def _judge(self, fell: Tensor) -> tuple[Tensor, Tensor]:
        r = self.robots
        xy = r.pelvis[:, :2]
        low = self.control.walker.soles(r)[..., 2].amin(1)
        edge = low - self.heights(xy, low + STEP_UP) > OVER_EDGE
        outside = ((xy < 0.3) | (xy > self.world.spec.side - 0.3)).any(dim=1)
        goal = self.world.position[self.world.goal[self.goal]]
        near = (goal[:, :2] - xy).norm(dim=1) < REACHED
        there = self._named("oracle") & near & ((goal[:, 2] - low).abs() < LEVEL_GAP)
        out = edge | outside
        # A fall over an edge is the driver's.
        return fell & ~out, out | (there & ~fell)

    def _finish(self, ids: Tensor, fell: Tensor, over: Tensor) -> dict[str, float]:
        log: dict[str, float] = {}
        for k, driver in enumerate(DRIVERS):
            mine = self.driver[ids] == k
            log[f"/ended/{driver}"] = int(mine.sum())
            log[f"/fallen/{driver}"] = int((fell[ids] & mine).sum())
            log[f"/arrived/{driver}"] = int((over[ids] & mine).sum())
        log["/touching"] = (
            (self.robots.touch.sum(1) > self.robots.touch[:, self.robots.feet].sum(1)).float().mean().item()
        )
        return log


def _starts(world: World, tile: int) -> tuple[Tensor, Tensor, Tensor]:
    """Level nodes of a tile beside the ends of stairs and ramps, beside obstacles and edges, and all; never none."""
    grid = world.grids[tile]
    level = ~grid.connector
    mouth = np.zeros_like(level)
    for connector in world.tiles[tile].connectors:
        for end in connector.path[[0, -1]]:
            off = grid.position - end
            mouth |= (np.hypot(off[:, 0], off[:, 1]) < 1.5 * MOUTH_RADIUS) & (np.abs(off[:, 2]) < LEVEL_GAP)
    way = np.stack([ndimage.distance_transform_edt(layer >= 0, sampling=grid.cell) for layer in grid.node])
    layer, ix, iy = grid._index()
    beside = way[layer, ix, iy] < BESIDE
    first = int(world.node_start[tile])
    choices = [np.flatnonzero(level & part) for part in (mouth, beside, np.ones_like(level))]
    filled = [nodes if len(nodes) else choices[-1] for nodes in choices]
    mouths, besides, anywhere = (torch.from_numpy(nodes + first) for nodes in filled)
    return mouths, besides, anywhere
