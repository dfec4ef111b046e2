"""Tiles of the world as the ground of the humanoid: collision geoms and height maps, both from the solids."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from romnav.robot.g1 import OBSTACLES
from romnav.world.mesh import triangulate
from romnav.world.solids import Shape, Solids, SolidsBuilder
from romnav.world.tile import Tile
from romnav.world.world import World

CELL = 0.025
"""Cell of the height maps, m: a tenth of a tread."""
NOWHERE = -32768
"""Height, mm, where a layer has no walking surface."""
_TOUCH = {"contype": 1, "conaffinity": 1}


@dataclass(frozen=True)
class TileGeoms:
    """The solids of a tile as static geoms, filled up to given numbers with geoms under the ground.

    MuJoCo steps a batch on several models only where their data have one layout, so all tiles of a world get
    the same number of geoms and of meshes. Upright boxes and cylinders are MuJoCo's own, inclined solids are
    convex meshes of twelve triangles.
    """

    solids: Solids
    upright: int
    inclined: int

    @classmethod
    def of(cls, tiles: Sequence[Tile]) -> list[TileGeoms]:
        """Those of several tiles, alike in number."""
        standing = [_standing(tile.solids) for tile in tiles]
        inclined = [int(_inclined(solids).sum()) for solids in standing]
        upright = [len(solids) - n for solids, n in zip(standing, inclined, strict=True)]
        # one more, so that the body of the obstacles is never empty
        return [cls(solids, max(upright) + 1, max(inclined)) for solids in standing]

    def add_to(self, model: mujoco.MjSpec) -> None:
        """Add the geoms: walking surfaces to the world body, obstacles to a body of their own."""
        tilted = _inclined(self.solids)
        for index in np.flatnonzero(~tilted):
            _add_upright(model, self.solids[index : index + 1])
        for index in np.flatnonzero(tilted):
            _add_mesh(model, self.solids[index : index + 1])
        for _ in range(self.upright - int((~tilted).sum())):
            _add_upright(model, _FILLER)
        for _ in range(self.inclined - int(tilted.sum())):
            _add_mesh(model, _FILLER)


def _filler() -> Solids:
    builder = SolidsBuilder()
    builder.box((0.0, 0.0), (0.2, 0.2), (-5.2, -5.0))
    return builder.build()


_FILLER = _filler()


def _standing(solids: Solids) -> Solids:
    """Those that rise above the ground floor, which is a plane already."""
    return solids[solids.top + np.abs(solids.slope_top) * solids.half[:, 0] > 1e-6]


def _inclined(solids: Solids) -> NDArray[np.bool_]:
    return (solids.slope_top != 0) | (solids.slope_bottom != 0)


def add_solid(model: mujoco.MjSpec, solid: Solids) -> Any:
    """Add one solid: a walking surface to the world body, an obstacle to the body `OBSTACLES`; returns the geom."""
    return (_add_mesh if _inclined(solid)[0] else _add_upright)(model, solid)


def _add_upright(model: mujoco.MjSpec, solid: Solids) -> Any:
    (x, y), (u, v), yaw = solid.centre[0], solid.half[0], solid.yaw[0]
    middle, half = (solid.top[0] + solid.bottom[0]) / 2, (solid.top[0] - solid.bottom[0]) / 2
    if solid.shape[0] == Shape.CYLINDER:
        shape = {"type": mujoco.mjtGeom.mjGEOM_CYLINDER, "size": [u, half, 0.0]}
    else:
        shape = {"type": mujoco.mjtGeom.mjGEOM_BOX, "size": [u, v, half]}
        shape["quat"] = [np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]
    return _body(model, solid).add_geom(pos=[x, y, middle], **shape, **_TOUCH)


def _add_mesh(model: mujoco.MjSpec, solid: Solids) -> Any:
    mesh = model.add_mesh(name=f"solid{len(model.meshes)}")
    exact = triangulate(_blunt(solid))
    mesh.uservert, mesh.userface = exact.vertices.flatten(), exact.triangles.flatten()
    return _body(model, solid).add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh.name, **_TOUCH)


def _body(model: mujoco.MjSpec, solid: Solids) -> Any:
    return model.worldbody if solid.walkable[0] else model.body(OBSTACLES)


def _blunt(solid: Solids) -> Solids:
    """Nothing thinner than a centimetre: the sharp edge of a wedge would be no triangle."""
    low = solid.top - solid.bottom - np.abs(solid.slope_top - solid.slope_bottom) * solid.half[:, 0]
    return replace(solid, bottom=solid.bottom - np.maximum(0.01 - low, 0.0))


def surfaces(tile: Tile, cell: float = CELL) -> NDArray[np.int16]:
    """(L, N, N) height of the walking surface of every layer at the middle of each cell, mm; else `NOWHERE`."""
    count = round(tile.side / cell)
    heights = np.full((len(tile.layers), count, count), NOWHERE, np.int16)
    solids = tile.solids[tile.solids.walkable]
    for i in range(len(solids)):
        reach = np.hypot(*solids.half[i])
        low = np.clip(np.floor((solids.centre[i] - reach) / cell).astype(int), 0, count)
        high = np.clip(np.ceil((solids.centre[i] + reach) / cell).astype(int) + 1, 0, count)
        x, y = ((np.arange(a, b) + 0.5) * cell for a, b in zip(low, high, strict=True))
        points = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
        u, v = solids[i : i + 1].local(points)
        inside = (
            (np.abs(u) <= solids.half[i, 0]) & (np.abs(v) <= solids.half[i, 1])
            if solids.shape[i] == Shape.BOX
            else np.hypot(u, v) <= solids.half[i, 0]
        )
        top = np.round(1000 * (solids.top[i] + solids.slope_top[i] * u))
        value = np.where(inside, top, NOWHERE).astype(np.int16).reshape(len(x), len(y))
        for layer in range(solids.layers[i, 0], solids.layers[i, 1] + 1):
            part = heights[layer, low[0] : high[0], low[1] : high[1]]
            np.maximum(part, value, out=part)
    return heights


class TileHeights:
    """Walking surfaces under robots that are each on a tile of their own; called like a `HeightMap`.

    Attributes:
        tile: (n,) of each robot.
    """

    def __init__(self, tiles: tuple[Tile, ...]) -> None:
        self._tiles = tiles
        self._slot = torch.full((len(tiles),), -1, dtype=torch.long)
        self._layers = max(len(tile.layers) for tile in tiles)
        self._maps = torch.empty(0)
        self.tile = torch.empty(0, dtype=torch.long)

    def place(self, tile: Tensor) -> None:
        """Robots are on tiles (n,) now; heights of new tiles are made."""
        self.tile = tile.clone()
        new = [t for t in tile.unique().tolist() if self._slot[t] < 0]
        made: list[NDArray[np.int16]] = []
        for t in new:
            self._slot[t] = len(self._maps) + len(made)
            layers = surfaces(self._tiles[t])
            made.append(np.pad(layers, ((0, self._layers - len(layers)), (0, 0), (0, 0)), constant_values=NOWHERE))
        if made:
            fresh = torch.from_numpy(np.stack(made))
            self._maps = torch.cat([self._maps, fresh]) if len(self._maps) else fresh

    def __call__(self, points: Tensor, reach: Tensor) -> Tensor:
        """Height (n, ...) of the highest surface not above `reach` under points (n, ..., 2); 0 where there is none."""
        index = (points / CELL).floor().long().clamp(0, self._maps.shape[-1] - 1)
        slot = self._slot[self.tile].reshape(-1, *[1] * (points.ndim - 2))
        at = self._maps[slot, :, index[..., 0], index[..., 1]]
        height = at.float() / 1000
        allowed = (at != NOWHERE) & (height <= reach[..., None])
        below = torch.where(allowed, height, -torch.inf).amax(-1)
        return torch.where(below.isfinite(), below, 0.0)


def change_layer(world: World, tile: Tensor, layer: Tensor, xy: Tensor, z: Tensor) -> Tensor:
    """Layers (n,) of robots that were on `layer` (n,) and are at `xy` (n, 2) and height `z` (n,) of a tile (n,) now."""
    up = (z > world.switch[tile, layer + 1]).long()
    down = (z <= world.switch[tile, layer]).long()
    now = layer + up - down
    exists = world.surface(tile, now.clamp(0, world.height.shape[1] - 1), xy).isfinite()
    return torch.where(exists, now, layer)
