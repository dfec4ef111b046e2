"""Ground removal on synthetic terrain; inflation against Euclidean distances."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from scipy.ndimage import distance_transform_edt

from romnav.errors import RomnavError
from romnav.safety.occupancy import Rasterizer, inflate
from romnav.safety.spec import OccupancySpec

EYE = 1.265
"""Height of the scanner above the ground, m."""


def patch(x: tuple[float, float], y: tuple[float, float], height, spacing: float = 0.04) -> np.ndarray:
    """Points of a surface z = height(x) over a rectangle."""
    xs, ys = np.meshgrid(np.arange(*x, spacing), np.arange(*y, spacing))
    return np.stack([xs, ys, np.broadcast_to(height(xs), xs.shape)], -1).reshape(-1, 3).astype(float)


def wall(x: tuple[float, float], y: tuple[float, float], z: tuple[float, float], spacing: float = 0.04) -> np.ndarray:
    """Points of an upright rectangle between two corners."""
    t, zs = np.meshgrid(np.linspace(0, 1, 60), np.arange(*z, spacing))
    return np.stack([x[0] + t * (x[1] - x[0]), y[0] + t * (y[1] - y[0]), zs], -1).reshape(-1, 3)


def visible(points: np.ndarray) -> np.ndarray:
    """What a scanner at eye height sees ahead: 220 degrees, no steeper than 55 degrees down."""
    d = points - [0, 0, EYE]
    r = np.hypot(d[:, 0], d[:, 1])
    return points[(np.abs(np.arctan2(d[:, 1], d[:, 0])) < np.radians(110)) & (d[:, 2] > -np.tan(np.radians(55)) * r)]


def rasterise(*surfaces: np.ndarray, noise: float = 0.0, spec: OccupancySpec | None = None):
    points = visible(np.concatenate(surfaces))
    points = points + noise * np.random.default_rng(0).normal(size=points.shape)
    return Rasterizer(1, spec)(torch.from_numpy(points).float()[None])


def near(grid: torch.Tensor, x: float, y: float, reach: float = 0.08) -> bool:
    """Whether a cell within reach of a place is occupied."""
    cells = torch.nonzero(grid[0]).double() * 0.05 - 2.975
    return bool(len(cells)) and bool((torch.cdist(cells, torch.tensor([[x, y]]).double()) < reach).any())


def flat(x: np.ndarray) -> np.ndarray:
    return np.zeros_like(x)


def stairs(first: float, riser: float, tread: float, steps: int):
    return lambda x: riser * np.clip(np.floor((x - first) / tread) + 1, 0, steps)


def risers(first: float, riser: float, tread: float, steps: int) -> np.ndarray:
    low = [(k * riser, (k + 1) * riser) if riser > 0 else ((k + 1) * riser, k * riser) for k in range(steps)]
    return np.concatenate([wall((first + k * tread,) * 2, (-1, 1), z, 0.02) for k, z in enumerate(low)])


TERRAIN = {
    "flat": [patch((-3, 3), (-3, 3), flat)],
    "ramp up": [patch((-3, 3), (-3, 3), lambda x: 0.3 * np.clip(x - 1, 0, None))],
    "ramp down": [patch((-3, 3), (-3, 3), lambda x: -0.3 * np.clip(x - 1, 0, None))],
    "on a ramp": [patch((-3, 3), (-3, 3), lambda x: 0.36 * x)],
    "stairs up": [patch((-3, 3), (-1, 1), stairs(1.2, 0.18, 0.28, 6)), risers(1.2, 0.18, 0.28, 6)],
    "at the foot of stairs": [
        patch((-3, 3), (-1, 1), stairs(0.3, 0.18, 0.26, 8)),
        risers(0.3, 0.18, 0.26, 8),
    ],
    "stairs down": [patch((-3, 3), (-1, 1), stairs(0.6, -0.18, 0.28, 8))],
    "on stairs": [patch((-3, 3), (-1, 1), lambda x: 0.17 * np.floor(x / 0.29 + 0.5))],
    "curb and drop": [patch((-3, 3), (-3, 3), lambda x: np.where(x > 2, -1.0, np.where(x > 1.2, 0.15, 0.0)))],
    "overhead": [patch((-3, 3), (-3, 3), flat), patch((-3, 3), (-3, 3), lambda x: 2.2 + 0 * x)],
    "landing over a lower storey": [
        patch((-3, 1.5), (-3, 3), flat),
        patch((1.7, 3), (-3, 3), lambda x: -4.0 + 0 * x),
    ],
    "half landing below": [patch((-3, 1.2), (-3, 3), flat), patch((1.4, 3), (-3, 3), lambda x: -2.0 + 0 * x)],
}


@pytest.mark.parametrize("terrain", TERRAIN)
@pytest.mark.parametrize("noise", [0.0, 0.015])
def test_walkable_ground_is_no_obstacle(terrain, noise):
    assert not rasterise(*TERRAIN[terrain], noise=noise).occupied.any()


POLE = wall((1.6, 1.62), (0.3, 0.32), (0.05, 1.4))


@pytest.mark.parametrize("terrain", ["flat", "ramp up", "ramp down", "on a ramp", "overhead"])
def test_pole_is_an_obstacle(terrain):
    grid = rasterise(*TERRAIN[terrain], POLE, noise=0.01).occupied
    assert near(grid, 1.61, 0.31)
    assert not near(grid, 1.61, -0.5, 0.4)


def test_thin_tube_at_head_height():
    tube = wall((1.5, 1.5), (-0.4, 0.4), (1.2, 1.23), 0.01)
    grid = rasterise(*TERRAIN["flat"], tube).occupied
    assert all(near(grid, 1.5, y) for y in np.linspace(-0.35, 0.35, 8))
    assert not rasterise(*TERRAIN["flat"], tube + np.array([0, 0, 0.4])).occupied.any()


def test_tube_where_the_floor_is_not_seen():
    tube = wall((0.7, 0.7), (-0.3, 0.3), (1.0, 1.03), 0.01)
    assert near(rasterise(*TERRAIN["flat"], tube).occupied, 0.7, 0.0)


def test_walls_railings_and_tables():
    railing = wall((1.2, 2.6), (0.9, 0.9), (0.5, 0.55), 0.02) + np.array([0, 0, 0.0])
    sloped = railing + np.stack([0 * railing[:, 0]] * 2 + [0.64 * (railing[:, 0] - 1.2)], 1)
    grid = rasterise(*TERRAIN["stairs up"], sloped).occupied
    assert all(near(grid, x, 0.9) for x in np.linspace(1.3, 2.5, 7))
    assert not near(grid, 2.0, 0.0, 0.7)
    behind = rasterise(*TERRAIN["flat"], wall((2, 2), (-3, 3), (0, 1.4))).occupied
    assert all(near(behind, 2.0, y) for y in np.linspace(-2.9, 2.9, 30))
    floor = TERRAIN["flat"][0]
    floor = floor[~((floor[:, 0] > 1.3) & (floor[:, 0] < 2.6) & (np.abs(floor[:, 1]) < 0.7))]
    table = patch((1.4, 2.5), (-0.6, 0.6), lambda x: 0.75 + 0 * x)
    top = rasterise(floor, table).occupied
    assert all(near(top, x, y) for x in (1.45, 1.9, 2.4) for y in (-0.5, 0.0, 0.5))


def flight_beside(foot: float = 0.0) -> list[np.ndarray]:
    """A floor and a flight that rises to the left at 1.5 m ahead, 1.2 m wide, its foot in view."""
    floor = patch((-3, 3), (-3, 3), flat)
    treads = patch((1.5, 2.7), (foot, 2.4), flat)
    treads[:, 2] = 0.17 * (np.floor((treads[:, 1] - foot) / 0.28) + 1)
    under = (floor[:, 0] > 1.45) & (floor[:, 0] < 2.7) & (floor[:, 1] > foot)
    side = wall((1.5, 1.5), (foot, 2.4), (0.0, 1.6), 0.02)
    side = side[side[:, 2] < 0.17 * (np.floor((side[:, 1] - foot) / 0.28) + 1)]
    return [floor[~under], treads, side]


def test_a_flight_beside_the_robot_has_an_edge_and_free_treads():
    grid = rasterise(*flight_beside(), noise=0.01).occupied
    assert all(near(grid, 1.55, y) for y in np.linspace(0.5, 2.3, 10))
    assert not any(near(grid, 2.1, y, 0.35) for y in np.linspace(-1.0, 2.0, 12))


def test_a_stepladder_is_no_flight():
    """Rungs 0.3 m apart, one above the other's edge, over a floor that is seen between them."""
    rungs = [
        patch((1.5 + 0.083 * k, 1.58 + 0.083 * k), (-0.24, 0.24), lambda x, k=k: 0.3 * k + 0 * x) for k in range(1, 6)
    ]
    grid = rasterise(*TERRAIN["flat"], *rungs, noise=0.01).occupied
    assert all(near(grid, x, y, 0.06) for x in (1.7, 1.8, 1.9) for y in np.linspace(-0.2, 0.2, 5))


