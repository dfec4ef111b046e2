"""Heights of walking surfaces: maps, and those of tiles, under robots that are each on a tile of their own."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from romnav.kernels import wp
from romnav.world.solids import Shape
from romnav.world.tile import Tile

CELL = 0.025
"""Cell of the height maps, m: a tenth of a tread."""
NOWHERE = -32768
"""Height, mm, where a layer has no walking surface."""
BITS = 5
"""Of the number of cells along a block of a height map."""
BLOCK = 1 << BITS

wp.set_module_options({"enable_backward": False})


def surfaces(tile: Tile, cell: float = CELL) -> NDArray[np.int16]:
    """(L, N, N) height of the walking surface of every layer at the middle of each cell, mm; else `NOWHERE`."""
    count = round(tile.side / cell)
    heights = np.full((len(tile.layers), count, count), NOWHERE, np.int16)
    solids = tile.solids[tile.solids.walkable]
    for i in range(len(solids)):
        reach = np.hypot(*solids.half[i])
        low = np.clip(np.floor((solids.centre[i] - reach) / cell).astype(int), 0, count)
        high = np.clip(np.ceil((solids.centre[i] + reach) / cell).astype(int) + 1, 0, count)
        x, y = ((np.arange(a, b) + 0.5) * cell - at for a, b, at in zip(low, high, solids.centre[i], strict=True))
        c, s = np.cos(solids.yaw[i]), np.sin(solids.yaw[i])
        u, v = c * x[:, None] + s * y, c * y - s * x[:, None]
        inside = (
            (np.abs(u) <= solids.half[i, 0]) & (np.abs(v) <= solids.half[i, 1])
            if solids.shape[i] == Shape.BOX
            else np.hypot(u, v) <= solids.half[i, 0]
        )
        top = np.round(1000 * (solids.top[i] + solids.slope_top[i] * u))
        value = np.where(inside, top, NOWHERE).astype(np.int16)
        for layer in range(solids.layers[i, 0], solids.layers[i, 1] + 1):
            part = heights[layer, low[0] : high[0], low[1] : high[1]]
            np.maximum(part, value, out=part)
    return heights


@wp.struct
class Maps:
    """Height maps in blocks.

    Attributes:
        blocks: (blocks, 2^`bits`, 2^`bits`) heights, m, -inf where there is no surface.
        table: (maps, layers, X, Y) which block is where, -1 where there is no surface.
        which: (n,) map under each robot; empty where there is one for all.
        origin, cell, cells: corner, m, side of a cell, m, and number of cells.
        headroom: surfaces up to this far above a lookup's reach are within it, m.
    """

    blocks: wp.array3d(dtype=float)
    table: wp.array4d(dtype=wp.int32)
    which: wp.array(dtype=wp.int64)
    origin: wp.vec2
    cell: float
    cells: wp.vec2i
    bits: int
    headroom: float


@wp.func
def highest(maps: Maps, robot: int, point: wp.vec2, reach: float):
    """Height of the highest surface not above ``reach`` under a robot's point; 0 where there is none."""
    # what is not finite is nowhere
    at = wp.vec2()
    if wp.isfinite(point):
        at = (point - maps.origin) / maps.cell
    ix = int(wp.clamp(wp.floor(at[0]), 0.0, float(maps.cells[0] - 1)))
    iy = int(wp.clamp(wp.floor(at[1]), 0.0, float(maps.cells[1] - 1)))
    which = int(0)  # noqa: RUF046, UP018 - in Warp, int() declares a variable that changes
    if maps.which.shape[0] > 0:
        which = int(maps.which[robot])
    inside = (1 << maps.bits) - 1
    best = float(-wp.inf)
    for layer in range(maps.table.shape[1]):
        block = maps.table[which, layer, ix >> maps.bits, iy >> maps.bits]
        if block >= 0:
            height = maps.blocks[block, ix & inside, iy & inside]
            if height <= reach + maps.headroom:
                best = wp.max(best, height)
    return wp.where(best > -wp.inf, best, 0.0)


