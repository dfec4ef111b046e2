"""Exact geodesic distance fields over the free cells of all layers of a tile (paper, Sec. III-D).

The distance is the length of the shortest path of a point through the union of the free cells of a tile, seen
from above, passing between layers through the connector cells that they share. Such a path is a polyline that
bends at convex corners of occupied cells only. A wavefront therefore expands sources in order of their distance,
first the goal and then the corners that it reaches: each lights the cells that it sees within the wedge into
which a shortest path can bend there, row by row as in Anya (Harabor et al., "Optimal any-angle pathfinding in
practice", JAIR 2016). Visibility is decided in integers, so there is no lattice error; what is left is the
rounding to `UNIT`.
"""

# ruff: noqa: UP018, RUF046 - in Warp, int() and float() declare variables that change in a loop

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from romnav.kernels import wp
from romnav.world.grids import Grids

UNIT: float = 1 / 256
"""Metres per count of a field."""
UNREACHABLE: int = 65535
"""Count of a node that cannot be reached, or is farther than 255 m."""
GOAL: int = 65535
"""Source of a node that sees the goal."""

EAST, WEST, UP, DOWN = range(4)
STEPS = np.array([(0, 1), (0, -1), (1, 0), (-1, 0)])
"""(ix, iy) of the links: rows run along iy, in which nodes are numbered."""

wp.set_module_options({"enable_backward": False})


@wp.struct
class Surface:
    """Nodes of all tiles, renumbered so that those of a run (joined along a row) follow each other.

    Corner k of a cell lies towards ``(2 * (k & 1) - 1, (k & 2) - 1)`` in (iy, ix).
    """

    xy: wp.array2d[wp.int32]
    """(M, 2) centre of each node, (iy, ix) in half cells."""
    run: wp.array2d[wp.int32]
    """(M, 2) first and last node of its run."""
    link: wp.array2d[wp.int32]
    """(M, 2) node above and below, -1 where occupied."""
    joint: wp.array2d[wp.int32]
    """(M, 2) last node of the run up to which the nodes above (below) form a run too; where there is none above
    (below), the last such node."""
    corner: wp.array2d[wp.int32]
    """(M, 4) number, within the tile, of the occupied corner that the cell touches diagonally; -1 if none."""
    corner_node: wp.array[wp.int32]
    """(C,) node opposite to each corner."""
    corner_side: wp.array[wp.int32]
    """(C,) which corner of that node it is."""
    original: wp.array[wp.int32]
    """(M,) number within the tile that the tile's grids give to the node."""
    half: float
    """Half a cell, m."""


