"""Geodesic fields, one per goal: ours, SciPy's Dijkstra on stencils of visible offsets, and scikit-fmm per floor.

All run on one core and are measured in CPU time. Errors are relative to ours (exact to half a count of 1/256 m, see
tests/world/test_geodesic.py) at nodes farther than 1 m from the goal. A peer counts as equally accurate where no more
than 1 % of these nodes are off by more than 1 %; none has every node within 1 %, since paths that graze corners fit no
lattice. Stencil edges are paths through free cells: that no peer finds a shorter path checks ours in turn.
scikit-fmm cannot pass between floors: it computes the goal's floor alone.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from math import gcd, hypot

import numpy as np
from _common import arguments, importable, report, take_turns
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from romnav.world.geodesic import UNIT, solve
from romnav.world.grids import OFFSETS_8, Grids
from romnav.world.spec import WorldSpec
from romnav.world.tiles import generate

REACHES = (1, 3, 4, 6)
"""Stencils of primitive offsets up to so many cells."""
ACCURATE = 0.01


def stencil(grids: Grids, reach: int, with_corners: bool) -> csr_array:
    """Straight edges between visible points at primitive offsets of up to ``reach`` cells.

    Points are the nodes and, if asked for, the convex corners of occupied cells, at which exact paths bend.
    """
    neighbours = grids.neighbours()
    count = len(neighbours)
    neighbours = np.vstack([neighbours, np.full((1, 8), -1)])
    rows, columns, lengths = [], [], []

    def connect(start: NDArray, end: NDArray, x: int, y: int) -> None:
        seen = end >= 0
        rows.append(start[seen])
        columns.append(end[seen])
        lengths.append(np.full(seen.sum(), grids.cell / 2 * hypot(x, y)))

    offsets = [(x, y) for x in range(-2 * reach, 2 * reach + 1) for y in range(-2 * reach, 2 * reach + 1)]
    for x, y in offsets:
        if gcd(x, y) == 2:
            connect(np.arange(count), walk(neighbours, np.arange(count), (1, 1), x, y), x, y)
    if with_corners:
        side = {(sx, sy): OFFSETS_8.tolist().index([sx, sy]) for sx in (-1, 1) for sy in (-1, 1)}
        touched = np.full((count + 1, 8), -1)
        cells = []
        for (sx, sy), k in side.items():
            a, b = neighbours[:-1, AXES[sx, 0]], neighbours[:-1, AXES[0, sy]]
            opposite = np.flatnonzero((a >= 0) & (b >= 0) & (neighbours[:-1, k] < 0))
            number = count + sum(len(c) for c, _, _ in cells) + np.arange(len(opposite))
            touched[opposite, k] = touched[a[opposite], side[-sx, sy]] = touched[b[opposite], side[sx, -sy]] = number
            cells.append((opposite, sx, sy))
        total = count + sum(len(c) for c, _, _ in cells)
        # cell of each corner in each quadrant around it, -1 in the occupied one
        quadrant = np.full((total - count, 8), -1)
        for (sx, sy), k in side.items():
            owner = np.flatnonzero(touched[:-1, side[-sx, -sy]] >= 0)
            quadrant[touched[owner, side[-sx, -sy]] - count, k] = owner
        corner = np.arange(count, total)
        for x, y in offsets:
            to_centre = x % 2 == 1 and y % 2 == 1 and gcd(x, y) == 1
            to_corner = x % 2 == 0 and y % 2 == 0 and (x, y) != (0, 0)
            for sx in (-1, 1) if x == 0 else (np.sign(x),):
                for sy in (-1, 1) if y == 0 else (np.sign(y),):
                    if to_centre or to_corner:
                        end = walk(neighbours, quadrant[:, side[sx, sy]], (0, 0), x, y)
                        if to_corner:
                            end = touched[end, side[sx if x else -sx, sy if y else -sy]]
                        connect(corner, end, x, y)
                        if to_centre:
                            connect(end[end >= 0], corner[end >= 0], x, y)
        count = total
    graph = csr_array((np.concatenate(lengths), (np.concatenate(rows), np.concatenate(columns))), shape=(count,) * 2)
    graph.sum_duplicates()
    return graph


AXES = {(1, 0): 0, (0, 1): 2, (-1, 0): 4, (0, -1): 6}


def walk(neighbours: NDArray, cell: NDArray, start: tuple[int, int], x: int, y: int) -> NDArray:
    """Last cell on a segment ``(x, y)`` in half cells from ``start`` in each first cell; -1 if not all are free.

    ``start`` is the cell's centre (1, 1), or (0, 0) for its corner away from the segment.
    """
    sx, sy = int(np.sign(x)), int(np.sign(y))
    across = {k * abs(y): (sx, 0) for k in range(2 - start[0], abs(x), 2)}
    along = {k * abs(x): (0, sy) for k in range(2 - start[1], abs(y), 2)}
    diagonal = {tuple(o): k for k, o in enumerate(OFFSETS_8.tolist())}
    for k in sorted(across.keys() | along.keys()):
        (dx, _), (_, dy) = across.get(k, (0, 0)), along.get(k, (0, 0))
        cell = neighbours[cell, diagonal[dx, dy]]
    return cell


def marching(grids: Grids, goal: int) -> NDArray:
    """Second-order fast marching over the goal's floor; distances of the floor's nodes, NaN elsewhere."""
    import skfmm

    layer = grids.layer[goal]
    node = grids.node[layer]
    ix, iy = np.argwhere(node == goal)[0]
    phi = np.ma.MaskedArray(np.ones(node.shape), node < 0)
    phi[ix, iy] = 0.0
    distance = skfmm.travel_time(phi, np.ones(node.shape), dx=grids.cell, order=2)
    field = np.full(len(grids.position), np.nan)
    field[node[node >= 0]] = distance.filled(np.nan)[node >= 0]
    return field


def timed(work: Callable[[], list[NDArray]], repeats: int) -> tuple[list[NDArray], list[float]]:
    """Result, and CPU times, s."""
    results: list[list[NDArray]] = []
    times = take_turns({"work": lambda: results.append(work())}, repeats, time.process_time)
    return results[0], times["work"]


def errors(theirs: list[NDArray], ours: list[NDArray]) -> NDArray:
    """Relative differences at nodes beyond 1 m."""
    far = [(b > 1.0) & np.isfinite(a) for a, b in zip(theirs, ours, strict=True)]
    return np.concatenate([a[f] / b[f] - 1 for a, b, f in zip(theirs, ours, far, strict=True)])


def main() -> None:
    """Measure, print and write ``results/bench/geodesic.json``."""
    options = arguments(__doc__, tiles=8, goals=96, repeats=3)
    spec = WorldSpec(tiles=options.tiles, seed=7)
    tiles = [generate(spec, i)[1] for i in range(spec.tiles)]
    rng = np.random.default_rng(0)
    goals = [rng.choice(len(g.position), options.goals, replace=False) for g in tiles]
    few = [g[:8] for g in goals]
    count = sum(map(len, goals))

    solved, ours = timed(lambda: [p.distance for p in solve(tiles, goals, workers=1)], options.repeats)
    exact = [d[:8] * UNIT for d in solved]
    nodes = round(np.mean([len(g.position) for g in tiles]))
    accurate, inaccurate, agree = {}, {}, True

    def compare(name: str, work: Callable[[], list[NDArray]], repeats: int) -> float:
        theirs, times = timed(work, repeats)
        error = errors(theirs, exact)
        wrong = (np.abs(error) > ACCURATE).mean()
        print(f"{name:36} error at most {error.max():.1%}, over {ACCURATE:.0%} at {wrong:.2%} of the nodes")
        group = accurate if wrong <= ACCURATE else inaccurate
        group[name] = [1e3 * t / sum(map(len, few)) for t in times]
        return float(error.min())

    for with_corners in (False, True):
        for reach in REACHES:
            graphs = [stencil(g, reach, with_corners) for g in tiles]
            shortest = compare(
                f"SciPy Dijkstra, {reach} cells{' and corners' if with_corners else ''}",
                lambda graphs=graphs: [
                    dijkstra(graph, indices=i)[:, : len(g.position)]
                    for graph, g, i in zip(graphs, tiles, few, strict=True)
                ],
                options.repeats,
            )
            agree &= shortest > -UNIT
    if importable("skfmm"):
        compare(
            "scikit-fmm, second order, one floor",
            lambda: [np.stack([marching(g, i) for i in goal]) for g, goal in zip(tiles, few, strict=True)],
            options.repeats,
        )
    text = f"{count} fields over {nodes} nodes on average, {len(tiles)} tiles of all classes; one core, CPU time"
    report(
        "geodesic",
        text,
        "ms a goal",
        [1e3 * t / count for t in ours],
        accurate,
        options.out,
        agree=agree,
        inaccurate={name: statistics.median(times) for name, times in inaccurate.items()},
    )
    if not agree:
        raise SystemExit("a path is shorter than the exact one")


if __name__ == "__main__":
    main()
