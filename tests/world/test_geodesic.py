from __future__ import annotations

import itertools
from fractions import Fraction

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray
from scipy.sparse.csgraph import dijkstra

from romnav.world.geodesic import GOAL, UNIT, UNREACHABLE, fields, solve
from romnav.world.grids import Grids, rasterise
from romnav.world.lookup import GeodesicLookup
from romnav.world.solids import Label, SolidsBuilder
from romnav.world.spec import GridSpec, WorldSpec
from romnav.world.tile import Tile, TileClass
from romnav.world.tiles import generate
from romnav.world.world import World, pack

CELL = 0.2


def flat(free: NDArray[np.bool_]) -> Grids:
    """Grids of one layer with the given free cells, whether connected or not."""
    free = free[None]
    node = np.full(free.shape, -1, np.int32)
    node[free] = np.arange(free.sum())
    _, ix, iy = np.nonzero(free)
    return Grids(
        cell=CELL,
        height=np.zeros(free.shape, np.float32),
        label=np.zeros(free.shape, np.int8),
        node=node,
        position=np.stack([(ix + 0.5) * CELL, (iy + 0.5) * CELL, 0 * ix], axis=1).astype(np.float32),
        layer=np.zeros(len(ix), np.int8),
        connector=np.zeros(len(ix), bool),
        switch=np.zeros(0, np.float32),
    )


