from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from romnav.world.grids import OFFSETS_8, Grids, rasterise
from romnav.world.solids import Label, Solids, SolidsBuilder
from romnav.world.spec import GridSpec
from romnav.world.tile import Tile, TileClass

SPEC = GridSpec()
CLASSES = ("building", "outdoor", "room")
every_class = pytest.mark.parametrize("name", CLASSES)


def surface(solids: Solids, layer: int, xy: np.ndarray) -> np.ndarray:
    """(P,) height of the highest walkable lid of ``layer`` at ``xy`` (P, 2); NaN where there is none."""
    on = solids[(solids.layers[:, 0] <= layer) & (layer <= solids.layers[:, 1])]
    u, v = on.local(xy)
    under = (np.abs(u) <= on.half[:, :1] + 5e-7) & (np.abs(v) <= on.half[:, 1:] + 5e-7)
    top = np.where(
        under, on.top[:, None] + on.slope_top[:, None] * np.clip(u, -on.half[:, :1], on.half[:, :1]), -np.inf
    )
    highest = top.max(axis=0)
    return np.where(np.isfinite(highest), highest, np.nan)


def polygon_distance(polygon: np.ndarray, p: np.ndarray) -> float:
    """Distance from ``p`` to a convex counter-clockwise polygon (0 inside)."""
    q = np.roll(polygon, -1, axis=0)
    edge, to = q - polygon, p - polygon
    if (edge[:, 0] * to[:, 1] - edge[:, 1] * to[:, 0] >= 0).all():
        return 0.0
    t = np.clip((edge * to).sum(1) / (edge**2).sum(1), 0.0, 1.0)
    return float(np.linalg.norm(to - t[:, None] * edge, axis=1).min())


def disc(radius: float) -> np.ndarray:
    rings = [(radius * k / 3, 2 * np.pi * a / 16) for k in (1, 2, 3) for a in range(16)]
    return np.array([(0.0, 0.0), *((r * np.cos(a), r * np.sin(a)) for r, a in rings)])


def near(solids: Solids, xy: np.ndarray) -> Solids:
    """The solids within 1 m of ``xy``."""
    return solids[np.hypot(*(solids.centre - xy).T) < np.hypot(*solids.half.T) + 1.0]


@every_class
def test_a_robot_in_a_free_cell_touches_nothing_and_stands_on_something(
    name: str, tiles: Callable, inside: Callable
) -> None:
    rng = np.random.default_rng(2)
    levels = np.linspace(0.06, SPEC.robot_height - 0.01, 9)
    body, feet = disc(0.299), disc(0.15)
    for tile, grids in tiles(name)[::2]:
        connector = np.flatnonzero(grids.connector)
        chosen = rng.choice(len(grids.position), 20, replace=False)
        chosen = np.concatenate([chosen, rng.permutation(connector)[:10]])
        for node in chosen:
            x, y, z = grids.position[node].astype(np.float64)
            where = np.array([x, y])
            solids = near(tile.solids, where)
            obstacles, terrain = solids[~solids.walkable], solids[solids.walkable]
            column = np.concatenate([np.column_stack([body + where, np.full(49, z + h)]) for h in levels])
            assert not inside(obstacles, column, 1e-5).any(), (tile.index, x, y, z)
            chest = np.column_stack([feet + where, np.full(49, z + 1.0)])
            assert not inside(terrain, chest, 1e-5).any(), (tile.index, x, y, z)
            ground = surface(solids, int(grids.layer[node]), feet + where)
            assert np.abs(ground - z).max() <= SPEC.max_step + 1e-6, (tile.index, x, y, z)


@every_class
def test_an_occupied_cell_beside_free_ones_is_occupied_for_a_reason(
    name: str, tiles: Callable, inside: Callable
) -> None:
    rng = np.random.default_rng(3)
    judged = 0
    for tile, grids in tiles(name)[::3]:
        for layer in tile.storeys:
            height, free = grids.height[layer], grids.free[layer]
            beside = np.zeros_like(free)
            for axis, step in ((0, 1), (0, -1), (1, 1), (1, -1)):
                level = np.abs(np.roll(height, step, axis) - height) <= SPEC.max_step
                beside |= np.roll(free, step, axis) & level
            border = np.argwhere(beside & ~free & (grids.label[layer] == Label.GROUND))
            for i, j in border[rng.permutation(len(border))[:20]]:
                p, z = (np.array([i, j]) + 0.5) * grids.cell, float(height[i, j])
                solids = near(tile.solids, p)
                obstacles = solids[~solids.walkable]
                low = obstacles.bottom - np.abs(obstacles.slope_bottom) * obstacles.half[:, 0]
                high = obstacles.top + np.abs(obstacles.slope_top) * obstacles.half[:, 0]
                close = obstacles[(low < z + SPEC.robot_height) & (high > z + 0.05)]
                hit = any(polygon_distance(c, p) < SPEC.robot_radius + 1e-3 for c in close.corners(256))
                around = surface(solids, layer, disc(SPEC.robot_radius + grids.cell) + p)
                drop = not np.ptp(around) <= SPEC.max_step
                over = [np.column_stack([disc(0.3) + p, np.full(49, z + h)]) for h in (0.4, 0.7, 1.0, 1.4)]
                roof = inside(solids[solids.walkable], np.concatenate(over)).any()
                assert hit or drop or roof, (tile.index, layer, p, z)
                judged += 1
    assert judged > 150


