"""From a spec and an index to a checked tile (paper, Sec. III-D, Environments)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from romnav.errors import RomnavError
from romnav.world.grids import Grids, rasterise
from romnav.world.spec import TILES, WorldSpec
from romnav.world.tile import Tile, TileClass
from romnav.world.tiles.building import building
from romnav.world.tiles.outdoor import outdoor
from romnav.world.tiles.room import room

GENERATORS: dict[str, Callable[[np.random.Generator, WorldSpec, int], Tile]] = {
    TileClass.BUILDING: building,
    TileClass.OUTDOOR: outdoor,
    TileClass.ROOM: room,
}
MAX_ATTEMPTS = 100
MIN_REACHED = 0.4
"""Least share of a storey's surface that must belong to the tile's connected free space."""
MIN_AREA = 20.0
"""Least connected free area of a storey, m^2."""


def generate(spec: WorldSpec, index: int) -> tuple[Tile, Grids]:
    """Generate tile ``index`` of ``spec``, a function of both alone: drawn until all of it is reachable.

    Raises:
        RomnavError: No draw passes (an impossible spec).
    """
    kind = spec.classes[index % len(spec.classes)]
    generator = GENERATORS.get(kind) or TILES.load(kind)
    why = None
    for attempt in range(MAX_ATTEMPTS):
        rng = np.random.Generator(np.random.Philox(np.random.SeedSequence([spec.seed, index, attempt])))
        tile = generator(rng, spec, index)
        if not isinstance(tile, Tile):
            raise RomnavError(f"tile class {kind}: makes a {type(tile).__name__}, not a romnav.world.tile.Tile")
        grids = rasterise(tile, spec.grid)
        why = fault(tile, grids)
        if why is None:
            return replace(tile, kind=kind, draws=attempt + 1), grids
    raise RomnavError(
        f"world: no {kind} tile passed the reachability check in {MAX_ATTEMPTS} draws "
        f"(seed {spec.seed}, index {index}; {why}); widen world.side or steepen the riser and tread ranges"
    )


def fault(tile: Tile, grids: Grids) -> str | None:
    """What the connected free space of ``tile`` fails to reach; None if the tile may be used."""
    area = grids.cell**2
    free = grids.free
    for storey in tile.storeys:
        surface = np.isfinite(grids.height[storey]).sum()
        reached = free[storey].sum()
        if reached * area < MIN_AREA or reached < MIN_REACHED * surface:
            return f"storey {storey}: {reached} of {surface} cells reached"
    for k, connector in enumerate(tile.connectors):
        for end, layer in ((0, connector.layers[0]), (-1, connector.layers[1])):
            x, y, z = connector.path[end]
            i, j = int(x / grids.cell), int(y / grids.cell)
            window = (layer, slice(max(i - 2, 0), i + 3), slice(max(j - 2, 0), j + 3))
            if not (free[window] & (np.abs(grids.height[window] - z) < 0.3)).any():
                return f"connector {k}: mouth {end} is not reached"
    return None