@wp.kernel
def _look_up(
    maps: Maps, points: wp.array2d(dtype=wp.vec2), reach: wp.array2d(dtype=float), heights: wp.array2d(dtype=float)
):
    robot, k = wp.tid()
    heights[robot, k] = highest(maps, robot, points[robot, k], reach[robot, k])


class Heights:
    """Walking surfaces under ``n`` robots.

    Attributes:
        maps: for kernels.
    """

    def __init__(self) -> None:
        self.maps = Maps()

    def __call__(self, points: Tensor, reach: Tensor) -> Tensor:
        """Height (n, ...), m, of the highest surface not above `reach` under points (n, ..., 2), or 0."""
        shape = points.shape[:-1]
        heights = torch.empty(len(points), shape[1:].numel())
        at = points.reshape(*heights.shape, 2).contiguous()
        limits = reach.expand(shape).reshape(heights.shape).contiguous()
        inputs = [
            self.maps,
            wp.from_torch(at, dtype=wp.vec2, return_ctype=True),
            wp.from_torch(limits, return_ctype=True),
        ]
        wp.launch(_look_up, heights.shape, inputs, [wp.from_torch(heights, return_ctype=True)], device="cpu")
        return heights.reshape(shape)


class HeightMap(Heights):
    """One walking surface over a regular grid, however far up, under all robots."""

    def __init__(self, origin: tuple[float, float], cell: float, heights: Tensor) -> None:
        """
        Args:
            origin: of cell (0, 0), m.
            cell: side of a cell, m.
            heights: (X, Y), float32, m.
        """
        super().__init__()
        self.maps.blocks = wp.from_torch(heights[None].contiguous())
        self.maps.table = wp.zeros((1, 1, 1, 1), dtype=wp.int32, device="cpu")
        self.maps.origin, self.maps.cell, self.maps.cells = wp.vec2(origin), cell, wp.vec2i(heights.shape)
        self.maps.bits = max(heights.shape).bit_length()
        self.maps.headroom = float("inf")


class TileHeights(Heights):
    """Walking surfaces under robots that are each on a tile of their own.

    A map is made of blocks, and those of a tile that are alike are kept once, since most of a floor is flat.

    Attributes:
        tile: (n,) of each robot.
    """

    def __init__(self, tiles: tuple[Tile, ...]) -> None:
        super().__init__()
        self._tiles = tiles
        cells = round(tiles[0].side / CELL)
        self.maps.cell, self.maps.cells, self.maps.bits = CELL, wp.vec2i(cells, cells), BITS
        side, layers = -(-cells // BLOCK), max(len(tile.layers) for tile in tiles)
        self._made = np.zeros(len(tiles), bool)
        # block of each tile, layer and place, -1 where there is no surface
        self._table = torch.full((len(tiles), layers, side, side), -1, dtype=torch.int32)
        # m, -inf where there is no surface
        self._blocks = torch.empty(0, BLOCK, BLOCK)
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
        self.maps.blocks, self.maps.table = wp.from_torch(self._blocks), wp.from_torch(self._table)
        self.maps.which = wp.from_torch(self.tile)


def _cut(layers: NDArray[np.int16]) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """A map (L, N, N) as blocks (k, `BLOCK`, `BLOCK`), m, no two alike, -inf where there is no surface, and which of
    them is where, (L, m, m); -1 for none."""
    side = -(-layers.shape[1] // BLOCK)
    beyond = side * BLOCK - layers.shape[1]
    padded = np.pad(layers, ((0, 0), (0, beyond), (0, beyond)), constant_values=NOWHERE)
    cut = padded.reshape(-1, side, BLOCK, side, BLOCK).swapaxes(2, 3).reshape(-1, BLOCK * BLOCK)
    # as single values, which sort far faster than rows
    rows = np.ascontiguousarray(cut).view(np.dtype((np.void, cut.itemsize * cut.shape[1])))[:, 0]
    _, first, which = np.unique(rows, return_index=True, return_inverse=True)
    table = which.astype(np.int32)
    table[(cut == NOWHERE).all(1)] = -1
    blocks = cut[first].reshape(-1, BLOCK, BLOCK)
    return table.reshape(-1, side, side), np.where(blocks == NOWHERE, -np.float32(np.inf), blocks / np.float32(1000))
