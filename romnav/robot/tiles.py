"""Tiles of the world as the ground of the humanoid: collision geoms and height maps, both from the solids."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from romnav.kernels import wp
from romnav.robot.statics import BOX, CYLINDER, MESH, Geoms
from romnav.world.solids import Shape, Solids
from romnav.world.tile import Tile
from romnav.world.world import World

CELL = 0.025
"""Cell of the height maps, m: a tenth of a tread."""
NOWHERE = -32768
"""Height, mm, where a layer has no walking surface."""
BLOCK = 32
"""Cells along a block of a height map."""

wp.set_module_options({"enable_backward": False})


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


@wp.kernel
def _highest(
    blocks: wp.array3d(dtype=wp.int16),
    table: wp.array4d(dtype=wp.int32),
    tile: wp.array(dtype=wp.int64),
    cells: int,
    points: wp.array2d(dtype=wp.vec2),
    reach: wp.array2d(dtype=float),
    heights: wp.array2d(dtype=float),
):
    robot, k = wp.tid()
    # what is not finite is nowhere
    at = wp.vec2()
    if wp.isfinite(points[robot, k]):
        at = points[robot, k]
    ix = int(wp.clamp(wp.floor(at[0] / CELL), 0.0, float(cells - 1)))
    iy = int(wp.clamp(wp.floor(at[1] / CELL), 0.0, float(cells - 1)))
    found = bool(False)
    best = float(0.0)
    for layer in range(table.shape[1]):
        block = table[int(tile[robot]), layer, ix // BLOCK, iy // BLOCK]
        if block >= 0:
            height = blocks[block, ix % BLOCK, iy % BLOCK]
            if height != wp.int16(NOWHERE):
                z = float(height) / 1000.0
                if z <= reach[robot, k] and (z > best or not found):
                    best = z
                    found = True
    heights[robot, k] = best


class TileHeights:
    """Walking surfaces under robots that are each on a tile of their own; called like a `HeightMap`.

    A map is made of blocks, and those of a tile that are alike are kept once, since most of a floor is flat.

    Attributes:
        tile: (n,) of each robot.
    """

    def __init__(self, tiles: tuple[Tile, ...]) -> None:
        self._tiles = tiles
        self._cells = round(tiles[0].side / CELL)
        side, layers = -(-self._cells // BLOCK), max(len(tile.layers) for tile in tiles)
        self._made = np.zeros(len(tiles), bool)
        # block of each tile, layer and place, -1 where there is no surface
        self._table = torch.full((len(tiles), layers, side, side), -1, dtype=torch.int32)
        self._blocks = torch.empty(0, BLOCK, BLOCK, dtype=torch.int16)
        self.tile = torch.empty(0, dtype=torch.long)

    def place(self, tile: Tensor) -> None:
        """Robots are on tiles (n,) now; heights of new tiles are made."""
        self.tile = tile.clone()
        made = [self._blocks]
        for t in tile.unique().tolist():
            if not self._made[t]:
                table, blocks = _cut(surfaces(self._tiles[t]))
                table[table >= 0] += sum(map(len, made))
                self._table[t, : len(table)] = torch.from_numpy(table)
                made.append(torch.from_numpy(blocks))
                self._made[t] = True
        if len(made) > 1:
            self._blocks = torch.cat(made)
        self._maps = [wp.from_torch(part) for part in (self._blocks, self._table, self.tile)]

    def __call__(self, points: Tensor, reach: Tensor) -> Tensor:
        """Height (n, ...) of the highest surface not above `reach` under points (n, ..., 2); 0 where there is none."""
        shape = points.shape[:-1]
        heights = torch.empty(len(points), shape[1:].numel())
        inputs = [
            *self._maps,
            self._cells,
            wp.from_torch(points.reshape(*heights.shape, 2).contiguous(), dtype=wp.vec2),
            wp.from_torch(reach.expand(shape).reshape(heights.shape).contiguous()),
        ]
        wp.launch(_highest, heights.shape, inputs, [wp.from_torch(heights)], device="cpu")
        return heights.reshape(shape)


def _cut(layers: NDArray[np.int16]) -> tuple[NDArray[np.int32], NDArray[np.int16]]:
    """A map (L, N, N) as blocks (k, `BLOCK`, `BLOCK`), no two alike, and which of them is where, (L, m, m); -1 where
    there is no surface."""
    side = -(-layers.shape[1] // BLOCK)
    beyond = side * BLOCK - layers.shape[1]
    padded = np.pad(layers, ((0, 0), (0, beyond), (0, beyond)), constant_values=NOWHERE)
    cut = padded.reshape(-1, side, BLOCK, side, BLOCK).swapaxes(2, 3).reshape(-1, BLOCK * BLOCK)
    # as single values, which sort far faster than rows
    rows = np.ascontiguousarray(cut).view(np.dtype((np.void, cut.itemsize * cut.shape[1])))[:, 0]
    _, first, which = np.unique(rows, return_index=True, return_inverse=True)
    table = which.astype(np.int32)
    table[(cut == NOWHERE).all(1)] = -1
    return table.reshape(-1, side, side), cut[first].reshape(-1, BLOCK, BLOCK)


def change_layer(world: World, tile: Tensor, layer: Tensor, xy: Tensor, z: Tensor) -> Tensor:
    """Layers (n,) of robots that were on `layer` (n,) and are at `xy` (n, 2) and height `z` (n,) of a tile (n,) now."""
    up = (z > world.switch[tile, layer + 1]).long()
    down = (z <= world.switch[tile, layer]).long()
    now = layer + up - down
    exists = world.surface(tile, now.clamp(0, world.height.shape[1] - 1), xy).isfinite()
    return torch.where(exists, now, layer)
