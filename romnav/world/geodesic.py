"""Exact geodesic distance fields over the free cells of all layers of a tile (paper, Sec. III-D).

The distance is the length of the shortest path of a point through the union of the free cells of a tile, seen from
above, passing between layers through the connector cells that they share. Such a path is a polyline that bends at
convex corners of occupied cells only. A wavefront therefore expands sources in order of their distance, first the
goal and then the corners that it reaches: each lights the cells that it sees within the wedge into which a shortest
path can bend there, row by row as in Anya (Harabor et al., "Optimal any-angle pathfinding in practice", JAIR
2016). Visibility is decided in integers, so there is no lattice error; what is left is the rounding to `UNIT`.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from romnav.world.grids import Grids

UNIT: float = 1 / 256
"""Metres per count of a field."""
UNREACHABLE: int = 65535
"""Count of a node that cannot be reached, or is farther than 255 m."""

EAST, WEST, UP, DOWN = range(4)
STEPS = np.array([(0, 1), (0, -1), (1, 0), (-1, 0)])
"""(ix, iy) of the links. Rows run along iy, in which nodes are numbered consecutively."""

wp.config.quiet = True
wp.set_module_options({"enable_backward": False})


@wp.struct
class Surface:
    """Nodes of all tiles; corner ``k`` of a cell lies towards ``(2 * (k & 1) - 1, (k & 2) - 1)`` in (iy, ix)."""

    xy: wp.array2d[wp.int32]
    """(M, 2) centre of each node, (iy, ix) in half cells."""
    link: wp.array2d[wp.int32]
    """(M, 4) adjacent nodes, -1 where occupied."""
    corner: wp.array2d[wp.int32]
    """(M, 4) number, within the tile, of the occupied corner that the cell touches diagonally; -1 if none."""
    corner_node: wp.array[wp.int32]
    """(C,) node opposite to each corner."""
    corner_side: wp.array[wp.int32]
    """(C,) which corner of that node it is."""
    half: float
    """Half a cell, m."""


@wp.struct
class Cone:
    """What the current source sees through the lower border of a row: directions from ``l`` (left) to ``r``."""

    node: int
    """Node of the row, at the left end."""
    bottom: int
    """Height of the row's lower border above the source, half cells."""
    lx: int
    ly: int
    rx: int
    ry: int


@wp.struct
class Frontier:
    """Working memory of each worker: a heap of corners by distance, and the cones of the current source."""

    distance: wp.array2d[wp.float32]
    heading: wp.array2d[wp.vec2i]
    slot: wp.array2d[wp.int32]
    heap: wp.array2d[wp.int32]
    size: wp.array[wp.int32]
    cones: wp.array2d[Cone]


@wp.func
def relax(f: Frontier, w: int, corner: int, distance: float, dx: int, dy: int):
    """Reach ``corner`` along ``(dx, dy)``."""
    if corner < 0:
        return
    if distance >= f.distance[w, corner]:
        return
    f.distance[w, corner] = distance
    f.heading[w, corner] = wp.vec2i(dx, dy)
    slot = f.slot[w, corner]
    if slot < 0:
        slot = f.size[w]
        f.size[w] = slot + 1
    while slot > 0:
        above = (slot - 1) // 2
        other = f.heap[w, above]
        if f.distance[w, other] <= distance:
            break
        f.heap[w, slot] = other
        f.slot[w, other] = slot
        slot = above
    f.heap[w, slot] = corner
    f.slot[w, corner] = slot


@wp.func
def nearest(f: Frontier, w: int):
    """Take the nearest corner off the heap."""
    top = f.heap[w, 0]
    size = f.size[w] - 1
    f.size[w] = size
    last = f.heap[w, size]
    distance = f.distance[w, last]
    slot = int(0)
    while 2 * slot + 1 < size:
        below = 2 * slot + 1
        if below + 1 < size:
            if f.distance[w, f.heap[w, below + 1]] < f.distance[w, f.heap[w, below]]:
                below += 1
        other = f.heap[w, below]
        if distance <= f.distance[w, other]:
            break
        f.heap[w, slot] = other
        f.slot[w, other] = slot
        slot = below
    f.heap[w, slot] = last
    f.slot[w, last] = slot
    f.slot[w, top] = -1
    return top


@wp.func
def length(s: Surface, x: int, y: int):
    return s.half * wp.sqrt(float(x * x + y * y))