def test_a_railing_above_lower_treads_is_an_obstacle():
    """Measured from the treads it would be higher than the robot; from the landing on which it stands, it is not."""
    landing, lower = patch((-3, 1.5), (-3, 3), flat), patch((1.5, 3), (-3, 3), flat)
    lower[:, 2] = -0.17 * (np.floor((lower[:, 1] + 3) / 0.28) + 1)  # down to the left from the landing's height
    rail = wall((1.45, 1.45), (-2.5, 2.5), (0.98, 1.02), 0.02)
    grid = rasterise(landing, lower, rail, noise=0.01).occupied
    assert all(near(grid, 1.45, y) for y in np.linspace(-2.4, 2.4, 13))


def test_poles_on_stairs_and_on_the_landing():
    for x, z in ((1.9, 0.45), (2.8, 1.0)):
        pole = wall((x, x + 0.02), (-0.4, -0.38), (z + 0.05, z + 1.2))
        grid = rasterise(*TERRAIN["stairs up"], pole, noise=0.01).occupied
        assert near(grid, x, -0.39)
        assert not near(grid, x, 0.5, 0.4)


def test_padding_and_invalid_returns_change_nothing():
    points = torch.from_numpy(visible(np.concatenate([*TERRAIN["stairs up"], POLE]))).float()
    plain = Rasterizer(1)(points[None])
    padded = torch.full((2, len(points) + 50, 3), torch.nan)
    padded[0, : len(points)] = points
    padded[1, 50:] = points.flip(0)
    result = Rasterizer(2)(padded, padded.isfinite().all(2))
    assert torch.equal(result.occupied[0], plain.occupied[0])
    assert torch.equal(result.inflated[1], plain.inflated[0])
    assert result.used.tolist() == [len(points)] * 2
    assert result.broken.tolist() == [0, 0]
    padded[0, 3] = torch.nan
    everything = torch.ones(padded.shape[:2], dtype=torch.bool)
    assert Rasterizer(2)(padded, everything).broken.tolist() == [51, 50]