@wp.struct
class Cone:
    """What a source sees through the lower border of a row: directions from ``l`` (left) to ``r`` (right)."""

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
    """Working memory of each worker: nodes lit, a heap of corners by distance, cones of the current source."""

    lit: wp.array2d[wp.float32]
    """Distance of each node of the tile from the goal, m."""
    source: wp.array2d[wp.uint16]
    """Source that lights it."""
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
        other = f.heap[w, wp.min(below + 1, size - 1)]
        if f.distance[w, other] < f.distance[w, f.heap[w, below]]:
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
def expand(s: Surface, f: Frontier, w: int, origin: int, source: int, x: int, start: float, cone: Cone, up: int):
    """Light what a source at column ``x``, ``start`` metres from the goal, sees in ``cone``; 0: rows go up, 1: down."""
    sign = 1 - 2 * up
    over = 2 - 2 * up
    under = 2 * up
    room = f.cones.shape[1]
    f.cones[w, 0] = cone
    head = int(0)
    tail = int(1)
    while head < tail:
        c = f.cones[w, head % room]
        head += 1
        middle = c.bottom + 1
        top = c.bottom + 2
        begin = s.run[c.node, 0]
        edge = s.xy[begin, 0] - 1 - x
        cells = s.run[c.node, 1] - begin + 1
        # cells of the run whose centre (lit), and whose upper border (passed), the cone meets
        lit_from = int(0)
        lit_to = int(cells)
        passed_from = int(0)
        passed_to = int(cells)
        if c.ly > 0:
            lit_from = wp.max(c.lx * middle - (edge - 1) * c.ly - 1, 0) / (2 * c.ly)
            passed_from = wp.max(c.lx * top - edge * c.ly, 0) / (2 * c.ly)
        if c.ry > 0:
            lit_to = wp.min(wp.max(c.rx * middle - (edge - 1) * c.ry, 0) / (2 * c.ry), cells)
            passed_to = wp.min(wp.max(c.rx * top - (edge - 2) * c.ry - 1, 0) / (2 * c.ry), cells)
        gain = float(-wp.inf)
        for i in range(lit_from, lit_to):
            distance = start + length(s, edge + 1 + 2 * i, middle)
            n = begin - origin + i
            gain = wp.max(gain, f.lit[w, n] - distance)
            if distance < f.lit[w, n]:
                f.lit[w, n] = distance
                f.source[w, n] = wp.uint16(source)
        # distances grow no faster than the way: where another source is nearer by the width of two cells at
        # every centre, which are one cell apart, it is nearer on every ray through them
        if lit_to > lit_from and gain <= -4.0 * s.half:
            continue
        first = begin + passed_from
        end = begin + passed_to
        while first < end:
            last = wp.min(s.joint[first, up], end - 1)
            above = s.link[first, up]
            if above >= 0:
                lx = c.lx
                ly = c.ly
                left = edge + 2 * (first - begin)
                if left * c.ly >= c.lx * top:
                    lx = left
                    ly = top
                    corner = s.corner[above, under]
                    if left > 0:
                        corner = s.corner[first, over]
                    relax(f, w, corner, start + length(s, left, top), left, sign * top)
                rx = c.rx
                ry = c.ry
                right = edge + 2 * (last + 1 - begin)
                if right * c.ry <= c.rx * top:
                    rx = right
                    ry = top
                    corner = s.corner[above + last - first, under + 1]
                    if right < 0:
                        corner = s.corner[last, over + 1]
                    relax(f, w, corner, start + length(s, right, top), right, sign * top)
                if lx * ry < rx * ly:
                    f.cones[w, tail % room] = Cone(above, top, lx, ly, rx, ry)
                    tail += 1
            first = last + 1


@wp.func
def follow(s: Surface, f: Frontier, w: int, begin: int, end: int, step: int, start: float, side: int):
    """Reach the corners along the border of a row, from ``begin`` on, where a path can bend away from the row."""
    n = begin + step
    while step * (end - n) >= 0:
        x = 2 * (n - begin)
        relax(f, w, s.corner[n, side], start + length(s, x, 0), x, 0)
        n += step


@wp.kernel
def wavefront(
    s: Surface,
    f: Frontier,
    goals: wp.array[wp.int32],
    tiles: wp.array[wp.int32],
    nodes: wp.array[wp.int32],
    corners: wp.array[wp.int32],
    fields: wp.array[wp.int64],
    reaches: wp.array[wp.int64],
    first: int,
    workers: int,
    field: wp.array[wp.uint16],
    source: wp.array[wp.uint16],
    reach: wp.array[wp.float32],
):
    """Goals ``first + tid``, ``first + tid + workers``, ... of ``tiles``, with the offsets of tiles and goals."""
    w = first + wp.tid()
    for g in range(w, goals.shape[0], workers):
        tile = tiles[g]
        origin = nodes[tile]
        node_count = nodes[tile + 1] - origin
        offset = corners[tile]
        corner_count = corners[tile + 1] - offset
        for n in range(node_count):
            f.lit[w, n] = wp.inf
        for k in range(corner_count):
            f.distance[w, k] = wp.inf
            f.slot[w, k] = -1
        f.size[w] = 0
        goal = goals[g]
        for up in range(2):
            expand(s, f, w, origin, 65535, s.xy[goal, 0], 0.0, Cone(goal, -1, -1, 0, 1, 0), up)
        while f.size[w] > 0:
            k = nearest(f, w)
            node = s.corner_node[offset + k]
            side = s.corner_side[offset + k]
            start = f.distance[w, k]
            ox = 2 * (side & 1) - 1
            oy = (side & 2) - 1
            dx = f.heading[w, k][0]
            dy = f.heading[w, k][1]
            # the path bends around the corner, at most from its heading to the face of the occupied cell
            lx = dx
            ly = wp.abs(dy)
            rx = int(0)
            ry = int(1)
            up = (1 - oy) / 2
            begin = s.link[node, up]
            if dx * ox >= 0 and dy * oy <= 0:
                rx = ox
                ry = 0
                up = 1 - up
                begin = node + ox
            if lx * ry > rx * ly:
                lx = rx
                ly = ry
                rx = dx
                ry = wp.abs(dy)
            expand(s, f, w, origin, k, s.xy[node, 0] + ox, start, Cone(begin, 0, lx, ly, rx, ry), up)
            if ry == 0:
                follow(s, f, w, begin, s.run[begin, 1], 1, start, 2 * up)
            if ly == 0:
                follow(s, f, w, begin, s.run[begin, 0], -1, start, 2 * up + 1)
        for n in range(node_count):
            at = fields[g] + wp.int64(s.original[origin + n])
            field[at] = wp.uint16(int(wp.min(f.lit[w, n] * 256.0 + 0.5, 65535.0)))
            source[at] = f.source[w, n]
        for k in range(corner_count):
            reach[reaches[g] + wp.int64(k)] = f.distance[w, k]


