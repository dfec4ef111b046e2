"""The quadratic program against OSQP and brute force; the discrete-time filter in random worlds."""

from __future__ import annotations

import numpy as np
import osqp
import pytest
import scipy.sparse as sparse
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import map_coordinates

from romnav.errors import RomnavError
from romnav.safety.barrier import Status, cbf_qp, filter_velocity
from romnav.safety.occupancy import inflate
from romnav.safety.poisson import PoissonSolver
from romnav.safety.spec import FilterSpec, OccupancySpec, PoissonSpec

CELL = 0.05
LOWER, UPPER = (-0.5, -0.25), (1.0, 0.25)


def qp_cases(count: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    desired = rng.uniform(-1.5, 1.5, (count, 2))
    normal = rng.normal(size=(count, 2)) * 10 ** rng.uniform(-2, 1, (count, 1))
    normal[::7, 0] = 0
    normal[3::7, 1] = 0
    return desired, normal, rng.normal(size=count) * np.linalg.norm(normal, axis=1)


def solve_qp(desired: np.ndarray, normal: np.ndarray, bound: np.ndarray, box: bool) -> tuple[np.ndarray, np.ndarray]:
    limits = (LOWER, UPPER) if box else ()
    v, feasible = cbf_qp(torch.from_numpy(desired), torch.from_numpy(normal), torch.from_numpy(bound), *limits)
    return v.numpy(), feasible.numpy()


def test_a_million_programs_agree_with_enumerated_active_sets():
    """Every candidate of the box program: the box's nearest point, the foot, and the line's cuts with the
    sides."""
    desired, normal, bound = qp_cases(1_000_000, 0)
    v, feasible = solve_qp(desired, normal, bound, box=True)
    low, high = np.array(LOWER), np.array(UPPER)
    square = (normal**2).sum(1)
    candidates = [
        np.clip(desired, low, high),
        desired + normal * ((bound - (normal * desired).sum(1)) / square)[:, None],
    ]
    for k in (0, 1):
        for side in (low[k], high[k]):
            point = np.full_like(desired, side)
            np.divide(
                bound - normal[:, k] * side,
                normal[:, 1 - k],
                out=point[:, 1 - k],
                where=normal[:, 1 - k] != 0,
            )
            candidates.append(point)
    best = np.full(len(desired), np.inf)
    scale = np.sqrt(square)
    for point in candidates:
        fits = ((point >= low - 1e-9) & (point <= high + 1e-9)).all(1)
        fits &= (normal * point).sum(1) >= bound - 1e-9 * scale
        best = np.where(fits, np.minimum(best, ((point - desired) ** 2).sum(1)), best)
    clear = np.abs(np.maximum(normal * low, normal * high).sum(1) - bound) > 1e-6 * scale
    assert (np.isfinite(best) == feasible)[clear].all()
    ours = ((v - desired) ** 2).sum(1)
    both = feasible & np.isfinite(best)
    assert both.mean() > 0.3
    assert np.abs(ours - best)[both].max() < 1e-7
    assert ((v >= low) & (v <= high)).all()
    assert ((normal * v).sum(1) >= bound - 1e-9 * scale)[feasible].all()
    corner = np.maximum(normal * low, normal * high).sum(1)
    np.testing.assert_allclose((normal * v).sum(1)[~feasible], corner[~feasible], atol=1e-12)


@pytest.mark.parametrize("box", [False, True])
def test_agrees_with_osqp(box):
    desired, normal, bound = qp_cases(1500, 1)
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    bound = np.clip(bound, -1, 0.2)
    v, feasible = solve_qp(desired, normal, bound, box)
    low, high = (LOWER, UPPER) if box else ((-np.inf,) * 2, (np.inf,) * 2)
    solver = osqp.OSQP()
    constraints = sparse.csc_matrix(np.vstack([np.ones((1, 2)), np.eye(2)]))
    solver.setup(
        sparse.csc_matrix(2 * np.eye(2)), np.zeros(2), constraints, np.r_[0.0, low], np.r_[np.inf, high],
        verbose=False, eps_abs=1e-9, eps_rel=1e-9, max_iter=20000,
    )  # fmt: skip
    compared = 0
    for k in range(len(v)):
        data = np.array([normal[k, 0], 1.0, normal[k, 1], 1.0])
        solver.update(q=-2 * desired[k], l=np.r_[bound[k], low], Ax=data)
        result = solver.solve(raise_error=False)
        if feasible[k] and result.info.status == "solved":
            np.testing.assert_allclose(v[k], result.x, atol=1e-5)
            compared += 1
    assert compared > 1400
    assert feasible.all() or box


def world(n: int, rng: np.random.Generator) -> np.ndarray:
    """Rectangles (concave corners), discs and walls with gaps of one to four cells."""
    i, j = np.indices((n, n))
    occupied = np.zeros((n, n), bool)
    for _ in range(rng.integers(1, 6)):
        a, b, h, w = rng.integers(0, n, 2).tolist() + rng.integers(1, n // 3, 2).tolist()
        occupied[a : a + h, b : b + w] = True
    for x, y, r in rng.uniform((0, 0, 1), (n, n, 5), (rng.integers(0, 4), 3)):
        occupied |= (i - x) ** 2 + (j - y) ** 2 <= r**2
    if rng.random() < 0.5:
        row, gap = rng.integers(2, n - 2), rng.integers(0, n - 4)
        occupied[row : row + rng.integers(1, 3)] = True
        occupied[row : row + 2, gap : gap + rng.integers(1, 5)] = False
    occupied[n // 2, n // 2] = False
    return occupied


def worlds(robots: int, n: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.stack([world(n, rng) for _ in range(robots)])


def level(h: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Bilinear h at positions (robots, samples, 2)."""
    robots = np.broadcast_to(np.arange(len(h))[:, None], position.shape[:2])
    return map_coordinates(
        h.astype(float), [robots, position[..., 0] / CELL, position[..., 1] / CELL], order=1, mode="nearest"
    )


def starts(h: np.ndarray, inside: bool, seed: int) -> np.ndarray:
    """A random position per world with h > 0, or with h < 0 and a slope to follow; NaN if there is none."""
    rng = np.random.default_rng(seed)
    position = rng.uniform(0, (np.array(h.shape[1:]) - 1) * CELL, (60, len(h), 2))
    fits = np.array([(level(h, p[:, None])[:, 0] > 0) != inside for p in position])
    chosen = position[fits.argmax(0), np.arange(len(h))]
    chosen[~fits.any(0)] = np.nan
    return chosen


@pytest.mark.parametrize("box", [False, True])
def test_integrator_never_enters_an_obstacle(box):
    """Thousands of worlds, robots pushed in a direction that changes every few seconds, h watched between
    samples."""
    robots, n = 2000, 32
    spec = FilterSpec(box=box)
    grids = worlds(robots, n, 0)
    h = PoissonSolver(robots, (n, n), CELL, PoissonSpec(cold_sweeps=100)).solve(torch.from_numpy(grids))
    field = h.numpy()
    position = starts(field, inside=False, seed=1)
    keep = np.isfinite(position[:, 0])
    assert keep.mean() > 0.95
    h, field, position = h[torch.from_numpy(keep)], field[keep], position[keep]
    rng = np.random.default_rng(2)
    share = np.linspace(0, 1, 33)[None, :, None]
    travelled = np.zeros(len(position))
    for k in range(60):
        if k % 12 == 0:
            angle = rng.uniform(0, 2 * np.pi, len(position))
            desired = np.stack([np.cos(angle), np.sin(angle)], 1)
        out = filter_velocity(h, CELL, torch.from_numpy(position), torch.from_numpy(desired), spec)
        v = out.velocity.numpy()
        path = position[:, None] + share * v[:, None] * spec.period
        assert level(field, path).min() > 0
        assert ((out.gradient.numpy() * v).sum(1) >= -spec.alpha * out.h.numpy() - 1e-9).all()
        position = path[:, -1]
        travelled += np.linalg.norm(v, axis=1) * spec.period
    assert np.median(travelled) > 0.3


def test_robot_inside_an_obstacle_leaves_and_does_not_return():
    """Inflated discs, the robot inside of one, its policy pushing anywhere."""
    robots, n = 300, 64
    rng = np.random.default_rng(5)
    seeds = rng.random((robots, n, n)) < 0.001
    seeds[:, n // 2, n // 2] = True
    seeds[:, 5, 5] = False
    grids = inflate(torch.from_numpy(seeds), 8.14)
    grids = grids[~grids.all(2).all(1)]
    h = PoissonSolver(len(grids), (n, n), CELL).solve(grids)
    field = h.numpy()
    position = (n // 2 + rng.uniform(-5, 5, (len(grids), 2))) * CELL
    inside = level(field, position[:, None])[:, 0] <= 0
    assert inside.mean() > 0.9
    ever_free = ~inside
    angle = rng.uniform(0, 2 * np.pi, len(grids))
    desired = torch.from_numpy(np.stack([np.cos(angle), np.sin(angle)], 1))
    for _ in range(100):
        out = filter_velocity(h, CELL, torch.from_numpy(position), desired)
        position = position + out.velocity.numpy() * 0.2
        now = level(field, position[:, None])[:, 0]
        assert (now > 0)[ever_free].all()
        ever_free |= now > 0
    assert ever_free.all()


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.05, 1.5), st.floats(0, 6.28))
def test_safe_commands_pass_and_others_move_least(seed, speed, angle):
    spec = FilterSpec(box=False)
    grids = worlds(25, 24, seed)
    h = PoissonSolver(25, (24, 24), CELL, PoissonSpec(cold_sweeps=60)).solve(torch.from_numpy(grids))
    position = starts(h.numpy(), inside=False, seed=seed)
    # Where h is within a thousandth of a cell of zero, the filter leads out.
    keep = level(h.numpy(), np.nan_to_num(position)[:, None])[:, 0] > 1e-3 * CELL
    h, position = h[torch.from_numpy(keep)], position[keep]
    desired = np.tile([speed * np.cos(angle), speed * np.sin(angle)], (len(h), 1))
    out = filter_velocity(h, CELL, torch.from_numpy(position), torch.from_numpy(desired), spec)
    v, rate, value = out.velocity.numpy(), (out.gradient.numpy() * desired).sum(1), out.h.numpy()
    path = level(h.numpy(), position[:, None] + np.linspace(0, 1, 65)[None, :, None] * desired[:, None] * spec.period)
    end = position + desired * spec.period
    stays = ((end >= 0) & (end <= 23 * CELL)).all(1)
    safe = (rate > -spec.alpha * value + 1e-3) & (path.min(1) > 0.51 * value) & stays
    assert (v == desired)[safe].all()
    assert (out.status.numpy() == Status.UNCHANGED)[safe].all()
    # A projection onto a half-plane that holds zero, then a scaling: v lies in the ball over the desired
    # velocity.
    assert ((v * (desired - v)).sum(1) >= -1e-9).all()


def test_gradient_is_that_of_the_interpolated_function():
    """In the middle of a patch, where a robot-centred grid has its robot, and smoothly elsewhere."""
    h = PoissonSolver(1, (24, 24), CELL).solve(torch.from_numpy(worlds(1, 24, 4)))
    rng = np.random.default_rng(0)
    field = h.numpy()
    cells = rng.integers(0, 23, (500, 2))
    for x, reach in (
        ((cells + 0.5) * CELL, 1e-4),
        ((cells + rng.uniform(0.01, 0.99, (500, 2))) * CELL, CELL / 2),
    ):
        inner = ((x > reach) & (x < 23 * CELL - reach)).all(1)
        x = x[inner]
        out = filter_velocity(h.expand(len(x), -1, -1), CELL, torch.from_numpy(x), torch.zeros(len(x), 2).double())
        np.testing.assert_allclose(out.h, level(field, x[None])[0], atol=1e-9)
        for k, step in enumerate(np.eye(2) * reach):
            slope = (level(field, (x + step)[None]) - level(field, (x - step)[None]))[0] / (2 * reach)
            np.testing.assert_allclose(out.gradient[:, k], slope, atol=1e-6)


def test_gradient_converges_to_that_of_the_exact_solution():
    """On a disc, grad h = -x / R, against the filter's slope at random points."""
    errors = []
    for n in (40, 160):
        x = (np.arange(n) + 0.5) * 2 / n - 1
        free = np.hypot(x[:, None], x) < 0.9
        h = PoissonSolver(1, (n, n), 2 / n, PoissonSpec(cold_sweeps=3000)).solve(torch.from_numpy(~free)[None])
        rng = np.random.default_rng(0)
        r, angle = rng.uniform(0.1, 0.8, 300), rng.uniform(0, 2 * np.pi, 300)
        point = np.stack([r * np.cos(angle), r * np.sin(angle)], 1)
        position = torch.from_numpy(point - x[0])
        out = filter_velocity(h.expand(300, -1, -1), 2 / n, position, torch.zeros(300, 2))
        errors.append(np.abs(out.gradient.numpy() + point / 0.9).max())
    assert errors[1] < 0.02
    assert errors[0] / errors[1] > 2.5


def test_passes_a_gap_of_three_cells():
    occupied = torch.zeros(1, 40, 40, dtype=torch.bool)
    occupied[0, 18:22] = True
    occupied[0, 18:22, 19:22] = False
    h = PoissonSolver(1, (40, 40), CELL).solve(occupied)
    position = torch.tensor([[10 * CELL, 20 * CELL]], dtype=torch.double)
    for _ in range(100):
        position += 0.2 * filter_velocity(h, CELL, position, torch.tensor([[0.5, 0.0]], dtype=torch.double)).velocity
    assert position[0, 0] > 28 * CELL


def test_positive_h_proves_that_the_disc_is_clear():
    """Whatever the rounding of points to cells: h > 0 means every point is farther than the robot's
    radius."""
    spec = OccupancySpec(size=4.0)
    rng = np.random.default_rng(0)
    half = spec.size / 2
    for _ in range(20):
        points = rng.uniform(-half, half, (6, 2))
        n = round(spec.size / CELL)
        occupied = np.zeros((1, n, n), bool)
        occupied[0, *np.floor((points + half) / CELL).astype(int).T] = True
        inflated = inflate(torch.from_numpy(occupied), (spec.radius + spec.margin) / CELL)
        h = PoissonSolver(1, (n, n), CELL).solve(inflated).numpy()
        x = rng.uniform(0, (n - 1) * CELL, (4000, 2))
        free = level(h, x[None])[0] > 0
        nearest = np.linalg.norm(x[:, None] + CELL / 2 - half - points, axis=2).min(1)
        assert nearest[free].min() > spec.radius


def test_nothing_to_go_by_stops_the_robot():
    h = PoissonSolver(3, (20, 20), CELL).solve(torch.ones(3, 20, 20, dtype=torch.bool))
    position = torch.tensor([[0.5, 0.5], [-0.01, 0.5], [torch.nan, 0.5]])
    out = filter_velocity(h, CELL, position, torch.ones(3, 2))
    assert out.status.tolist() == [Status.BLOCKED, Status.OUTSIDE, Status.NOT_FINITE]
    assert (out.velocity == 0).all()


def test_h_that_is_not_finite_stops_the_robot():
    h = torch.ones(2, 10, 10)
    h[0, 4:6, 4:6] = torch.nan
    h[1, 6, :] = torch.nan
    position = torch.tensor([[4.5 * CELL, 4.5 * CELL], [4.5 * CELL, 4.5 * CELL]])
    out = filter_velocity(h, CELL, position, torch.tensor([[1.0, 0.0], [1.0, 0.0]]))
    assert out.status.tolist() == [Status.NOT_FINITE, Status.FILTERED]
    assert (out.velocity[0] == 0).all()
    assert (position[1] + 0.2 * out.velocity[1])[0] <= 5 * CELL + 1e-6


def test_never_leaves_the_grid():
    h = torch.ones(1, 10, 10)
    position = torch.tensor([[8.5 * CELL, 8.5 * CELL]])
    out = filter_velocity(h, CELL, position, torch.tensor([[1.0, 1.0]]), FilterSpec(box=False))
    end = position + 0.2 * out.velocity
    assert ((end < 9 * CELL) & (end > 8.99 * CELL)).all()


def test_mistakes_are_named():
    h = torch.ones(2, 10, 10)
    with pytest.raises(RomnavError, match=r"position is torch.float32 \(1, 2\); expected floating point"):
        filter_velocity(h, CELL, torch.zeros(1, 2), torch.zeros(2, 2))
    with pytest.raises(RomnavError, match="h is torch"):
        filter_velocity(h.double(), CELL, torch.zeros(2, 2), torch.zeros(2, 2))