def visible(free: NDArray[np.bool_], start: tuple[int, int], end: tuple[int, int]) -> bool:
    """Whether a segment between points in half cells stays in free cells and squeezes past no corner.

    The segment is cut where it crosses the lattice; each piece must touch a free cell, and pieces that meet
    in a lattice point must do so through free cells that share edges.
    """

    def is_free(cell: tuple[int, int]) -> bool:
        return all(0 <= c < n for c, n in zip(cell, free.shape, strict=True)) and bool(free[cell])

    delta = [b - a for a, b in zip(start, end, strict=True)]
    cuts = {Fraction(0), Fraction(1)}
    for a, d in zip(start, delta, strict=True):
        cuts |= {Fraction(k - a, d) for k in range(min(a, a + d), max(a, a + d) + 1) if d and k % 2 == 0}
    before: set[tuple[int, int]] = set()
    for t0, t1 in itertools.pairwise(sorted(cuts)):
        options = []
        for a, d in zip(start, delta, strict=True):
            c = (a + (t0 + t1) / 2 * d) / 2
            options.append([int(c) - 1, int(c)] if c.denominator == 1 else [c.numerator // c.denominator])
        cells = {cell for cell in itertools.product(*options) if is_free(cell)}
        if not cells:
            return False
        corner = [(a + t0 * d) / 2 for a, d in zip(start, delta, strict=True)]
        if before and all(c.denominator == 1 for c in corner):
            i, j = int(corner[0]), int(corner[1])
            ring = [(i - 1, j - 1), (i, j - 1), (i, j), (i - 1, j)]
            reached = before & set(ring)
            for _ in range(3):
                reached |= {c for k, c in enumerate(ring) if is_free(c) and {ring[k - 1], ring[k - 3]} & reached}
            if not reached & cells:
                return False
        before = cells
    return True


def visibility_graph(free: NDArray[np.bool_], goals: list[int]) -> NDArray[np.float64]:
    """Exact distances (G, M) by Dijkstra over all mutually visible cell centres and convex corners."""
    points = [(2 * i + 1, 2 * j + 1) for i, j in np.argwhere(free).tolist()]
    count = len(points)
    padded = np.pad(free, 1)
    for i, j in itertools.product(range(free.shape[0] + 1), range(free.shape[1] + 1)):
        if padded[i : i + 2, j : j + 2].sum() == 3:
            points.append((2 * i, 2 * j))
    weights = np.zeros((len(points), len(points)))
    for a in [*goals, *range(count, len(points))]:
        for b in range(len(points)):
            if a != b and weights[a, b] == 0 and visible(free, points[a], points[b]):
                weights[a, b] = weights[b, a] = np.hypot(*np.subtract(points[a], points[b])) * CELL / 2
    return dijkstra(weights, indices=goals)[:, :count]


@given(
    hnp.arrays(bool, st.integers(1, 6).map(lambda n: (n, n)), elements=st.sampled_from([True, True, False])),
    st.data(),
)
@settings(deadline=None, max_examples=40)
def test_equals_the_visibility_graph(free: NDArray[np.bool_], data: st.DataObject) -> None:
    free[0, 0] = True
    goal = data.draw(st.integers(0, int(free.sum()) - 1))
    field = fields(flat(free), np.array([goal]))
    exact = visibility_graph(free, [goal])
    np.testing.assert_array_equal(field == UNREACHABLE, np.isinf(exact))
    near = np.isfinite(exact)
    np.testing.assert_allclose(field[near] * UNIT, exact[near], rtol=0, atol=UNIT)


def test_equals_the_visibility_graph_on_a_larger_grid() -> None:
    free = np.random.default_rng(5).random((12, 12)) < 0.8
    goals = [0]
    exact = visibility_graph(free, goals)
    near = np.isfinite(exact)
    np.testing.assert_allclose(fields(flat(free), np.array(goals))[near] * UNIT, exact[near], rtol=0, atol=UNIT)


def test_free_space_is_euclidean() -> None:
    grids = flat(np.ones((60, 60), bool))
    goals = np.array([0, 1830, 777])
    straight = np.linalg.norm(grids.position[goals][:, None, :2] - grids.position[None, :, :2], axis=2)
    assert np.abs(fields(grids, goals) * UNIT - straight).max() <= UNIT


def test_does_not_squeeze_between_diagonal_cells() -> None:
    assert fields(flat(np.eye(2, dtype=bool)), np.array([0])).tolist() == [[0, UNREACHABLE]]


@pytest.fixture(scope="module")
def stairs() -> Grids:
    """Two floors, the upper one over half of the lower, joined by a straight staircase of width 2 m."""
    builder = SolidsBuilder()
    builder.box((6.0, 6.0), (12.0, 12.0), (-0.2, 0.0), label=Label.GROUND, layers=(0, 0))
    builder.box((9.0, 6.0), (6.0, 12.0), (2.8, 3.0), label=Label.GROUND, layers=(1, 1))
    for k in range(20):
        builder.box((3.15 + 0.3 * k * 0.5, 6.0), (0.15, 2.0), (-0.1, 0.15 * (k + 1)), label=Label.STAIR, layers=(0, 1))
    tile = Tile(TileClass.BUILDING, 0, 12.0, builder.build(), (0.0, 3.0), (0, 1), ())
    return rasterise(tile, GridSpec(max_step=0.35))


def test_reaches_the_floor_above_only_over_the_stairs(stairs: Grids) -> None:
    height = stairs.position[:, 2]
    below = np.flatnonzero((height == 0) & (stairs.position[:, 0] > 9))
    above = np.flatnonzero(height > 2.9)
    assert len(below) > 100
    assert len(above) > 100
    pair = (
        below[0],
        above[np.linalg.norm(stairs.position[above, :2] - stairs.position[below[0], :2], axis=1).argmin()],
    )
    field = fields(stairs, np.array(pair)) * UNIT
    foot = np.abs(stairs.position[:, 0] - 3.1) < CELL
    over_stairs = (field[0] + field[1])[foot & (height < 0.2)].min()
    assert over_stairs - CELL < field[0, pair[1]] <= over_stairs + 2 * UNIT
    assert field[0, pair[1]] > 8.0


@pytest.fixture(scope="module")
def world() -> World:
    spec = WorldSpec(tiles=3, goals_per_tile=12)
    grids = [generate(spec, i) for i in range(spec.tiles)]
    goals = [np.random.default_rng(i).choice(len(g.position), 12, replace=False) for i, (_, g) in enumerate(grids)]
    return pack(spec, [t for t, _ in grids], [g for _, g in grids], goals)


def test_is_a_metric(world: World) -> None:
    for grids in world.grids:
        nodes = np.random.default_rng(0).choice(len(grids.position), 24, replace=False)
        d = fields(grids, nodes)[:, nodes].astype(int)
        assert (np.diag(d) == 0).all()
        assert np.abs(d - d.T).max() <= 1
        assert (d[:, :, None] <= d[:, None, :] + d.T[None] + 2).all()
        straight = np.linalg.norm(grids.position[nodes][:, None, :2] - grids.position[nodes][None, :, :2], axis=2)
        assert (d * UNIT >= straight - UNIT).all()


def test_neighbours_differ_by_no_more_than_their_distance(world: World) -> None:
    for grids in world.grids:
        field = fields(grids, np.array([0])).astype(int)[0]
        for neighbour in grids.neighbours()[:, ::2].T:
            pair = neighbour >= 0
            assert np.abs(field[neighbour[pair]] - field[pair]).max() * UNIT <= CELL + UNIT


def test_same_bits_for_any_number_of_workers_and_tiles(world: World) -> None:
    goals = [np.arange(7) * 50] * 3
    together = solve(world.grids, goals, workers=3)
    for grids, goal, many in zip(world.grids, goals, together, strict=True):
        (one,) = solve([grids], [goal], workers=1)
        for name in ("distance", "source", "reach", "corner"):
            np.testing.assert_array_equal(getattr(one, name), getattr(many, name))
    np.testing.assert_array_equal(solve(world.grids, goals)[1].distance, together[1].distance)


def test_sources_give_the_distances(world: World) -> None:
    goals = np.array([0, 500])
    (paths,) = solve([world.grids[0]], [goals])
    position = world.grids[0].position[:, :2]
    for k, goal in enumerate(goals):
        bends = paths.source[k] != GOAL
        corner = np.where(bends, paths.source[k], 0)
        end = np.where(bends[:, None], paths.corner[corner], position[goal])
        metres = np.where(bends, paths.reach[k][corner], 0.0) + np.linalg.norm(position - end, axis=1)
        assert np.abs(metres - paths.distance[k] * UNIT).max() <= UNIT


def scatter(world: World, count: int, seed: int) -> tuple[torch.Tensor, ...]:
    """Tile, layer, position anywhere in a free cell, goal and field value at its centre of random robots."""
    generator = torch.Generator().manual_seed(seed)
    goal = torch.randint(len(world.goal), (count,), generator=generator)
    tile = torch.searchsorted(world.goal_start, goal, right=True) - 1
    nodes = world.node_start[tile + 1] - world.node_start[tile]
    local = (torch.rand(count, generator=generator) * nodes).long()
    node = world.node_start[tile] + local
    xy = world.position[node, :2] + (torch.rand(count, 2, generator=generator) - 0.5) * (CELL - 1e-4)
    field = world.fields[world.field_start[goal] + local].to(torch.float32) * UNIT
    return tile, world.layer[node], xy, goal, field, node


def test_lookup_at_centres_is_the_field(world: World) -> None:
    tile, layer, _, goal, field, node = scatter(world, 2000, 0)
    distance, direction = GeodesicLookup(world)(tile, layer, world.position[node, :2].contiguous(), goal)
    torch.testing.assert_close(distance, field, rtol=0, atol=UNIT)
    away = field > 0
    torch.testing.assert_close(direction.norm(dim=1)[away], torch.ones(int(away.sum())))


def test_lookup_is_continuous(world: World) -> None:
    lookup = GeodesicLookup(world)
    tile, layer, xy, goal, _, _ = scatter(world, 4000, 1)
    before, _ = lookup(tile, layer, xy, goal)
    step = 0.02 * torch.nn.functional.normalize(torch.randn(4000, 2, generator=torch.Generator().manual_seed(2)), dim=1)
    free = world.node_at(tile, layer, xy + step) >= 0
    after, _ = lookup(tile, layer, xy + step, goal)
    jump = (after - before).abs()[free] - 0.02
    assert jump.max() < 0.04
    assert jump.quantile(0.99) < 0.002


def test_lookup_off_the_free_cells_leads_to_the_nearest_one(world: World) -> None:
    lookup = GeodesicLookup(world)
    taken = (world.node[0, 0] < 0).nonzero()[::7]
    at = (taken + 0.5) * world.cell
    zero = torch.zeros(len(at), dtype=torch.int64)
    distance, direction = lookup(zero, zero, at, zero)
    assert distance.isfinite().all()
    torch.testing.assert_close(direction.norm(dim=1), torch.ones(len(at)))
    free = ((world.node[0, 0] >= 0).nonzero() + 0.5) * world.cell
    apart = torch.cdist(at.double(), free.double())
    nearest = apart.amin(1)
    # the nearest cells by brute force, to the rounding of coordinates of 40 m: the way leads over one of them
    zeros = torch.zeros(len(free), dtype=torch.int64)
    onward, _ = lookup(zeros, zeros, free, zeros)
    ways = torch.where(apart < nearest[:, None] + 1e-4, onward + apart, torch.inf)
    closest = (ways - distance[:, None]).abs().nan_to_num(torch.inf).amin(1)
    assert closest.max() < 1e-3
    outside, _ = lookup(zero[:1], zero[:1], torch.full((1, 2), -1.0), zero[:1])
    assert outside.isfinite().all()


def test_descent_reaches_the_goal_along_the_shortest_path(world: World) -> None:
    lookup = GeodesicLookup(world)
    tile, layer, xy, goal, _, _ = scatter(world, 200, 3)
    start, direction = lookup(tile, layer, xy, goal)
    walked = torch.zeros(len(xy))
    distance = start
    for _ in range(20 * int(start.max())):
        step = torch.minimum(distance, torch.tensor(0.1))[:, None] * direction
        options = [
            step,
            step * torch.tensor([1.0, 0.0]),
            step * torch.tensor([0.0, 1.0]),
            torch.zeros_like(step),
        ]
        order = 1 + (step[:, 0].abs() < step[:, 1].abs()).long()
        nodes = torch.stack([world.node_at(tile, layer, xy + option) for option in options])
        free = nodes >= 0
        robots = torch.arange(len(xy))
        choice = torch.where(
            free[0],
            0,
            torch.where(free[order, robots], order, torch.where(free[3 - order, robots], 3 - order, 3)),
        )
        step = torch.stack(options)[choice, robots]
        xy, walked = xy + step, walked + step.norm(dim=1)
        layer = world.layer[nodes[choice, robots]]
        distance, direction = lookup(tile, layer, xy, goal)
        if (distance < 0.05).all():
            break
    assert (distance < 0.05).all()
    ratio = ((walked + distance) / start)[start > 1]
    assert ratio.mean() < 1.01
    assert ratio.quantile(0.99) < 1.03
