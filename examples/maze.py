"""A tile class: a maze on one level, every cell of which can be reached."""

from __future__ import annotations

import numpy as np

from romnav.world.solids import Label, SolidsBuilder
from romnav.world.spec import WorldSpec
from romnav.world.tile import Tile

CELL = 2.5
"""Side of a cell of the maze, m."""
WALL = 0.2
HEIGHT = 2.2


class Maze:
    """Walls between the cells of a random spanning tree, by depth-first search."""

    smallest = 4 * CELL

    def __call__(self, rng: np.random.Generator, spec: WorldSpec, index: int) -> Tile:
        """Tile ``index``: as many cells as fit, and flat ground."""
        cells = int(spec.side // CELL)
        edge = (spec.side - cells * CELL) / 2
        solids = SolidsBuilder()
        middle = (spec.side / 2, spec.side / 2)
        solids.box(middle, (spec.side, spec.side), (-0.2, 0.0), label=Label.GROUND, layers=(0, 0))
        open_ = _passages(rng, cells)
        for i in range(-1, cells):
            for j in range(-1, cells):
                corner = (edge + (i + 1) * CELL, edge + (j + 1) * CELL)
                if j >= 0 and frozenset({(i, j), (i + 1, j)}) not in open_:
                    solids.segment((corner[0], corner[1] - CELL), corner, WALL, (0.0, HEIGHT))
                if i >= 0 and frozenset({(i, j), (i, j + 1)}) not in open_:
                    solids.segment((corner[0] - CELL, corner[1]), corner, WALL, (0.0, HEIGHT))
        return Tile("maze", index, spec.side, solids.build(), layers=(0.0,), storeys=(0,), connectors=())


def _passages(rng: np.random.Generator, cells: int) -> set[frozenset[tuple[int, int]]]:
    """Pairs of neighbouring cells without a wall between them."""
    start = (int(rng.integers(cells)), int(rng.integers(cells)))
    way, seen, passages = [start], {start}, set()
    while way:
        i, j = way[-1]
        around = [(i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)]
        new = [cell for cell in around if min(cell) >= 0 and max(cell) < cells and cell not in seen]
        if not new:
            way.pop()
            continue
        chosen = new[int(rng.integers(len(new)))]
        passages.add(frozenset({(i, j), chosen}))
        seen.add(chosen)
        way.append(chosen)
    return passages
