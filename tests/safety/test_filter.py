"""The way from points to command: closed loops among poles, order and workers, bad input."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from romnav.errors import RomnavError
from romnav.safety.barrier import Status
from romnav.safety.filter import SafetyFilter
from romnav.safety.spec import OccupancySpec, PoissonSpec, SafetySpec


def cloud(obstacles: np.ndarray, yaw: np.ndarray, position: np.ndarray) -> torch.Tensor:
    """Vertical poles (robots, K, 2) and a floor, seen from poses: (robots, N, 3) in each robot's frame."""
    heights = np.linspace(0.3, 1.2, 4)
    poles = np.repeat(obstacles, len(heights), axis=1)
    x = np.linspace(-3, 3, 12)
    floor = np.broadcast_to(np.stack(np.meshgrid(x, x), -1).reshape(-1, 2), (len(poles), 144, 2))
    d = poles - position[:, None]
    c, s = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    d = np.stack([c * d[..., 0] + s * d[..., 1], c * d[..., 1] - s * d[..., 0]], -1)
    z = np.concatenate([np.tile(heights, (len(poles), obstacles.shape[1])), np.zeros((len(poles), 144))], 1)
    return torch.from_numpy(np.concatenate([np.concatenate([d, floor], 1), z[..., None]], 2)).float()


def test_closed_loop_from_points_keeps_clear_of_them():
    """A new grid every period, moved and turned with the robot: no pole ever comes within its radius."""
    robots, rng = 24, np.random.default_rng(0)
    filter_ = SafetyFilter(robots, SafetySpec(occupancy=OccupancySpec(size=4.0)), workers=2)
    radius = filter_.spec.occupancy.radius
    poles = rng.uniform(-3, 3, (robots, 14, 2))
    near = np.linalg.norm(poles, axis=2) < 0.6
    poles[near] = 9.0
    position, yaw, closest, travelled = np.zeros((robots, 2)), rng.uniform(0, 6, robots), np.inf, 0.0
    for _ in range(60):
        v = filter_(cloud(poles, yaw, position), torch.tensor([[1.0, 0.0]]).expand(robots, 2)).velocity.double().numpy()
        c, s = np.cos(yaw), np.sin(yaw)
        step = 0.2 * np.stack([c * v[:, 0] - s * v[:, 1], s * v[:, 0] + c * v[:, 1]], 1)
        for share in np.linspace(0, 1, 5):
            clearance = np.linalg.norm(poles - (position + share * step)[:, None], axis=2).min()
            closest = min(closest, clearance)
        position = position + step
        travelled += np.linalg.norm(step, axis=1).mean()
        yaw = yaw + rng.uniform(-0.2, 0.2, robots)
    assert closest > radius
    assert travelled > 4


def test_workers_and_order_do_not_change_a_bit():
    rng = np.random.default_rng(1)
    poles = rng.uniform(-2, 2, (9, 6, 2))
    points = cloud(poles, np.zeros(9), np.zeros((9, 2)))
    velocity = torch.from_numpy(rng.uniform(-1, 1, (9, 2))).float()
    spec = SafetySpec(occupancy=OccupancySpec(size=3.0))
    one, two = SafetyFilter(9, spec), SafetyFilter(9, spec, workers=2)
    turn = torch.randperm(9, generator=torch.Generator().manual_seed(0))
    shuffled = SafetyFilter(9, spec)
    for _ in range(2):
        a, b, c = one(points, velocity), two(points, velocity), shuffled(points[turn], velocity[turn])
        assert torch.equal(a.velocity, b.velocity)
        assert torch.equal(a.velocity[turn], c.velocity)


def test_selected_robots_keep_their_past():
    rng = np.random.default_rng(2)
    points = cloud(rng.uniform(-2, 2, (9, 6, 2)), np.zeros(9), np.zeros((9, 2)))
    velocity = torch.from_numpy(rng.uniform(-1, 1, (9, 2))).float()
    spec = SafetySpec(occupancy=OccupancySpec(size=3.0), poisson=PoissonSpec(sweeps=3, cold_sweeps=30))
    whole, part = SafetyFilter(9, spec), SafetyFilter(9, spec)
    keep = torch.tensor([7, 0, 3, 4, 8, 2])
    motion = torch.from_numpy(rng.uniform(-0.1, 0.1, (9, 4))).float()
    for safe in (whole, part):
        safe(points, velocity)
    part.select(keep)
    for shift in (0.0, 0.3):
        a = whole(points + shift, velocity, motion=motion)
        b = part(points[keep] + shift, velocity[keep], motion=motion[keep])
        assert torch.equal(a.h[keep], b.h)
        assert torch.equal(a.velocity[keep], b.velocity)
    part.reset()  # few sweeps: without its past, h is another
    assert not torch.equal(part(points[keep] + shift, velocity[keep], motion=motion[keep]).h, b.h)


def test_bad_input_stops_the_robot_that_has_it():
    rng = np.random.default_rng(1)
    points = cloud(rng.uniform(1.5, 2.5, (5, 3, 2)), np.zeros(5), np.zeros((5, 2)))
    velocity = torch.full((5, 2), 0.1)
    valid = torch.ones(points.shape[:2], dtype=torch.bool)
    points[1, 3, 2] = torch.nan
    points[2, 3, 2] = torch.inf
    valid[2, 3] = False
    valid[3] = False
    velocity[4, 0] = torch.nan
    out = SafetyFilter(5)(points, velocity, valid)
    expected = [Status.UNCHANGED, Status.NOT_FINITE, Status.UNCHANGED, Status.NO_POINTS, Status.NOT_FINITE]
    assert out.status.tolist() == expected
    moved = torch.tensor([s == Status.UNCHANGED for s in expected])
    assert (out.velocity[~moved] == 0).all()
    assert torch.equal(out.velocity[moved], velocity[moved])


def test_mistakes_are_named():
    filter_ = SafetyFilter(2)
    with pytest.raises(RomnavError, match="points are"):
        filter_(torch.zeros(3, 5, 3), torch.zeros(2, 2))
    points, velocity = torch.zeros(2, 5, 3), torch.zeros(2, 2)
    for wrong in (torch.zeros(2, 3), torch.zeros(2, 2, dtype=torch.int64)):
        with pytest.raises(RomnavError, match=r"velocity is .* expected floating point \(2, 2\)"):
            filter_(points, wrong)
    with pytest.raises(RomnavError, match=r"motion has shape \(7, 4\); expected \(2, 4\)"):
        filter_(points, velocity, motion=torch.zeros(7, 4))
    for mask in (torch.tensor([1]), torch.tensor([True])):
        with pytest.raises(RomnavError, match="expected a mask"):
            filter_.reset(mask)
    for keep in (torch.tensor([True, False]), torch.tensor(1)):
        with pytest.raises(RomnavError, match="expected indices"):
            filter_.select(keep)
    with pytest.raises(RomnavError, match=r"robots are \[2\]; the filter has 2"):
        filter_.select(torch.tensor([2]))
    for none in (lambda: SafetyFilter(0), lambda: filter_.select(torch.tensor([], dtype=torch.int64))):
        with pytest.raises(RomnavError, match="of 0 robots"):
            none()
