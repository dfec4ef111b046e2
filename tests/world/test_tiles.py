from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from romnav.world.grids import rasterise
from romnav.world.mesh import triangulate
from romnav.world.solids import Label
from romnav.world.spec import WorldSpec
from romnav.world.tile import TileClass
from romnav.world.tiles import fault, generate
from romnav.world.tiles.site import cut

SPEC = WorldSpec()
CLASSES = ("building", "outdoor", "room")
every_class = pytest.mark.parametrize("name", CLASSES)


@every_class
def test_a_tile_is_a_function_of_its_seed_and_index(name: str, tiles: Callable) -> None:
    spec = WorldSpec(classes=(name,), seed=5)
    for index in (0, 3):
        again, grids = generate(spec, index)
        first, same = tiles(name)[index]
        for f in fields(again.solids):
            np.testing.assert_array_equal(getattr(again.solids, f.name), getattr(first.solids, f.name))
        np.testing.assert_array_equal(grids.node, same.node)


@every_class
def test_seeds_and_indices_make_different_tiles(name: str, tiles: Callable) -> None:
    made = [tile.solids.centre.tobytes() for tile, _ in tiles(name)]
    made += [generate(WorldSpec(classes=(name,), seed=seed), 0)[0].solids.centre.tobytes() for seed in (6, 7)]
    assert len(set(made)) == len(made)


@every_class
def test_all_nodes_are_one_component_by_breadth_first_search(name: str, tiles: Callable) -> None:
    for tile, grids in tiles(name):
        count = len(grids.position)
        cell = np.floor(grids.position[:, :2].astype(np.float64) / grids.cell).astype(int).tolist()
        layer, node = (
            grids.layer.tolist(),
            np.pad(grids.node, ((0, 0), (0, 1), (0, 1)), constant_values=-1).tolist(),
        )
        seen, queue = [False] * count, deque([0])
        seen[0] = True
        while queue:
            n = queue.popleft()
            i, j = cell[n]
            here = node[layer[n]]
            for m in (here[i + 1][j], here[i - 1][j], here[i][j + 1], here[i][j - 1]):
                if m >= 0 and not seen[m]:
                    seen[m] = True
                    queue.append(m)
        assert all(seen)
        for storey in tile.storeys:
            floor = (
                (grids.layer == storey) & ~grids.connector & (np.abs(grids.position[:, 2] - tile.layers[storey]) < 0.01)
            )
            assert floor.sum() * grids.cell**2 > 20.0 or tile.kind == TileClass.OUTDOOR


@every_class
def test_a_path_along_each_connector_is_free_and_on_the_surface(name: str, tiles: Callable) -> None:
    for tile, grids in tiles(name):
        for connector in tile.connectors:
            steps = np.linalg.norm(np.diff(connector.path, axis=0), axis=1)
            at = np.concatenate([[0.0], np.cumsum(steps)])
            for d in np.arange(0.0, at[-1], 0.1):
                x, y, z = (np.interp(d, at, connector.path[:, k]) for k in range(3))
                layer = int(np.searchsorted(grids.switch, z))
                i, j = int(x / grids.cell), int(y / grids.cell)
                near = (layer, slice(i - 1, i + 2), slice(j - 1, j + 2))
                assert grids.free[near].any(), (tile.index, connector.kind, x, y, z)
                assert np.nanmin(np.abs(grids.height[near] - z)) < 0.2, (tile.index, connector.kind, x, y, z)
            assert connector.path[0, 2] < connector.path[-1, 2]


@every_class
def test_stairs_and_ramps_keep_to_the_ranges(name: str, tiles: Callable) -> None:
    found = 0
    for tile, _ in tiles(name):
        solids = tile.solids
        stair = np.flatnonzero(solids.label == Label.STAIR)
        found += len(stair)
        assert (2 * solids.half[stair, 0] >= SPEC.tread[0] - 1e-9).all()
        assert (2 * solids.half[stair, 0] <= SPEC.tread[1] + 1e-9).all()
        apart = np.linalg.norm(np.diff(solids.centre[stair], axis=0), axis=1) - 2 * solids.half[stair[1:], 0]
        flights = np.split(stair, np.flatnonzero((np.abs(apart) > 1e-6) | (np.diff(stair) > 1)) + 1)
        climbs = [
            (float(b[2] - a[2]), float(np.hypot(*(b - a)[:2])))
            for c in tile.connectors
            if c.kind != "ramp"
            for a, b in zip(c.path[:-1], c.path[1:], strict=True)
            if b[2] > a[2] + 1e-9
        ]
        for flight in flights:
            if len(flight) > 1:
                risers = np.diff(solids.top[flight])
                np.testing.assert_allclose(risers, risers[0], atol=1e-9)
                assert SPEC.riser[0] - 1e-9 <= risers[0] <= SPEC.riser[1] + 1e-9
                rise, run = risers[0] * (len(flight) + 1), 2 * solids.half[flight, 0].sum()
                assert any(abs(rise - r) < 1e-6 and abs(run - d) < 1e-6 for r, d in climbs)
        ramp = solids.label == Label.RAMP
        assert (np.degrees(np.arctan(solids.slope_top[ramp])) <= 15.0 + 1e-9).all()
    assert found > 0


