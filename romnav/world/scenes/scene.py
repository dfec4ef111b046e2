"""A scene: a tile with the areas in which its trials start and end, and the world that several scenes make."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from romnav.errors import RomnavError
from romnav.world.grids import rasterise
from romnav.world.spec import GridSpec, WorldSpec
from romnav.world.tile import Tile
from romnav.world.tiles.site import Frame
from romnav.world.world import World, pack

PLANNING = GridSpec(robot_radius=0.41)
"""Grid of goals and shortest paths (A). Its radius is the body's, 0.26 m, and half the diagonal of a cell: nowhere in a
free cell does the body touch a solid, so that whoever walks a shortest path touches nothing."""
SAME_GROUND = 0.3
"""A node lies in an area if it is no further than this above or below, m."""


@dataclass(frozen=True)
class Area:
    """A level rectangle around the origin of ``frame``: full extents ``size`` along u and v, at height ``z``, m."""

    frame: Frame
    size: tuple[float, float]
    z: float = 0.0

    def contains(self, points: NDArray[np.floating]) -> NDArray[np.bool_]:
        """(P,) whether ``points`` (P, 3), in the tile frame, lie in it."""
        dx, dy = points[:, 0] - self.frame.x, points[:, 1] - self.frame.y
        c, s = np.cos(self.frame.yaw), np.sin(self.frame.yaw)
        u, v = c * dx + s * dy, c * dy - s * dx
        level = np.abs(points[:, 2] - self.z) <= SAME_GROUND
        return (np.abs(u) <= self.size[0] / 2) & (np.abs(v) <= self.size[1] / 2) & level


@dataclass(frozen=True)
class Scene:
    """A tile, and where its trials lead: from ``start`` to ``goal``, every other one back if ``both_ways``."""

    name: str
    label: str
    """As the paper calls it."""
    tile: Tile
    start: Area
    goal: Area
    both_ways: bool = False


def scene_world(scenes: Sequence[Scene]) -> World:
    """The scenes as the tiles of one world, in their order; its goals are the free nodes where trials end.

    Raises:
        RomnavError: The scenes differ in size, or an area has no free node.
    """
    sides = {scene.tile.side for scene in scenes}
    if len(sides) != 1:
        raise RomnavError(f"the scenes of a world must be of one size, not {sorted(sides)} m")
    grids = [rasterise(scene.tile, PLANNING) for scene in scenes]
    goals = []
    for scene, grid in zip(scenes, grids, strict=True):
        start, goal = scene.start.contains(grid.position), scene.goal.contains(grid.position)
        if not (start.any() and goal.any()):
            raise RomnavError(f"scene {scene.name}: {'its goal' if start.any() else 'its start'} has no free cell")
        goals.append(np.flatnonzero(goal | (start & scene.both_ways)))
    # scenes are not generated: the least sides of the tile classes are nothing to them
    spec = WorldSpec(tiles=len(scenes), grid=PLANNING).model_copy(update={"side": sides.pop()})
    return pack(spec, [scene.tile for scene in scenes], grids, goals)


def terrain_only(world: World, radius: float) -> World:
    """``world`` for a body that is stopped by the solids themselves: cells are occupied by terrain alone.

    That is by drop-offs and ends of the surface nearer than ``radius`` (m), and by walkable solids overhead; walls,
    furniture and everything else that is no walking surface occupies none. Nodes are numbered anew.
    """
    spec = world.spec.grid.model_copy(update={"robot_radius": radius})
    node = torch.full_like(world.node, -1)
    for t, tile in enumerate(world.tiles):
        grid = rasterise(replace(tile, solids=tile.solids[tile.solids.walkable]), spec)
        node[t, : len(grid.node)] = torch.from_numpy(grid.node).to(node.device)
    return replace(world, node=node)
