from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from romnav.kernels import wp
from romnav.sensing import visibility
from romnav.sensing.lidar import Lidar
from romnav.sensing.spec import LidarSpec
from romnav.world.grids import Grids
from romnav.world.solids import Label, Solids, SolidsBuilder
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


def everything(
    tiles: list[Solids], slopes: tuple[float, float], max_range: float, device: str, cache: Path | None
) -> visibility.Places:
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


Wall = tuple[bool, float, float, float, float]
METRES = st.floats(0.0, 24.0)


@settings(max_examples=50, deadline=None)
@given(
    walls=st.lists(st.tuples(st.booleans(), METRES, METRES, st.floats(0.0, 2.0), st.floats(0.5, 4.0)), max_size=6),
    hole=st.floats(0.0, 6.0),
    yaw=st.sampled_from([0.0, 0.5, np.pi / 2]),
    azimuth=st.sampled_from([90.0, 180.0, 220.0, 360.0]),
    seed=st.integers(0, 1000),
)
def test_no_walls_holes_and_doors_hide_what_is_seen(
    walls: list[Wall], hole: float, yaw: float, azimuth: float, seed: int
) -> None:
    """Walls with doors on two storeys between which a slab has a hole; poles and turned boxes all over."""
    rng = np.random.default_rng(seed)
    b = SolidsBuilder()
    b.box((12.0, 12.0), (24.0, 24.0), (-0.2, 0.0), label=Label.GROUND, layers=(0, 0))
    b.box((9.0 - hole / 2, 12.0), (18.0 - hole, 24.0), (3.8, 4.0), label=Label.GROUND, layers=(1, 1))
    b.box((21.0, 12.0), (6.0, 24.0), (3.8, 4.0), label=Label.GROUND, layers=(1, 1))
    for along_x, at, door, width, height in walls:
        for low, high in ((0.0, door - width / 2), (door + width / 2, 24.0)):
            if high > low + 1e-3:
                centre, size = ((low + high) / 2, at), (high - low, 0.15)
                floor = 4.0 * int(rng.integers(2))
                b.box(*((centre, size) if along_x else (centre[::-1], size[::-1])), (floor, floor + height))
    for x, y, floor in zip(*rng.uniform(0.0, 24.0, (2, 24)), 4.0 * rng.integers(0, 2, 24), strict=True):
        b.cylinder((x, y), 0.1, (floor, floor + 1.5))
        b.box((y, x), (0.8, 0.4), (floor, floor + 1.0), yaw=yaw)
    solids = b.build()
    origin = torch.from_numpy(rng.uniform((-1.0, -1.0, 0.5), (25.0, 25.0, 6.0), (64, 3))).float()
    at = torch.zeros(64, dtype=torch.int32), origin, torch.from_numpy(rng.uniform(-4.0, 4.0, 64)).float()
    spec = LidarSpec(rows=15, columns=55, azimuth=azimuth)
    culled = Lidar([solids], spec).scan(*at, labels=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(visibility, "find", everything)
        whole = Lidar([solids], spec).scan(*at, labels=True)
    assert torch.equal(culled[0], whole[0])
    assert torch.equal(culled[1], whole[1])


def test_places_list_few_solids(tiles: list[tuple[Solids, Grids]]) -> None:
    solids, grids = tiles[0]
    places = visibility.find([solids], (-2.0, 0.2), SPEC.max_range, "cpu")
    length = np.diff(places.start.numpy())
    assert length[-1] == len(solids)
    at = grids.position + np.array([0.0, 0.0, SPEC.height])
    cell = np.floor((at - places.corner.numpy()[0]) / visibility.PLACE).astype(int)
    index = np.ravel_multi_index(tuple(cell.T), tuple(places.count.numpy()[0]))
    assert length[index].mean() < 0.5 * len(solids)


def lists_ball(builder: SolidsBuilder, position: tuple[float, float, float]) -> bool:
    """Whether a ball at (15, 10), knee-high, is a candidate seen from ``position`` once it joins the solids."""
    builder.box((10.0, 10.0), (20.0, 20.0), (-0.2, 0.0), label=Label.GROUND, layers=(0, 0))
    builder.cylinder((15.0, 10.0), 0.2, (0.5, 1.5))
    solids = builder.build()
    places = visibility.find([solids], (-2.0, 0.2), 30.0, "cpu")
    cell = np.floor((np.array(position) - places.corner.numpy()[0]) / visibility.PLACE).astype(int)
    index = np.ravel_multi_index(tuple(cell), tuple(places.count.numpy()[0]))
    start = places.start.numpy()
    return len(solids) - 1 in places.solid.numpy()[start[index] : start[index + 1]]


@pytest.mark.parametrize(("gap", "seen"), [(0.0, False), (1.0, True)], ids=["wall", "door"])
def test_wall_hides_and_door_shows(gap: float, seen: bool) -> None:
    """Two boxes that touch are one wall."""
    half = 10.0 - gap / 2
    for x, through in ((5.0, seen), (17.0, True)):
        b = SolidsBuilder()
        b.box((10.0, half / 2), (0.2, half), (0.0, 4.0))
        b.box((10.0, 20.0 - half / 2), (0.2, half), (0.0, 4.0))
        assert lists_ball(b, (x, 10.0, 1.3)) == through


@pytest.mark.parametrize(("hole", "seen"), [(False, False), (True, True)])
def test_slab_hides_what_is_below_unless_it_has_a_hole(hole: bool, seen: bool) -> None:
    b = SolidsBuilder()
    if hole:
        b.box((6.5, 10.0), (13.0, 20.0), (3.8, 4.0), label=Label.GROUND, layers=(1, 1))
        b.box((18.0, 10.0), (4.0, 20.0), (3.8, 4.0), label=Label.GROUND, layers=(1, 1))
    else:
        b.box((10.0, 10.0), (20.0, 20.0), (3.8, 4.0), label=Label.GROUND, layers=(1, 1))
    assert lists_ball(b, (13.0, 10.0, 5.3)) == seen


def test_lists_are_kept_by_what_they_depend_on_and_made_anew_where_the_file_is_no_good(
    tiles: list[tuple[Solids, Grids]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    solids = [tiles[0][0]]
    made = []
    lists = visibility._lists
    monkeypatch.setattr(visibility, "_lists", lambda *of: made.append(of) or lists(*of))
    begun = find(solids, (-2.0, 0.2), 30.0, "cpu")

    def same(*of: object) -> bool:
        """Whether the lists from the cache are those that are made without."""
        places = find(*of, "cpu", tmp_path)  # type: ignore[arg-type]
        return all(np.array_equal(getattr(places, k).numpy(), getattr(begun, k).numpy()) for k in visibility.TYPES)

    made.clear()
    assert same(solids, (-2.0, 0.2), 30.0)
    assert same(solids, (-2.0, 0.2), 30.0)
    assert len(made) == 1
    (path,) = tmp_path.iterdir()
    whole = path.read_bytes()
    for content in (whole[:-4], pickle.dumps(whole)):
        path.write_bytes(content)
        assert same(solids, (-2.0, 0.2), 30.0)
    assert len(made) == 3
    assert path.read_bytes() == whole
    moved = Solids(**{**vars(solids[0]), "top": solids[0].top + 0.01})
    for other in ((solids, (-2.0, 0.3), 30.0), (solids, (-2.0, 0.2), 12.0), ([moved], (-2.0, 0.2), 30.0)):
        find(*other, "cpu", tmp_path)
    assert len(made) == 6
    assert len(list(tmp_path.iterdir())) == 4