@every_class
def test_everything_stays_on_the_tile(name: str, tiles: Callable) -> None:
    for tile, _ in tiles(name):
        vertices = triangulate(tile.solids).vertices
        assert vertices[:, :2].min() >= -1e-6
        assert vertices[:, :2].max() <= tile.side + 1e-6
        assert vertices[:, 2].min() >= -0.5
        assert 20 <= len(tile.solids) <= 1200


@every_class
def test_heights_are_what_a_vertical_ray_hits_and_no_two_surfaces_coincide(
    name: str, tiles: Callable, vertical_hits: Callable
) -> None:
    rng = np.random.default_rng(1)
    for tile, grids in tiles(name)[::3]:
        solids = tile.solids
        for layer in range(len(tile.layers)):
            on = (solids.layers[:, 0] <= layer) & (layer <= solids.layers[:, 1])
            mesh = triangulate(solids[on])
            cells = rng.integers(0, grids.height.shape[1], (40, 2))
            xy = (cells + 0.5) * grids.cell
            # a nudge off the triangles' edges, which the strict ray test would miss
            for (i, j), (_, z) in zip(cells, vertical_hits(mesh, xy + np.array([1.3e-7, 0.7e-7])), strict=True):
                height = grids.height[layer, i, j]
                if len(z) == 0:
                    assert np.isnan(height)
                else:
                    assert abs(height - z.max()) < 1e-5
                    assert (z > z.max() - 1e-3).sum() == 1


def test_buildings_are_as_varied_as_the_paper_asks(tiles: Callable) -> None:
    made = [tile for tile, _ in tiles("building")]
    assert {len(tile.storeys) for tile in made} == {2, 3}
    assert {c.kind for tile in made for c in tile.connectors} == {"stair", "u-stair", "ramp"}
    for tile in made:
        heights = [tile.layers[k] for k in tile.storeys]
        np.testing.assert_allclose(np.diff(heights), SPEC.storey_height)
        joined = {storey for c in tile.connectors for storey in c.layers}
        assert joined == set(tile.storeys)


def test_a_building_may_have_one_storey() -> None:
    tile, _ = generate(WorldSpec(classes=("building",), max_storeys=1), 0)
    assert tile.storeys == (0,)
    assert not tile.multi_story
    assert tile.connectors == ()


def test_a_storey_cut_off_is_found(tiles: Callable) -> None:
    tile, grids = tiles("building")[0]
    assert fault(tile, grids) is None
    flights = np.isin(tile.solids.label, (Label.STAIR, Label.RAMP))
    lame = type(tile)(**{**tile.__dict__, "solids": tile.solids[~flights]})
    assert fault(lame, rasterise(lame, SPEC.grid)) is not None


def test_few_tiles_are_redrawn() -> None:
    for name in CLASSES:
        attempts = [generate(WorldSpec(classes=(name,), seed=9), k)[0].draws for k in range(6)]
        assert np.mean(attempts) < 2.0


span = st.tuples(st.integers(0, 9), st.integers(1, 9)).map(lambda t: (float(t[0]), float(t[0] + t[1])))


@settings(deadline=None)
@given(st.lists(st.tuples(span, span), max_size=4))
def test_cut_covers_exactly_what_is_left(holes: list) -> None:
    parts = cut(((2.0, 12.0), (1.0, 14.0)), holes)
    centres = np.arange(20) + 0.5

    def cover(rectangles: list) -> np.ndarray:
        count = np.zeros((20, 20), int)
        for (u0, u1), (v0, v1) in rectangles:
            inside_u, inside_v = (centres > u0) & (centres < u1), (centres > v0) & (centres < v1)
            count += inside_u[:, None] & inside_v[None]
        return count

    outer = cover([((2.0, 12.0), (1.0, 14.0))]) > 0
    np.testing.assert_array_equal(cover(parts), (outer & (cover(holes) == 0)).astype(int))
