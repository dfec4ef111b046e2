from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from romnav.kernels import wp
from romnav.sensing import visibility
from romnav.sensing.lidar import Lidar
from romnav.sensing.spec import LidarSpec
from romnav.world.grids import Grids
from romnav.world.solids import Solids
from romnav.world.spec import WorldSpec
from romnav.world.tiles import generate

find = visibility.find
SPEC = LidarSpec(rows=15, columns=55)


@pytest.fixture(scope="module")
def tiles() -> list[tuple[Solids, Grids]]:
    spec = WorldSpec(side=40.0, tiles=4, seed=5)
    drawn = [generate(spec, index) for index in range(4)]
    return [(tile.solids, grids) for tile, grids in drawn]


def poses(tiles: list[tuple[Solids, Grids]], count: int) -> tuple[Tensor, Tensor, Tensor]:
    rng = np.random.default_rng(0)
    tile = rng.integers(len(tiles), size=count)
    at = np.stack([tiles[k][1].position[rng.integers(len(tiles[k][1].position))] for k in tile])
    at[:, :2] += rng.uniform(-0.1, 0.1, (count, 2))
    at[:, 2] += SPEC.height
    yaw = rng.uniform(-np.pi, np.pi, count)
    return torch.from_numpy(tile.astype(np.int32)), torch.from_numpy(at).float(), torch.from_numpy(yaw).float()


def everything(tiles: list[Solids], slopes: tuple[float, float], max_range: float, device: str) -> visibility.Places:
    """One place a tile, which is everywhere, with all of its solids."""
    places = find(tiles, slopes, max_range, device)
    counts = np.array([len(solids) for solids in tiles])
    places.first = wp.array(np.arange(len(tiles) + 1), dtype=wp.int32, device=device)
    places.count = wp.zeros(len(tiles), dtype=wp.vec3i, device=device)
    places.start = wp.array(np.append(0, counts.cumsum()), dtype=wp.int32, device=device)
    places.solid = wp.array(np.arange(counts.sum()), dtype=wp.int32, device=device)
    return places


def test_images_equal_those_of_all_solids(tiles: list[tuple[Solids, Grids]], monkeypatch: pytest.MonkeyPatch) -> None:
    solids = [s for s, _ in tiles]
    at = poses(tiles, 512)
    culled = Lidar(solids, SPEC).scan(*at).clone()
    monkeypatch.setattr(visibility, "find", everything)
    assert torch.equal(culled, Lidar(solids, SPEC).scan(*at))


def test_places_list_few_solids(tiles: list[tuple[Solids, Grids]]) -> None:
    solids, grids = tiles[0]
    places = visibility.find([solids], (-2.0, 0.2), SPEC.max_range, "cpu")
    length = np.diff(places.start.numpy())
    assert length[-1] == len(solids)
    at = grids.position + np.array([0.0, 0.0, SPEC.height])
    cell = np.floor((at - places.corner.numpy()[0]) / visibility.PLACE).astype(int)
    index = np.ravel_multi_index(tuple(cell.T), tuple(places.count.numpy()[0]))
    assert length[index].mean() < 0.5 * len(solids)
