"""Tiles of the world as the ground of the humanoid: collision geoms and height maps, both from the solids."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from romnav.robot.statics import BOX, CYLINDER, MESH, Geoms
from romnav.world.solids import Shape, Solids
from romnav.world.tile import Tile
from romnav.world.world import World

CELL = 0.025
"""Cell of the height maps, m: a tenth of a tread."""
NOWHERE = -32768
"""Height, mm, where a layer has no walking surface."""


def geoms(solids: Solids) -> Geoms:
    """Solids that rise above the ground floor, which is a plane already, as geoms of MuJoCo.

    Upright boxes and cylinders are MuJoCo's own, inclined solids convex meshes. What is not walkable is an obstacle.
    """
    solids = solids[solids.top + np.abs(solids.slope_top) * solids.half[:, 0] > 1e-6]
    n, inclined = len(solids), (solids.slope_top != 0) | (solids.slope_bottom != 0)
    hull = np.full(n, -1)
    hull[inclined] = np.arange(inclined.sum())
    zero = np.zeros(n)
    return Geoms(
        kind=np.where(inclined, MESH, np.where(solids.shape == Shape.CYLINDER, CYLINDER, BOX)),
        position=np.column_stack([solids.centre, (solids.top + solids.bottom) / 2]),
        quat=np.column_stack([np.cos(solids.yaw / 2), zero, zero, np.sin(solids.yaw / 2)]),
        half=np.column_stack([solids.half, (solids.top - solids.bottom) / 2]),
        hull=hull,
        hulls=_corners(solids[inclined]),
        obstacle=~solids.walkable,
    )


def _corners(solids: Solids) -> NDArray[np.float64]:
    """(n, 8, 3) corners of boxes in the frame of their middle and yaw; nothing thinner than a centimetre, since the
    sharp edge of a wedge would be no triangle."""
    u, v = solids.half[:, :1] * np.array([1, 1, -1, -1]), solids.half[:, 1:] * np.array([1, -1, 1, -1])
    half = ((solids.top - solids.bottom) / 2)[:, None]
    upper = half + solids.slope_top[:, None] * u
    lower = -half + solids.slope_bottom[:, None] * u
    lower -= np.maximum(0.01 - (upper - lower).min(1, keepdims=True), 0.0)
    return np.concatenate([np.stack([u, v, z], axis=-1) for z in (upper, lower)], axis=1)


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
