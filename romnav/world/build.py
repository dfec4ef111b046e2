"""From a spec to a world: its tiles, goals and geodesic fields, or the file that an earlier run left."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from romnav import arrays
from romnav.world import archive
from romnav.world.grids import Grids
from romnav.world.spec import WorldSpec
from romnav.world.tile import Tile
from romnav.world.tiles import generate
from romnav.world.world import LEVEL_GAP, World, pack


def build(spec: WorldSpec, cache: Path | None = None, progress: Callable[[int, int, str], None] | None = None) -> World:
    """Generate the tiles of ``spec``, choose their goals and compute every goal's geodesic field.

    Goals are drawn uniformly over the free cells of floors, off stairs, ramps and half landings, half of the draws
    per level rather than per cell so that small levels are goals too. ``cache`` is a folder for the finished world;
    a stale, foreign or torn file in it is made anew.
    """
    key = _key(spec)
    path = cache / f"world-{key}.safetensors" if cache else None
    if path and (stored := arrays.load(path)) and (world := archive.unpack(spec, key, *stored)):
        return world
    begun = time.perf_counter()
    tiles, grids, goals = [], [], []
    for i in range(spec.tiles):
        tile, grid = generate(spec, i)
        tiles.append(tile)
        grids.append(grid)
        goals.append(_draw_goals(spec, tile, grid))
        if progress:
            progress(i + 1, 2 * spec.tiles, "tiles")
    world = pack(spec, tiles, grids, goals)
    world = replace(world, seconds=time.perf_counter() - begun)
    if progress:
        progress(2 * spec.tiles, 2 * spec.tiles, "geodesic fields")
    if path:
        arrays.save(path, *archive.pack(world, key))
    return world


def _key(spec: WorldSpec) -> str:
    text = json.dumps([_source_digest(), spec.model_dump(mode="json")], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _source_digest() -> str:
    """Digest of this package's source: a cached world never outlives the code that made it."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def _draw_goals(spec: WorldSpec, tile: Tile, grid: Grids) -> NDArray[np.intp]:
    rng = np.random.Generator(np.random.Philox(np.random.SeedSequence([spec.seed, tile.index, 0x60A1])))
    flat = np.flatnonzero(~grid.connector & np.isin(grid.layer, tile.storeys))
    level = np.round(grid.position[flat, 2] / LEVEL_GAP).astype(int)
    _, inverse, count = np.unique(level, return_inverse=True, return_counts=True)
    weight = 0.5 / len(flat) + 0.5 / (len(count) * count[inverse])
    size = min(spec.goals_per_tile, len(flat))
    return np.sort(rng.choice(flat, size, replace=False, p=weight / weight.sum()))