@dataclass(frozen=True)
class Geodesics:
    """Shortest paths from every node of a tile to its ``G`` goals, through ``C`` corners."""

    distance: NDArray[np.uint16]
    """(G, M) planar length of the path, in `UNIT`; 65535 where there is none or it is longer than 255 m."""
    source: NDArray[np.uint16]
    """(G, M) corner at which the path first bends, `GOAL` where it leads straight to the goal."""
    reach: NDArray[np.float32]
    """(G, C) planar distance of each corner to the goal, m; infinite where no shortest path bends."""
    corner: NDArray[np.float32]
    """(C, 2) position of each corner, m."""
    outward: NDArray[np.float32]
    """(C, 2) signs of x and y away from the occupied cell of each corner."""


def fields(grids: Grids, goals: NDArray[np.integer]) -> NDArray[np.uint16]:
    """Planar shortest distance from every node to each goal node, (G, M), in `UNIT`."""
    return solve([grids], [goals])[0].distance


def solve(
    tiles: Sequence[Grids], goals: Sequence[NDArray[np.integer]], device: str = "cpu", workers: int = 0
) -> list[Geodesics]:
    """Shortest paths to the goal nodes of each tile, one worker per core (or per goal on CUDA) unless told."""
    surfaces = [_surface(g) for g in tiles]
    nodes = np.cumsum([0] + [len(p["xy"]) for p in surfaces])
    corners = np.cumsum([0] + [len(p["corner_node"]) for p in surfaces])
    counts = [len(g) for g in goals]
    tile = np.repeat(np.arange(len(tiles)), counts)
    field_offset = np.cumsum(np.concatenate([[0], np.diff(nodes)[tile]]))
    reach_offset = np.cumsum(np.concatenate([[0], np.diff(corners)[tile]]))
    workers = workers or (len(os.sched_getaffinity(0)) if device == "cpu" else len(tile))

    s = Surface()
    s.half = tiles[0].cell / 2
    for key in surfaces[0]:
        parts = [p[key] for p in surfaces]
        if key in ("run", "link", "joint", "corner_node"):
            parts = [np.where(part >= 0, part + n, -1) for part, n in zip(parts, nodes, strict=False)]
        setattr(s, key, wp.array(np.concatenate(parts), dtype=wp.int32, device=device))
    shape = workers, int(np.diff(corners).max()) + 1
    f = Frontier()
    f.lit = wp.empty((workers, int(np.diff(nodes).max())), dtype=wp.float32, device=device)
    f.source = wp.empty(f.lit.shape, dtype=wp.uint16, device=device)
    f.distance = wp.empty(shape, dtype=wp.float32, device=device)
    f.heading = wp.empty(shape, dtype=wp.vec2i, device=device)
    f.slot = wp.empty(shape, dtype=wp.int32, device=device)
    f.heap = wp.empty(shape, dtype=wp.int32, device=device)
    f.size = wp.empty(workers, dtype=wp.int32, device=device)
    # the cones of a row are apart by the width of an occupied cell at least
    f.cones = wp.empty((workers, max(g.node.shape[2] for g in tiles) + 4), dtype=Cone, device=device)
    field = wp.empty(int(field_offset[-1]), dtype=wp.uint16, device=device)
    source = wp.empty(int(field_offset[-1]), dtype=wp.uint16, device=device)
    reach = wp.empty(int(reach_offset[-1]), dtype=wp.float32, device=device)
    start = [np.argsort(p["original"])[g] + n for p, g, n in zip(surfaces, goals, nodes, strict=False)]
    inputs = [
        s,
        f,
        *(wp.array(a, dtype=wp.int32, device=device) for a in (np.concatenate(start), tile, nodes, corners)),
    ]
    inputs += [wp.array(a, dtype=wp.int64, device=device) for a in (field_offset[:-1], reach_offset[:-1])]

    def run(first: int, count: int) -> None:
        wp.launch(wavefront, count, [*inputs, first, workers, field, source, reach], device=device)

    if device == "cpu":
        wp.load_module(device=device)
        with ThreadPoolExecutor(workers) as pool:
            list(pool.map(run, range(workers), [1] * workers))
    else:
        run(0, workers)
    ends = np.cumsum(counts)[:-1]
    return [
        Geodesics(*(part.reshape(count, -1) for part in parts), *_corners(surface, s.half))
        for count, surface, *parts in zip(
            counts,
            surfaces,
            np.split(field.numpy(), field_offset[ends]),
            np.split(source.numpy(), field_offset[ends]),
            np.split(reach.numpy(), reach_offset[ends]),
            strict=True,
        )
    ]


