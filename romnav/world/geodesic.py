"""Geodesic distance fields over the free cells of all layers of a tile (paper, Sec. III-D)."""

from __future__ import annotations

from math import gcd, hypot

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from romnav.world.grids import OFFSETS_8, Grids

UNIT: float = 1 / 256
"""Metres per count of a field."""
UNREACHABLE = 65535
"""Count of a node that is unreachable, or farther than 255 m."""


def fields(grids: Grids, goals: NDArray[np.integer]) -> NDArray[np.uint16]:
    """Planar shortest distance from every node to each goal node, (G, M), in `UNIT`."""
    metres = dijkstra(stencil_graph(grids, 4), indices=np.asarray(goals))
    return np.minimum(np.rint(metres / UNIT), UNREACHABLE).astype(np.uint16)


def stencil_graph(grids: Grids, reach: int) -> csr_array:
    """Graph of the nodes with straight edges to all visible nodes at primitive offsets of up to ``reach`` cells."""
    neighbours = grids.neighbours()
    count = len(neighbours)
    neighbours = np.vstack([neighbours, np.full((1, 8), -1)])
    code = {tuple(offset): k for k, offset in enumerate(OFFSETS_8.tolist())}
    rows, columns, lengths = [], [], []
    for a in range(-reach, reach + 1):
        for b in range(-reach, reach + 1):
            if gcd(a, b) != 1:
                continue
            end = np.arange(count)
            for step in _cells_crossed(a, b):
                end = neighbours[end, code[step]]
            start = np.flatnonzero(end >= 0)
            rows.append(start)
            columns.append(end[start])
            lengths.append(np.full(len(start), grids.cell * hypot(a, b)))
    index = np.concatenate(rows), np.concatenate(columns)
    return csr_array((np.concatenate(lengths), index), shape=(count, count))


def _cells_crossed(a: int, b: int) -> list[tuple[int, int]]:
    """Steps between the cells that the segment from (0, 0) to (a, b) crosses, in order."""
    sx, sy = int(np.sign(a)), int(np.sign(b))
    borders = sorted(
        [((2 * i + 1) * abs(b), 0) for i in range(abs(a))]
        + [((2 * j + 1) * abs(a), 1) for j in range(abs(b))]
    )
    steps: list[tuple[int, int]] = []
    k = 0
    while k < len(borders):
        if k + 1 < len(borders) and borders[k][0] == borders[k + 1][0]:
            steps.append((sx, sy))
            k += 2
        else:
            steps.append((sx, 0) if borders[k][1] == 0 else (0, sy))
            k += 1
    return steps
