"""The depth camera against an independent ray cast at the exact triangle mesh, and its own conventions."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from romnav.sensing.depth import DepthCamera
from romnav.sensing.spec import DepthSpec
from romnav.world.mesh import triangulate
from romnav.world.solids import Label, Solids, SolidsBuilder

SPEC = DepthSpec()


def scene(seed: int) -> Solids:
    rng = np.random.default_rng(seed)
    b = SolidsBuilder()
    b.box((4, 4), (8, 8), (-0.2, 0.0), label=Label.GROUND, layers=(0, 0))
    for _ in range(12):
        low = rng.uniform(-0.1, 0.9)
        at, size, yaw = tuple(rng.uniform(2, 6, 2)), tuple(rng.uniform(0.1, 0.9, 2)), rng.uniform(-3, 3)
        slope = rng.uniform(-0.4, 0.4)
        b.box(
            at,
            size,
            (low, low + 0.5),
            yaw=yaw,
            slope=slope,
            slope_bottom=slope / 2,
            label=Label(rng.integers(1, 4)),
        )
    b.cylinder((4.3, 4.5), 0.15, (0.0, 0.7))
    return b.build()


def cast(solids: Solids, origin: NDArray, rays: NDArray) -> tuple[NDArray, NDArray]:
    """Nearest hit (inf if none) of rays (P, 3) with the mesh, by Moeller and Trumbore's test, and its label."""
    mesh = triangulate(solids, segments=720)
    a, b, c = mesh.corners.transpose(1, 0, 2)
    nearest, label = np.full(len(rays), np.inf), np.full(len(rays), -1)
    for i, ray in enumerate(rays):
        p = np.cross(ray, c - a)
        det = np.einsum("tk,tk->t", b - a, p)
        with np.errstate(divide="ignore", invalid="ignore"):
            s = origin - a
            u = np.einsum("tk,tk->t", s, p) / det
            q = np.cross(s, b - a)
            v = q @ ray / det
            t = np.einsum("tk,tk->t", c - a, q) / det
        t = np.where((np.abs(det) > 1e-15) & (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0), t, np.inf)
        k = t.argmin()
        if np.isfinite(t[k]):
            nearest[i], label[i] = t[k], mesh.label[k]
    return nearest, label


@pytest.mark.parametrize(("seed", "tilt"), [(0, (0.0, 0.0)), (1, (0.15, -0.2)), (2, (-0.1, 0.3))])
def test_depth_is_that_of_the_exact_mesh(seed: int, tilt: tuple[float, float]) -> None:
    solids, origin, yaw = scene(seed), np.array([4.0, 4.0, 1.9]), 0.7 + seed
    camera = DepthCamera([scene(9), solids], SPEC)
    depth, labels = camera.scan(
        torch.tensor([1]), torch.tensor(origin)[None], torch.tensor([yaw]), labels=True, tilt=torch.tensor([tilt])
    )
    turn = Rotation.from_euler("ZYX", [yaw, tilt[1], tilt[0]])
    rays = turn.apply(camera.directions.reshape(-1, 3).double().numpy())
    expected, classes = cast(solids, origin, rays)
    seen = (expected >= SPEC.min_range) & (expected < SPEC.max_range)
    found, found_classes = depth.flatten().numpy(), labels.flatten().numpy()
    agree = np.abs(found - np.where(seen, expected, 0)) < 1e-4
    assert agree.mean() > 0.99  # rays through an edge may fall to either side
    assert (found_classes == np.where(seen, classes, -1))[agree].mean() > 0.999
    assert (found_classes >= 0).mean() > 0.9
    assert len(set(found_classes.tolist())) >= 3


def test_the_image_looks_down_ahead() -> None:
    rays = DepthCamera([scene(0)], SPEC).directions
    centre = rays.mean((0, 1))
    torch.testing.assert_close(
        centre, torch.tensor([math.cos(math.pi / 3), 0.0, -math.sin(math.pi / 3)]), atol=1e-6, rtol=0
    )
    torch.testing.assert_close((rays @ centre), torch.ones(26, 30))
    assert (rays[0, :, 2] > rays[-1, :, 2]).all()
    assert (rays[:, 0, 1] > 0).all()
    edge = math.degrees(math.atan2(float(rays[13, 0, 1] - rays[13, -1, 1]) / 2 * 30 / 29, 1.0))
    assert edge == pytest.approx(85 / 2, abs=0.01)


def test_flat_ground_and_the_limits() -> None:
    b = SolidsBuilder()
    b.box((0, 0), (100, 100), (-1.0, 0.0), label=Label.GROUND)
    camera = DepthCamera([b.build()], DepthSpec(max_range=2.0))
    depth, labels = camera.scan(
        torch.zeros(2), torch.tensor([[0.0, 0, 1.2], [3.0, 1, -0.5]]), torch.tensor([0.0, 2.0]), labels=True
    )
    exact = -1.2 / camera.directions[..., 2]
    exact = torch.where((camera.directions[..., 2] < 0) & (exact < 2.0), exact, 0)
    torch.testing.assert_close(depth[0], exact, atol=1e-4, rtol=0)
    assert torch.equal(labels[0] == Label.GROUND, exact > 0)
    assert (depth[1] == 0).all()
    assert (labels[1] == -1).all()


def test_environments_are_independent_of_batch_and_threads() -> None:
    camera = DepthCamera([scene(0), scene(1)], SPEC)
    generator = torch.Generator().manual_seed(0)
    origin = torch.tensor([4.0, 4.0, 1.6]) + torch.rand(9, 3, generator=generator)
    tile, yaw = torch.arange(9) % 2, 6.0 * torch.rand(9, generator=generator)
    whole = camera.scan(tile, origin, yaw)
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(3)
        assert torch.equal(camera.scan(tile.flip(0), origin.flip(0), yaw.flip(0)).flip(0), whole)
    finally:
        torch.set_num_threads(threads)