@wp.func
def expand(
    s: Surface,
    f: Frontier,
    field: wp.array[wp.uint16],
    base: wp.int64,
    w: int,
    x: int,
    start: float,
    up: int,
    cone: Cone,
):
    """Light the cells within ``cone`` of a source at column ``x``, ``start`` m from the goal, rows towards ``up``."""
    sign = 5 - 2 * up
    over = 2 * (3 - up)
    under = 2 - over
    room = f.cones.shape[1]
    f.cones[w, 0] = cone
    head = int(0)
    tail = int(1)
    while head < tail:
        c = f.cones[w, head % room]
        head += 1
        middle = c.bottom + 1
        top = c.bottom + 2
        n = c.node
        left = s.xy[n, 0] - 1 - x
        while left * c.ly > c.lx * top:
            west = s.link[n, 1]
            if west < 0:
                break
            n = west
            left -= 2
        first = int(-1)
        lx = int(0)
        ly = int(0)
        while n >= 0:
            centre = left + 1
            right = left + 2
            if left * c.ry >= c.rx * top and centre * c.ry > c.rx * middle:
                break
            if centre * c.ly >= c.lx * middle and centre * c.ry <= c.rx * middle:
                count = wp.min(int((start + length(s, centre, middle)) * 256.0 + 0.5), 65535)
                if count < int(field[base + wp.int64(n)]):
                    field[base + wp.int64(n)] = wp.uint16(count)
            east = s.link[n, 0]
            above = s.link[n, up]
            if above >= 0 and right * c.ly > c.lx * top and left * c.ry < c.rx * top:
                if first < 0:
                    first = above
                    lx = c.lx
                    ly = c.ly
                    if left * c.ly >= c.lx * top:
                        lx = left
                        ly = top
                        if left > 0:
                            relax(f, w, s.corner[n, over], start + length(s, left, top), left, sign * top)
                        else:
                            relax(
                                f, w, s.corner[above, under], start + length(s, left, top), left, sign * top
                            )
                joined = int(0)
                if east >= 0 and right * c.ry < c.rx * top:
                    if s.link[above, 0] >= 0 and s.link[above, 0] == s.link[east, up]:
                        joined = 1
                if joined == 0:
                    rx = c.rx
                    ry = c.ry
                    if right * c.ry <= c.rx * top:
                        rx = right
                        ry = top
                        if right < 0:
                            relax(
                                f, w, s.corner[n, over + 1], start + length(s, right, top), right, sign * top
                            )
                        else:
                            relax(
                                f,
                                w,
                                s.corner[above, under + 1],
                                start + length(s, right, top),
                                right,
                                sign * top,
                            )
                    if lx * ry < rx * ly:
                        f.cones[w, tail % room] = Cone(first, top, lx, ly, rx, ry)
                        tail += 1
                    first = -1
            n = east
            left = right


@wp.func
def follow(s: Surface, f: Frontier, w: int, node: int, start: float, step: int, side: int):
    """Reach the corners along the border of the row of ``node``, where a path can bend away from the row."""
    sign = 1 - 2 * step
    n = s.link[node, step]
    x = int(2)
    while n >= 0:
        relax(f, w, s.corner[n, side], start + length(s, x, 0), sign * x, 0)
        n = s.link[n, step]
        x += 2


@wp.kernel
def wavefront(
    s: Surface,
    f: Frontier,
    goals: wp.array[wp.int32],
    corners: wp.array2d[wp.int32],
    bases: wp.array[wp.int64],
    first: int,
    workers: int,
    field: wp.array[wp.uint16],
):
    """Fields of the goals ``first + tid``, ``first + tid + workers``, ...; ``corners``: (G, 2) range of each tile."""
    w = first + wp.tid()
    for g in range(w, goals.shape[0], workers):
        base = bases[g]
        offset = corners[g, 0]
        for k in range(corners[g, 1] - offset):
            f.distance[w, k] = wp.inf
            f.slot[w, k] = -1
        f.size[w] = 0
        goal = goals[g]
        x = s.xy[goal, 0]
        expand(s, f, field, base, w, x, 0.0, 2, Cone(goal, -1, -1, 0, 1, 0))
        expand(s, f, field, base, w, x, 0.0, 3, Cone(goal, -1, -1, 0, 1, 0))
        while f.size[w] > 0:
            k = nearest(f, w)
            node = s.corner_node[offset + k]
            side = s.corner_side[offset + k]
            start = f.distance[w, k]
            ox = 2 * (side & 1) - 1
            oy = (side & 2) - 1
            dx = f.heading[w, k][0]
            dy = f.heading[w, k][1]
            # the path bends around the corner between its heading and the face of the occupied cell
            up = int(2)
            begin = int(node)
            lx = dx
            ly = wp.abs(dy)
            rx = int(0)
            ry = int(1)
            if dx * ox < 0 or dy * oy > 0:
                if oy < 0:
                    up = 3
                begin = s.link[node, up]
            else:
                if oy > 0:
                    up = 3
                rx = ox
                ry = 0
                begin = s.link[node, (1 - ox) / 2]
            if lx * ry > rx * ly:
                lx = rx
                ly = ry
                rx = dx
                ry = wp.abs(dy)
            cone = Cone(begin, 0, lx, ly, rx, ry)
            expand(s, f, field, base, w, s.xy[node, 0] + ox, start, up, cone)
            under = 2 * (up - 2)
            if ry == 0:
                follow(s, f, w, begin, start, 0, under)
            if ly == 0:
                follow(s, f, w, begin, start, 1, under + 1)