def links(grids: Grids) -> NDArray[np.int32]:
    """(M, 4) adjacent node of each node, in the order of `STEPS`; -1 where occupied."""
    layer, ix, iy = grids._index()
    padded = np.pad(grids.node, ((0, 0), (1, 1), (1, 1)), constant_values=-1)
    link = np.stack([padded[layer, ix + 1 + dx, iy + 1 + dy] for dx, dy in STEPS], axis=1)
    for k, back in ((EAST, WEST), (WEST, EAST), (UP, DOWN), (DOWN, UP)):
        link[link[link[:, k], back] != np.arange(len(link)), k] = -1
    return link


def _surface(grids: Grids) -> dict[str, NDArray[np.int32]]:
    """Arrays of `Surface` for one tile."""
    _, ix, iy = grids._index()
    link = links(grids)
    first = np.where(link[:, WEST] >= 0, link[:, WEST], np.arange(len(link)))
    while (first != first[first]).any():
        first = first[first]
    original = np.lexsort((iy, first))
    number = np.append(np.argsort(original), -1)
    link = number[link[original]]
    above = link[:, UP:]

    corner = np.full((len(link), 4), -1)
    for k in range(4):
        across, along = (EAST if k & 1 else WEST), (UP if k & 2 else DOWN)
        a, b = link[:, across], link[:, along]
        corner[(a >= 0) & (b >= 0) & (link[a, along] < 0) & (link[b, across] < 0), k] = 0
    node, side = np.nonzero(corner == 0)
    corner[node, side] = np.arange(len(node))

    east = link[:-1, EAST] >= 0
    free = above >= 0
    beside = np.where(free[:-1], link[above[:-1], EAST], -1)
    joint = east[:, None] & (free[1:] == free[:-1]) & (beside == above[1:])
    return {
        "xy": np.stack([2 * iy + 1, 2 * ix + 1], axis=1)[original],
        "run": np.stack([number[first[original]], _stretch(east)], axis=1),
        "link": above,
        "joint": np.stack([_stretch(joint[:, 0]), _stretch(joint[:, 1])], axis=1),
        "corner": corner,
        "corner_node": node,
        "corner_side": side,
        "original": original,
    }


def _stretch(joined: NDArray[np.bool_]) -> NDArray[np.intp]:
    """(M,) last element of the stretch of each of M elements; ``joined`` (M - 1,): belongs to the next one's."""
    ends = np.flatnonzero(~np.append(joined, False))
    return ends[np.searchsorted(ends, np.arange(len(joined) + 1))]


def _corners(surface: dict[str, NDArray[np.int32]], half: float) -> tuple[NDArray[np.float32], ...]:
    """`Geodesics.corner` and `Geodesics.outward`."""
    side = surface["corner_side"]
    inward = np.stack([(side & 2) - 1, 2 * (side & 1) - 1], axis=1)
    position = (surface["xy"][surface["corner_node"], ::-1] + inward) * half
    return position.astype(np.float32), -inward.astype(np.float32)