@settings(max_examples=60, deadline=None)
@given(
    st.tuples(st.integers(2, 40), st.integers(2, 40)),
    st.floats(0, 0.2),
    st.floats(1, 14),
    st.integers(0, 2**32 - 1),
)
@example((3, 2), 0.125, 2.0 - 2e-15, 0)
def test_inflation_is_the_exact_disc(shape, share, radius, seed):
    occupied = np.random.default_rng(seed).random((2, *shape)) < share
    for r in (radius, float(round(radius)), np.hypot(round(radius), 3)):
        ours = inflate(torch.from_numpy(occupied), r).numpy()
        for grid, out in zip(occupied, ours, strict=True):
            exact = np.rint(distance_transform_edt(~grid) ** 2) <= r * r + 1e-9 if grid.any() else grid
            np.testing.assert_array_equal(out, exact)


def test_what_was_seen_is_remembered_at_its_own_place():
    rng = np.random.default_rng(3)
    poles = rng.uniform(-2.0, 2.0, (7, 2))
    spec = OccupancySpec(memory=12, travel=1.5, still=0.0)
    rasterizer = Rasterizer(2, spec)
    floor = torch.from_numpy(patch((-3, 3), (-3, 3), flat)).float()
    pose = np.zeros(3)
    age = np.full(7, 99.0)
    for call in range(19):
        before = pose
        if call:
            c, s = np.cos(pose[2]), np.sin(pose[2])
            pose = pose + np.array([0.07 * c, 0.07 * s, 0.13])
        c, s = np.cos(pose[2]), np.sin(pose[2])
        local = (poles - pose[:2]) @ np.array([[c, -s], [s, c]])
        points = floor[None].repeat(2, 1, 1)
        age += np.where(np.hypot(*local.T) > spec.blind, 1.0, 12 * 0.07 / spec.travel)
        if call == 2:  # seen once, by the first robot alone
            age[:] = 0
            seen = torch.from_numpy(np.column_stack([local, np.full(7, 0.8)])).float()
            points = torch.stack([torch.cat([floor, seen]), torch.cat([floor, floor[:7]])])
        c, s = np.cos(before[2]), np.sin(before[2])
        moved = np.array([[c, s], [-s, c]]) @ (pose - before)[:2]
        motion = torch.tensor([*moved, 0.0, pose[2] - before[2]]).float().expand(2, 4)
        occupied = rasterizer(points, motion=motion).occupied
        assert not occupied[1].any()
        expected = np.zeros((120, 120), bool)
        if (age < 12).any():
            cells = np.floor((local[age < 12] + 3.0) / 0.05 + 1e-9).astype(int)
            inside = ((cells >= 0) & (cells < 120)).all(axis=1)
            expected[tuple(cells[inside].T)] = True
        # a return within a tenth of a millimetre of a border may lie beyond it
        assert (occupied[0].numpy() != expected).sum() <= 2
        assert abs(int(occupied[0].sum()) - expected.sum()) <= 1
    assert (age >= 12).all()