def fields(grids: Grids, goals: NDArray[np.integer]) -> NDArray[np.uint16]:
    """Planar shortest distance from every node to each goal node, (G, M), in `UNIT`."""
    return fields_many([grids], [goals])[0]


def fields_many(
    tiles: Sequence[Grids], goals: Sequence[NDArray[np.integer]], device: str = "cpu"
) -> list[NDArray[np.uint16]]:
    """`fields` of many tiles at once, on all cores or on a CUDA device; one (G, M) array per tile."""
    parts = [_surface(g) for g in tiles]
    node_offset = np.cumsum([0] + [len(p["xy"]) for p in parts])
    corner_offset = np.cumsum([0] + [len(p["corner_node"]) for p in parts])
    for p, n in zip(parts, node_offset, strict=False):
        p["link"][p["link"] >= 0] += n
        p["corner_node"] += n
    packed = {k: np.concatenate([p[k] for p in parts]) for k in parts[0]}
    tile = np.repeat(np.arange(len(tiles)), [len(g) for g in goals])
    sizes = np.diff(node_offset)[tile]
    offset = np.concatenate([[0], np.cumsum(sizes)])
    start = np.concatenate([np.asarray(g) + n for g, n in zip(goals, node_offset, strict=False)])

    workers = len(os.sched_getaffinity(0)) if device == "cpu" else len(start)
    s = Surface()
    for key, value in packed.items():
        setattr(s, key, wp.array(value, dtype=wp.int32, device=device))
    s.half = tiles[0].cell / 2
    f = Frontier()
    shape = workers, int(np.diff(corner_offset).max()) + 1
    f.distance = wp.empty(shape, dtype=wp.float32, device=device)
    f.heading = wp.empty(shape, dtype=wp.vec2i, device=device)
    f.slot = wp.empty(shape, dtype=wp.int32, device=device)
    f.heap = wp.empty(shape, dtype=wp.int32, device=device)
    f.size = wp.empty(workers, dtype=wp.int32, device=device)
    f.cones = wp.empty((workers, max(g.node.shape[2] for g in tiles) + 4), dtype=Cone, device=device)
    out = wp.full(int(offset[-1]), UNREACHABLE, dtype=wp.uint16, device=device)
    inputs = [
        s,
        f,
        wp.array(start, dtype=wp.int32, device=device),
        wp.array(
            np.stack([corner_offset[tile], corner_offset[tile + 1]], axis=1), dtype=wp.int32, device=device
        ),
        wp.array(offset[:-1] - node_offset[tile], dtype=wp.int64, device=device),
    ]
    if device == "cpu":
        wp.load_module(device="cpu")
        with ThreadPoolExecutor(workers) as pool:
            list(
                pool.map(
                    lambda w: wp.launch(wavefront, 1, [*inputs, w, workers, out], device="cpu"),
                    range(workers),
                )
            )
    else:
        wp.launch(wavefront, workers, [*inputs, 0, workers, out], device=device)
    ends = offset[np.cumsum([len(g) for g in goals])]
    return [f.reshape(len(g), -1) for f, g in zip(np.split(out.numpy(), ends[:-1]), goals, strict=True)]


def _surface(grids: Grids) -> dict[str, NDArray[np.int32]]:
    """Arrays of `Surface` for one tile."""
    layer, ix, iy = grids._index()
    count = len(layer)
    padded = np.pad(grids.node, ((0, 0), (1, 1), (1, 1)), constant_values=-1)
    link = np.stack([padded[layer, ix + 1 + dx, iy + 1 + dy] for dx, dy in STEPS], axis=1)
    for k, back in ((0, 1), (1, 0), (2, 3), (3, 2)):
        link[link[link[:, k], back] != np.arange(count), k] = -1
    corner = np.full((count, 4), -1, np.int32)
    for k in range(4):
        across, along = (EAST if k & 1 else WEST), (UP if k & 2 else DOWN)
        a, b = link[:, across], link[:, along]
        corner[(a >= 0) & (b >= 0) & (link[a, along] < 0) & (link[b, across] < 0), k] = 0
    node, side = np.nonzero(corner == 0)
    corner[node, side] = np.arange(len(node))
    return {
        "xy": np.stack([2 * iy + 1, 2 * ix + 1], axis=1).astype(np.int32),
        "link": link.astype(np.int32),
        "corner": corner,
        "corner_node": node.astype(np.int32),
        "corner_side": side.astype(np.int32),
    }
