"""Heights of tiles against the geoms, and against the maps as they are drawn."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from romnav.robot.heights import CELL, NOWHERE, TileHeights, surfaces
from romnav.robot.statics import OBSTACLES
from romnav.robot.tiles import geoms
from romnav.world.spec import WorldSpec
from romnav.world.tile import Tile
from romnav.world.tiles import generate

SPEC = WorldSpec(tiles=3, goals_per_tile=2)


@pytest.fixture(scope="module")
def tiles() -> list[Tile]:
    return [generate(SPEC, i)[0] for i in range(3)]


def test_rays_hit_the_ground_at_the_heights_of_the_map(tiles: list[Tile]) -> None:
    """MuJoCo's ray cast of the geoms is one view of the solids, the rasterised height map another."""
    rng = np.random.default_rng(0)
    checked = 0
    for t, tile in enumerate(tiles):
        walkable = tile.solids[tile.solids.walkable]
        model = mujoco.MjSpec()
        model.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1])
        model.worldbody.add_body(name=OBSTACLES)
        geoms(walkable).add_to(model)
        compiled = model.compile()
        data = mujoco.MjData(compiled)
        mujoco.mj_forward(compiled, data)
        cells = rng.integers(0, round(tile.side / CELL), (300, 2))
        points = torch.tensor((cells + 0.5) * CELL, dtype=torch.float32)
        heights = TileHeights(tuple(tiles))
        heights.place(torch.full((300,), t))
        mapped = heights(points, torch.full((300,), 99.0))
        for (x, y), height in zip((cells + 0.5) * CELL, mapped.tolist(), strict=True):
            far = mujoco.mj_ray(compiled, data, [x, y, 50.0], [0, 0, -1.0], None, 1, -1, np.zeros(1, np.int32))
            assert 50.0 - far == pytest.approx(height, abs=2e-3)
            checked += height > 0.05
    assert checked > 50


def test_the_reach_chooses_the_storey(tiles: list[Tile]) -> None:
    tile = next(tile for tile in tiles if tile.multi_story)
    heights = TileHeights(tuple(tiles))
    t = torch.tensor([tiles.index(tile)] * 4000)
    heights.place(t)
    points = torch.rand(4000, 2, generator=torch.Generator().manual_seed(0)) * tile.side
    high, low = heights(points, torch.full((4000,), 99.0)), heights(points, torch.full((4000,), 0.5))
    assert (low <= 0.5).all()
    assert (high[high > 0.5] > low[high > 0.5]).all()
    assert (high > 3.0).any()


def test_the_kept_blocks_are_the_whole_map(tiles: list[Tile]) -> None:
    """Looked up in the maps as they are drawn, layer by layer, without blocks."""
    generator = torch.Generator().manual_seed(0)
    tile = torch.arange(60) % 3
    heights = TileHeights(tuple(tiles))
    heights.place(tile[tile != 1])
    heights.place(tile)
    points = torch.rand(60, 50, 2, generator=generator) * (tiles[0].side + 1.0) - 0.5
    reach = torch.rand(60, 1, generator=generator) * 8.0
    found = heights(points, reach)
    maps = [surfaces(each) for each in tiles]
    cells = (points / CELL).floor().long().clamp(0, maps[0].shape[1] - 1).numpy()
    for robot, at in enumerate(cells):
        layers = maps[tile[robot]][:, at[:, 0], at[:, 1]]
        metres = layers.astype(np.float32) / 1000
        below = np.where((layers != NOWHERE) & (metres <= reach[robot].numpy()), metres, -np.inf).max(0)
        np.testing.assert_array_equal(found[robot], np.where(np.isfinite(below), below, 0.0))
    assert heights._blocks.nbytes < 0.1 * sum(each.nbytes for each in maps)


def test_nowhere_is_the_ground(tiles: list[Tile]) -> None:
    heights = TileHeights(tuple(tiles))
    heights.place(torch.zeros(3, dtype=torch.long))
    points = torch.tensor([[torch.nan, 1.0], [torch.inf, 1.0], [-1e30, 1e30]])
    assert heights(points, torch.full((3,), 99.0)).isfinite().all()