def test_what_is_below_the_sensors_view_is_not_forgotten_while_the_robot_stands_before_it():
    spec = OccupancySpec(memory=5)
    rasterizer = Rasterizer(1, spec)
    floor = torch.from_numpy(patch((-3, 3), (-3, 3), flat)).float()[None]
    near, far = torch.tensor([[0.5, 0.0, 0.4], [1.5, 0.0, 0.4]])
    rasterizer(torch.cat([floor, near[None, None], far[None, None]], dim=1))
    still, back = torch.zeros(1, 4), torch.tensor([[-0.5, 0.0, 0.0, 0.0]])
    for call in range(1, 200):
        occupied = rasterizer(floor, motion=still).occupied[0]
        assert occupied[70, 60]
        assert occupied[90, 60] == (call < 5)
    assert rasterizer(floor, motion=back).occupied[0, 80, 60]
    for _ in range(4):
        occupied = rasterizer(floor, motion=still).occupied[0]
    assert not occupied.any()


def test_a_robot_that_walks_forgets_what_is_near_as_well():
    spec = OccupancySpec(travel=0.58, still=0.1)
    rasterizer = Rasterizer(1, spec)
    floor = torch.from_numpy(patch((-3, 3), (-3, 3), flat)).float()[None]
    rasterizer(torch.cat([floor, torch.tensor([[[0.22, 0.32, 0.4]]])], dim=1))
    for call in range(1, 40):
        occupied = rasterizer(floor, motion=torch.tensor([[0.03, 0.0, 0.0, 0.0]])).occupied[0]
        # every fourth step it is 0.12 m further
        assert occupied.any() == (0.12 * (call // 4) < spec.travel)


@given(seed=st.integers(0, 2**16))
@settings(deadline=None, max_examples=20)
def test_a_robot_that_trembles_and_turns_remembers_what_is_near(seed: int):
    """Some 15 m of way within half of `still` of one place: a bench under the sensor's view stays where it is."""
    rng = np.random.default_rng(seed)
    spec = OccupancySpec()
    rasterizer = Rasterizer(1, spec)
    floor = torch.from_numpy(patch((-3, 3), (-3, 3), flat)).float()[None]
    bench = np.array([0.45, 0.1])
    rasterizer(torch.cat([floor, torch.tensor([[[*bench, 0.4]]])], dim=1))
    pose, way = np.zeros(3), 0.0
    for _ in range(250):
        angle, far = rng.uniform(-np.pi, np.pi), spec.still / 2 * rng.uniform(0.5, 1.0)
        there = np.array([far * np.cos(angle), far * np.sin(angle), pose[2] + rng.uniform(-0.2, 0.2)])
        c, s = np.cos(pose[2]), np.sin(pose[2])
        moved = np.array([[c, s], [-s, c]]) @ (there - pose)[:2]
        way += np.hypot(*moved)
        motion = torch.tensor([[*moved, 0.0, there[2] - pose[2]]]).float()
        pose = there
        occupied = rasterizer(floor, motion=motion).occupied[0].nonzero().numpy()
        c, s = np.cos(pose[2]), np.sin(pose[2])
        local = np.array([[c, s], [-s, c]]) @ (bench - pose[:2])
        assert len(occupied) == 1
        assert np.abs((occupied[0] + 0.5) * spec.cell - 3.0 - local).max() < 2 * spec.cell
    assert way > 10 * spec.still


def test_a_ledge_is_none_any_more_once_climbed():
    rasterizer = Rasterizer(1, OccupancySpec())
    floor = torch.from_numpy(patch((-3, 3), (-3, 3), flat)).float()
    edge = torch.tensor([[0.52, 0.0, 0.45], [0.52, 0.22, 0.4], [0.52, 0.22, 1.1]])  # of a landing, and a post on it
    below = rasterizer(torch.cat([floor, edge])[None]).occupied[0]
    assert below[70, 60]
    assert below[70, 64]
    up = torch.tensor([[0.5, 0.0, 0.45, 0.0]])
    above = rasterizer(floor[None], motion=up).occupied[0]
    assert above.nonzero().tolist() == [[60, 64]]
    again = rasterizer(floor[None], motion=-up).occupied[0]
    assert again.nonzero().tolist() == [[70, 64]]


def test_what_a_robot_that_went_down_passes_beneath_is_none_any_more():
    rasterizer = Rasterizer(1, OccupancySpec())
    floor = torch.from_numpy(patch((-3, 3), (-3, 3), flat)).float()
    seen = torch.tensor([[0.62, 0.0, 1.0], [0.62, 0.42, 0.4]])  # a landing's edge to be, and a post
    assert rasterizer(torch.cat([floor, seen])[None]).occupied[0].nonzero().tolist() == [[72, 60], [72, 68]]
    down = torch.tensor([[0.0, 0.0, -0.9, 0.0]])
    lowered = rasterizer(floor[None], motion=down).occupied[0]
    assert lowered.nonzero().tolist() == [[72, 68]]
    afresh = torch.cat([floor, seen - down[0, :3]])[None]  # seen from there, no more and no less is in the way
    assert torch.equal(Rasterizer(1, OccupancySpec())(afresh).occupied[0], lowered)


def test_up_a_stair_what_is_higher_than_the_robot_is_remembered():
    rasterizer = Rasterizer(1, OccupancySpec())
    stair = torch.from_numpy(patch((-3, 3), (-3, 3), lambda x: 0.6 * np.maximum(x, 0.0))).float()
    post = torch.tensor([[2.02, 0.0, 1.2 + 1.2]])
    assert rasterizer(torch.cat([stair, post])[None]).occupied[0, 100, 60]
    assert rasterizer(stair[None], motion=torch.zeros(1, 4)).occupied[0, 100, 60]


def test_a_memory_of_one_call_is_none():
    rasterizer = Rasterizer(1, OccupancySpec(memory=1))
    floor = torch.from_numpy(patch((-3, 3), (-3, 3), flat)).float()[None]
    assert rasterizer(torch.cat([floor, torch.tensor([[[0.5, 0.0, 0.4]]])], dim=1)).occupied.any()
    assert not rasterizer(floor, motion=torch.zeros(1, 4)).occupied.any()


def test_without_motion_nothing_is_remembered():
    rasterizer = Rasterizer(3, OccupancySpec())
    floor = torch.from_numpy(patch((-3, 3), (-3, 3), flat)).float()
    pole = torch.cat([floor, torch.tensor([[1.0, 0.2, 0.8]])]).expand(3, -1, -1)
    still = torch.zeros(3, 4)
    still[1] = torch.nan
    assert rasterizer(pole).occupied.flatten(1).any(dim=1).all()
    rasterizer.reset(torch.tensor([False, False, True]))
    occupied = rasterizer(floor.expand(3, -1, -1), motion=still).occupied
    assert occupied.flatten(1).any(dim=1).tolist() == [True, False, False]
    assert not rasterizer(floor.expand(3, -1, -1)).occupied.any()


def test_mistakes_are_named():
    with pytest.raises(ValidationError, match="smaller than a cell"):
        OccupancySpec(radius=0.04)
    with pytest.raises(ValidationError, match="too small for a radius"):
        OccupancySpec(size=1.0)
    with pytest.raises(RomnavError, match="points have shape"):
        Rasterizer(2)(torch.zeros(1, 5, 3))
    with pytest.raises(RomnavError, match="valid is"):
        Rasterizer(1)(torch.zeros(1, 5, 3), torch.ones(1, 4, dtype=torch.bool))
    with pytest.raises(RomnavError, match="expected bool"):
        inflate(torch.zeros(4, 4), 2)