@every_class
def test_layers_agree_where_they_share_a_surface(name: str, tiles: Callable) -> None:
    for tile, grids in tiles(name):
        nodes = np.searchsorted(grids.switch, grids.position[:, 2].astype(np.float64) - 1e-6)
        np.testing.assert_array_equal(nodes, grids.layer)
        for layer in range(len(tile.layers) - 1):
            a, b = grids.height[layer], grids.height[layer + 1]
            shared = np.abs(a - b) < 1e-6
            np.testing.assert_array_equal(grids.node[layer][shared], grids.node[layer + 1][shared])
            np.testing.assert_array_equal(grids.label[layer][shared], grids.label[layer + 1][shared])
            crossing = shared & (np.abs(a - grids.switch[layer]) < 0.4) & grids.free[layer]
            assert crossing.any() or not grids.free[layer + 1].any()


@every_class
def test_neighbours_are_mutual_level_and_do_not_cut_corners(name: str, tiles: Callable) -> None:
    for _, grids in tiles(name)[::5]:
        near = grids.neighbours()
        n, k = np.nonzero(near >= 0)
        m = near[n, k]
        assert (near[m, (k + 4) % 8] == n).all()
        step = grids.position[m] - grids.position[n]
        np.testing.assert_allclose(step[:, :2], OFFSETS_8[k] * grids.cell, atol=1e-4)
        straight = k % 2 == 0
        assert (np.abs(step[straight, 2]) <= SPEC.max_step + 1e-5).all()
        diagonal = ~straight
        assert (near[n[diagonal], k[diagonal] - 1] >= 0).all()
        assert (near[n[diagonal], (k[diagonal] + 1) % 8] >= 0).all()


def _flat(builder: SolidsBuilder) -> Grids:
    builder.box((5.0, 5.0), (10.0, 10.0), (-0.2, 0.0), label=Label.GROUND, layers=(0, 0))
    return rasterise(Tile(TileClass.ROOM, 0, 10.0, builder.build(), (0.0,), (0,), ()), SPEC)


def test_a_pole_occupies_the_disc_of_the_robots_radius() -> None:
    builder = SolidsBuilder()
    builder.cylinder((5.03, 4.96), 0.05, (0.0, 2.0))
    grids = _flat(builder)
    centres = (np.arange(50) + 0.5) * 0.2
    distance = np.hypot(centres[:, None] - 5.03, centres[None] - 4.96)
    rim = np.minimum(np.minimum(centres, 10.0 - centres)[:, None], np.minimum(centres, 10.0 - centres)[None])
    np.testing.assert_array_equal(grids.free[0], (distance >= 0.35) & (rim >= 0.3 - 1e-9))


@pytest.mark.parametrize(
    ("z", "free"), [((1.39, 2.0), False), ((1.41, 2.0), True), ((0.0, 0.04), True), ((0.0, 0.06), False)]
)
def test_only_solids_at_the_robots_height_occupy(z: tuple[float, float], free: bool) -> None:
    builder = SolidsBuilder()
    builder.box((5.0, 5.0), (1.0, 1.0), z, yaw=0.3)
    assert _flat(builder).free[0, 25, 25] == free


def test_an_inclined_beam_occupies_where_its_underside_is_low_anywhere_over_the_robot() -> None:
    builder = SolidsBuilder()
    builder.box((5.0, 5.0), (8.0, 2.0), (1.6, 1.8), slope=0.5, slope_bottom=0.5)
    grids = _flat(builder)
    centres = (np.arange(50) + 0.5) * 0.2
    lowest = 1.6 + 0.5 * (centres - SPEC.robot_radius - 5.0)
    over = (centres > 1.6) & (centres < 8.0)
    np.testing.assert_array_equal(grids.free[0, over, 25], (lowest >= 1.4)[over])


@pytest.mark.parametrize("radius", [0.3, 0.5])
def test_a_curb_is_free_and_a_step_of_a_metre_keeps_the_robots_radius(radius: float) -> None:
    for rise, crossed in ((0.15, True), (1.0, False)):
        builder = SolidsBuilder()
        builder.box((5.0, 5.0), (10.0, 10.0), (-0.2, 0.0), label=Label.GROUND, layers=(0, 0))
        builder.box((5.0, 8.0), (10.0, 4.0), (-0.1, rise), label=Label.GROUND, layers=(0, 0))
        tile = Tile(TileClass.ROOM, 0, 10.0, builder.build(), (0.0,), (0,), ())
        column = rasterise(tile, GridSpec(robot_radius=radius)).free[0, 25]
        y = (np.arange(50) + 0.5) * 0.2
        clear = (y >= radius - 1e-9) & (y <= 10.0 - radius + 1e-9)
        apart = clear & (np.abs(y - 6.0) >= radius - 1e-9) & (y < 6.0)  # the larger side
        np.testing.assert_array_equal(column, clear if crossed else apart)
