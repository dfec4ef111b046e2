"""The LiDAR against an independent ray cast in float64, one ray and one solid at a time."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from torch import Tensor

from romnav.sensing.lidar import Lidar
from romnav.sensing.spec import LidarSpec
from romnav.world.solids import Label, Shape, Solids, SolidsBuilder
from romnav.world.spec import WorldSpec
from romnav.world.tiles import generate

SIDE = 20.0
COARSE = LidarSpec(rows=15, columns=55)


def exact(solids: Solids, origin: NDArray, rays: NDArray) -> NDArray:
    """(..., 4) distance of the first solid of each `Label` along each of ``rays`` (..., 3), tile frame; inf if none."""
    nearest = np.full((*rays.shape[:-1], len(Label)), np.inf)
    for i in range(len(solids)):
        (px, py), half = origin[:2] - solids.centre[i], solids.half[i]
        c, s = math.cos(solids.yaw[i]), math.sin(solids.yaw[i])
        u, v = c * px + s * py, c * py - s * px
        du, dv = c * rays[..., 0] + s * rays[..., 1], c * rays[..., 1] - s * rays[..., 0]
        dz, z = rays[..., 2], origin[2]
        # the solid as half spaces n t <= k along the ray
        planes = [
            (dz - solids.slope_top[i] * du, solids.top[i] + solids.slope_top[i] * u - z),
            (solids.slope_bottom[i] * du - dz, z - solids.bottom[i] - solids.slope_bottom[i] * u),
        ]
        near, far = np.zeros(dz.shape), np.full(dz.shape, np.inf)
        if solids.shape[i] == Shape.BOX:
            planes += [(du, half[0] - u), (-du, half[0] + u), (dv, half[1] - v), (-dv, half[1] + v)]
        else:
            a, b, k = du**2 + dv**2, u * du + v * dv, u * u + v * v - half[0] ** 2
            root = np.sqrt(np.maximum(b * b - a * k, 0))
            near, far = np.maximum((-b - root) / a, 0), np.where(b * b < a * k, -1, (root - b) / a)
        for n, k in planes:
            with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
                near = np.where(n < 0, np.maximum(near, k / n), near)
                far = np.where(n > 0, np.minimum(far, k / n), far)
            far = np.where((n == 0) & (k < 0), -1, far)
        label = solids.label[i]
        nearest[..., label] = np.minimum(nearest[..., label], np.where(near <= far, near, np.inf))
    return nearest


def in_field(spec: LidarSpec, directions: NDArray, roll: float = 0.0, pitch: float = 0.0) -> NDArray:
    """Whether levelled directions lie in the vertical field of the sensor, by its chain of rotations."""

    def rotation(roll: float, pitch: float) -> NDArray:
        cr, sr, cp, sp = math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch)
        about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
        about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
        return about_y @ about_x

    sensor = directions @ (rotation(roll, pitch) @ rotation(math.pi, spec.mount_pitch))
    elevation = np.degrees(np.arcsin(sensor[..., 2]))
    return (elevation >= spec.field[0]) & (elevation <= spec.field[1])


def expected(
    solids: Solids, origin: NDArray, yaw: float, lidar: Lidar, tilt: tuple[float, float] = (0.0, 0.0)
) -> tuple[NDArray, NDArray]:
    """Ranges (...), m, 0 where nothing is seen, and which labels (..., 4) they may have: surfaces may coincide."""
    directions = lidar.directions.double().numpy()
    c, s = math.cos(yaw), math.sin(yaw)
    by_label = exact(solids, origin, directions @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]))
    distance = by_label.min(-1)
    seen = (distance >= lidar.spec.min_range) & (distance <= lidar.spec.max_range)
    seen &= in_field(lidar.spec, directions, *tilt)
    return np.where(seen, distance, 0), by_label <= np.where(seen, distance, -1)[..., None] + 1e-4


def assert_exact(
    lidar: Lidar, solids: list[Solids], pose: tuple[Tensor, Tensor, Tensor], ranges: Tensor, labels: Tensor
) -> None:
    """All but the few rays along edges, which rounding may send past either side of them."""
    tile, origin, yaw = (x.double().numpy() for x in pose)
    truth = [expected(solids[int(t)], o, y, lidar) for t, o, y in zip(tile, origin, yaw, strict=True)]
    assert (np.abs(ranges.numpy() - np.stack([r for r, _ in truth])) > 1e-3).mean() < 6e-5
    possible = np.stack([k for _, k in truth])
    right = np.take_along_axis(possible, np.maximum(labels.numpy(), 0)[..., None].astype(int), -1)[..., 0]
    assert (np.where(labels.numpy() < 0, possible.any(-1), ~right)).mean() < 6e-5


def scan_one(lidar: Lidar, origin: tuple[float, float, float], yaw: float = 0.0) -> NDArray:
    return lidar.scan(torch.zeros(1, dtype=torch.int32), torch.tensor([origin]), torch.tensor([yaw]))[0].numpy()


def ground(builder: SolidsBuilder, height: float = 0.0) -> None:
    builder.box((SIDE / 2, SIDE / 2), (SIDE, SIDE), (height - 0.2, height), label=Label.GROUND)


def clutter(seed: int, count: int = 120) -> Solids:
    """Two floors with everything that a builder can make on and above them."""
    rng = np.random.default_rng(seed)
    b = SolidsBuilder()
    ground(b)
    b.box((4.0, SIDE / 2), (8.0, SIDE), (3.8, 4.0), label=Label.GROUND)
    for _ in range(count):
        centre = tuple(rng.uniform(0, SIDE, 2))
        z = 4.0 * rng.integers(2) * (centre[0] < 8)
        match rng.integers(5):
            case 0:
                b.cylinder(centre, rng.uniform(0.02, 0.5), (z, z + rng.uniform(0.3, 3)))
            case 1:
                b.box(
                    centre,
                    tuple(rng.uniform(0.2, 1.5, 2)),
                    (z, z + rng.uniform(0.1, 2.5)),
                    yaw=rng.uniform(-4, 4),
                )
            case 2:
                size, slope = tuple(rng.uniform(0.5, 2, 2)), rng.uniform(-0.3, 0.3)
                b.box(centre, size, (z - 0.4, z + 0.4), yaw=rng.uniform(-4, 4), slope=slope, label=Label.RAMP)
            case 3:
                b.box(
                    centre,
                    tuple(rng.uniform(0.1, 1, 2)),
                    (z + 1, z + 1.5),
                    slope_bottom=rng.uniform(-0.3, 0.3),
                )
            case _:
                end = tuple(np.add(centre, rng.uniform(-2, 2, 2)))
                b.segment(centre, end, 0.05, (z + 0.8, z + 0.9), rise=rng.uniform(-0.5, 0.5), label=Label.STAIR)
    return b.build()


TILES = [clutter(seed) for seed in range(3)]


def poses(count: int, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    rng = np.random.default_rng(seed)
    origin = rng.uniform((-1, -1, 0.3), (SIDE + 1, SIDE + 1, 6), (count, 3))
    tile = torch.arange(count, dtype=torch.int32) % len(TILES)
    return tile, torch.tensor(origin).float(), torch.tensor(rng.uniform(-7, 7, count)).float()


@pytest.mark.parametrize("spec", [LidarSpec(), COARSE], ids=["paper", "coarse"])
def test_ranges_and_labels_are_exact(spec: LidarSpec) -> None:
    lidar = Lidar(TILES, spec)
    tile, origin, yaw = poses(6)
    ranges, labels = lidar.scan(tile, origin, yaw, labels=True)
    assert_exact(lidar, TILES, (tile, origin, yaw), ranges, labels)
    assert torch.equal(ranges, lidar.scan(tile, origin, yaw))


@pytest.fixture(scope="module")
def generated() -> tuple[list[Solids], tuple[Tensor, Tensor, Tensor]]:
    """One tile of each class and poses of standing robots on it."""
    made = [generate(WorldSpec(), i) for i in (0, 1, 3)]
    rng = np.random.default_rng(0)
    tile = np.arange(24) % len(made)
    ground = np.stack([made[t][1].position[rng.integers(len(made[t][1].position))] for t in tile])
    origin = torch.tensor(ground + np.array([0, 0, COARSE.height])).float()
    yaw = torch.tensor(rng.uniform(-4, 4, len(tile))).float()
    return [t.solids for t, _ in made], (torch.tensor(tile, dtype=torch.int32), origin, yaw)


def test_tiles_of_each_class(generated: tuple[list[Solids], tuple[Tensor, Tensor, Tensor]]) -> None:
    solids, pose = generated
    lidar = Lidar(solids, COARSE)
    ranges, labels = lidar.scan(*pose, labels=True)
    assert_exact(lidar, solids, pose, ranges, labels)
    assert len(np.unique(labels)) >= 4


def test_large_tiles_lose_nothing_to_their_lists() -> None:
    """A tile of three storeys and one outdoors, 40 m wide, from standing poses and from anywhere."""
    made = [generate(WorldSpec(side=40.0), i) for i in (0, 1)]
    solids = [t.solids for t, _ in made]
    rng = np.random.default_rng(0)
    standing = np.concatenate([g.position[rng.integers(len(g.position), size=6)] for _, g in made])
    anywhere = rng.uniform((-3, -3, -1), (43, 43, 14), (12, 3))
    origin = torch.tensor(np.concatenate([standing + np.array([0, 0, COARSE.height]), anywhere])).float()
    tile = torch.tensor([0] * 6 + [1] * 6 + [0, 1] * 6, dtype=torch.int32)
    pose = tile, origin, torch.tensor(rng.uniform(-4, 4, len(tile))).float()
    lidar = Lidar(solids, COARSE)
    ranges, labels = lidar.scan(*pose, labels=True)
    assert_exact(lidar, solids, pose, ranges, labels)


def test_mesh_backend_agrees(generated: tuple[list[Solids], tuple[Tensor, Tensor, Tensor]]) -> None:
    solids, pose = generated
    ranges, labels = Lidar(solids, LidarSpec()).scan(*pose, labels=True)
    mesh = Lidar(solids, LidarSpec(backend="mesh"))
    mesh_ranges, mesh_labels = mesh.scan(*pose, labels=True)
    assert ((ranges - mesh_ranges).abs() > 0.01).float().mean() < 3e-4
    assert (labels != mesh_labels).float().mean() < 3e-4


@pytest.mark.parametrize("backend", ["columns", "mesh"])
def test_inside_a_solid_nothing_is_seen(backend: Literal["columns", "mesh"]) -> None:
    b = SolidsBuilder()
    ground(b)
    b.box((10.0, 10.0), (1.0, 1.0), (0.0, 2.0))
    spec = LidarSpec(rows=15, columns=55, backend=backend)
    assert (scan_one(Lidar([b.build()], spec), (10.0, 10.0, 1.265)) == 0).all()


@settings(max_examples=100, deadline=None)
@given(
    shape=st.sampled_from(["box", "cylinder"]),
    centre=st.tuples(st.floats(-6, 6), st.floats(-6, 6)),
    size=st.tuples(st.floats(0.02, 8), st.floats(0.02, 8)),
    base=st.floats(-3, 3),
    thickness=st.floats(0.02, 3),
    angle=st.floats(-4, 4),
    slope=st.floats(-1, 1),
    slope_bottom=st.floats(-1, 1),
    azimuth=st.sampled_from([90.0, 180.0, 220.0, 360.0]),
)
def test_any_single_solid(
    shape: str,
    centre: tuple[float, float],
    size: tuple[float, float],
    base: float,
    thickness: float,
    angle: float,
    slope: float,
    slope_bottom: float,
    azimuth: float,
) -> None:
    assume(thickness > abs(slope - slope_bottom) * size[0] / 2)  # lids that do not cross
    b = SolidsBuilder()
    if shape == "box":
        z = (base, base + thickness)
        b.box(centre, size, z, yaw=angle, slope=slope, slope_bottom=slope_bottom)
    else:
        b.cylinder(centre, size[0] / 2, (base, base + thickness))
    solids = b.build()
    lidar = Lidar([solids], COARSE.model_copy(update={"azimuth": azimuth}))
    truth, _ = expected(solids, np.zeros(3), 0.0, lidar)
    # rays along an edge may fall on either side of it
    assert (np.abs(scan_one(lidar, (0.0, 0.0, 0.0)) - truth) > 1e-3).sum() <= 2


def test_field_of_view_follows_the_torso() -> None:
    b = SolidsBuilder()
    ground(b)
    b.box((10, 10), (SIDE, SIDE), (3.0, 3.2))
    for i in range(4):
        angle = math.pi / 2 * i
        b.box((10 + 9 * math.cos(angle), 10 + 9 * math.sin(angle)), (0.2, SIDE), (0, 3), yaw=angle)
    solids = b.build()
    lidar = Lidar([solids], LidarSpec())
    tilt = torch.tensor([[0.0, 0.0], [0.2, 0.0], [0.0, -0.15], [-0.1, 0.3]])
    zeros = torch.zeros(4, dtype=torch.int32)
    origin, yaw = torch.tensor([[10.0, 10.0, 1.265]]).repeat(4, 1), torch.full((4,), 0.3)
    ranges = lidar.scan(zeros, origin, yaw, tilt=tilt).numpy()
    directions = lidar.directions.double().numpy()
    for image, (roll, pitch) in zip(ranges, tilt.tolist(), strict=True):
        assert ((image > 0) != in_field(lidar.spec, directions, roll, pitch)).mean() < 1e-3
    level = lidar.scan(zeros, origin, yaw).numpy()
    np.testing.assert_array_equal(level[0], ranges[0])
    # standing, the image's own edges cut the field ahead by less than a pixel
    assert (level[0, 1:-1, 80:140] > 0).all()


def test_order_of_environments_and_threads_do_not_matter() -> None:
    lidar = Lidar(TILES, COARSE)
    tile, origin, yaw = poses(31)
    ranges, labels = lidar.scan(tile, origin, yaw, labels=True)
    order = torch.randperm(31, generator=torch.Generator().manual_seed(0))
    shuffled, shuffled_labels = lidar.scan(tile[order], origin[order], yaw[order], labels=True)
    assert torch.equal(shuffled, ranges[order])
    assert torch.equal(shuffled_labels, labels[order])
    threads = torch.get_num_threads()
    try:
        for count in (1, 3):
            torch.set_num_threads(count)
            assert torch.equal(lidar.scan(tile, origin, yaw), ranges)
    finally:
        torch.set_num_threads(threads)


def test_coarse_image_is_a_subset_of_a_finer_one() -> None:
    tile, origin, yaw = poses(9)
    fine = Lidar(TILES, LidarSpec(rows=45, columns=165)).scan(tile, origin, yaw)
    coarse = Lidar(TILES, COARSE).scan(tile, origin, yaw)
    assert ((fine[:, 1::3, 1::3] - coarse).abs() > 1e-3).float().mean() < 1e-4


@pytest.mark.parametrize("columns", [220, 55])
def test_thin_pole_is_seen(columns: int) -> None:
    b = SolidsBuilder()
    ground(b)
    b.cylinder((13.0, 10.0), 0.01, (0.0, 1.5))
    lidar = Lidar([b.build()], LidarSpec(columns=columns))
    # some column looks at the pole in the course of a turn by one pixel, as its width asks for
    turns = np.linspace(0, math.radians(220 / columns), 24 * 220 // columns)
    seen = sum((np.abs(scan_one(lidar, (10.0, 10.0, 1.265), yaw)[6] - 2.99) < 0.02).sum() for yaw in turns)
    assert seen == pytest.approx(len(turns) * 2 * math.degrees(0.01 / 3) * columns / 220, abs=2)
    assert seen >= 1


def test_nothing_beyond_the_tile_but_solids() -> None:
    b = SolidsBuilder()
    ground(b)
    lidar = Lidar([b.build()], LidarSpec())
    image = scan_one(lidar, (19.0, 10.0, 1.265))
    ahead = image[:, 109:111]
    below = np.degrees(np.arcsin(lidar.directions[:, 110, 2].numpy()))
    # the ground ends one metre ahead
    assert (ahead[below > -math.degrees(math.atan(1.265))] == 0).all()
    assert (ahead[(below < -52.2) & (below > -54)] > 0).all()
    b.box((25.0, 10.0), (0.2, 10.0), (0.0, 3.0))
    beyond = scan_one(Lidar([b.build()], LidarSpec()), (19.0, 10.0, 1.265))
    assert beyond[4, 110] == pytest.approx(5.9, abs=0.01)


def test_limits_of_range() -> None:
    b = SolidsBuilder()
    b.box((0.0, 0.0), (0.1, 8.0), (-9.0, 9.0))
    lidar = Lidar([b.build()], LidarSpec(max_range=5.0))
    assert (scan_one(lidar, (-0.1, 0.0, 0.0))[:, 110] == 0).mean() > 0.9  # closer than the nearest return
    assert scan_one(lidar, (-4.9, 0.0, 0.0))[3, 110] == pytest.approx(4.85, abs=0.01)
    assert (scan_one(lidar, (-5.2, 0.0, 0.0)) == 0).all()
