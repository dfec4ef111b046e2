"""Poisson safety functions against analytic solutions and a sparse direct solve."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sparse
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse.linalg import spsolve

from romnav.errors import RomnavError
from romnav.safety.poisson import PoissonSolver
from romnav.safety.spec import PoissonSpec

CONVERGED = PoissonSpec(cold_sweeps=3000)


def solve(occupied: np.ndarray, cell: float, spec: PoissonSpec = CONVERGED) -> np.ndarray:
    solver = PoissonSolver(1, occupied.shape, cell, spec)
    return solver.solve(torch.from_numpy(occupied)[None])[0].numpy().astype(float)


def radii(n: int) -> tuple[np.ndarray, float]:
    """Distance of cell centres from the middle of an n x n grid of side 2 m, and the cell."""
    x = (np.arange(n) + 0.5) * 2 / n - 1
    return np.hypot(x[:, None], x), 2 / n


def order(sizes: list[int], errors: list[float]) -> float:
    return -np.polyfit(np.log(sizes), np.log(errors), 1)[0]


def test_disc_converges_at_first_order():
    """h = (R^2 - r^2) / (2 R); the boundary is a staircase, so the order is one."""
    errors, sizes = [], [24, 48, 96, 192]
    for n in sizes:
        r, cell = radii(n)
        error = []
        for radius in (0.71, 0.76, 0.81, 0.86):
            h, inside = solve(r > radius, cell), r <= radius
            error.append(np.abs(h - (radius**2 - r**2) / (2 * radius))[inside].max() / (radius / 2))
        errors.append(np.mean(error))
    assert order(sizes, errors) > 0.8
    assert errors[-1] < 0.02


def test_annulus_converges_at_first_order():
    """h = -f r^2 / 4 + c ln r + d with f = P / A = 2 / (b - a)."""
    a, b, errors, sizes = 0.31, 0.87, [], [24, 48, 96, 192]
    f = 2 / (b - a)
    c = f * (b**2 - a**2) / (4 * np.log(b / a))
    for n in sizes:
        r, cell = radii(n)
        free = (r > a) & (r < b)
        exact = -f * (r**2 - a**2) / 4 + c * np.log(np.maximum(r, 1e-9) / a)
        h = solve(~free, cell)
        errors.append(np.abs(h - exact)[free].max() / exact[free].max())
    assert order(sizes, errors) > 0.8
    assert errors[-1] < 0.03


def test_strip_converges_at_second_order():
    """Aligned with the grid nothing is a staircase: the parabola across a long strip is met at order two."""
    errors, sizes = [], [4, 8, 16, 32]
    for n in sizes:
        h = solve(np.zeros((n, 8 * n), bool), 1 / n)
        across = h[:, 4 * n]
        x = (np.arange(n) + 0.5) / n
        # The perimeter's estimate scales h as a whole; curvature tells the forcing that was used.
        forcing = -(across[n // 2 - 2] - 2 * across[n // 2 - 1] + across[n // 2]) * n**2
        errors.append(np.abs(across - forcing * x * (1 - x) / 2).max() / (forcing / 8))
    assert order(sizes, errors) > 1.8
    assert errors[-1] < 2e-3


def test_mean_slope_at_the_boundary_is_one():
    """The average-flux forcing, up to the 5 % of a four-direction Crofton perimeter on its worst shape."""
    n, cell = 80, 0.05
    h = solve(np.zeros((n, n), bool), cell)
    flux = 2 * (h[0].sum() + h[-1].sum() + h[:, 0].sum() + h[:, -1].sum()) / (4 * n * cell)
    assert flux == pytest.approx(1, abs=0.06)


def direct(occupied: np.ndarray, cell: float) -> np.ndarray:
    """The same equations, assembled face by face and solved by SuperLU."""
    rows, columns = occupied.shape
    outside = np.pad(occupied, 1, constant_values=True)
    axis = sum((outside != np.roll(outside, 1, k)).sum() for k in (0, 1))
    diagonal = sum((outside[1:, 1:] != outside[:-1, :-1]).ravel()) + sum((outside[1:, :-1] != outside[:-1, 1:]).ravel())
    perimeter = np.pi / 8 * cell * (axis + diagonal / np.sqrt(2))
    forcing = perimeter / ((~occupied).sum() * cell**2)
    matrix = sparse.dok_matrix((occupied.size, occupied.size))
    for i in range(rows):
        for j in range(columns):
            k = i * columns + j
            for di, dj in ((1, 0), (-1, 0), (0, 1), (0, -1)):
                ni, nj = i + di, j + dj
                if not (0 <= ni < rows and 0 <= nj < columns):
                    matrix[k, k] += 0 if occupied[i, j] else 2
                elif occupied[ni, nj] == occupied[i, j]:
                    matrix[k, k] += 1
                    matrix[k, ni * columns + nj] -= 1
                else:
                    matrix[k, k] += 2
    rhs = np.where(occupied, -forcing, forcing).ravel() * cell**2
    return spsolve(matrix.tocsc(), rhs).reshape(occupied.shape)


@settings(max_examples=20, deadline=None)
@given(
    st.tuples(st.integers(2, 24), st.integers(2, 24)),
    st.floats(0.05, 0.95),
    st.integers(0, 2**32 - 1),
    st.booleans(),
)
def test_agrees_with_a_direct_solve(shape, share, seed, blocks):
    occupied = np.random.default_rng(seed).random(shape) < share
    if blocks:
        occupied = np.kron(occupied, np.ones((2, 3), bool)).astype(bool)
    occupied[0, 0] = False
    h = solve(occupied, 0.05)
    exact = direct(occupied, 0.05)
    assert np.abs(h - exact).max() <= 2e-4 * np.abs(exact).max()


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 3), st.floats(0, 1), st.integers(0, 2**32 - 1))
def test_sign_tells_free_from_occupied_however_few_the_sweeps(sweeps, share, seed):
    rng = np.random.default_rng(seed)
    solver = PoissonSolver(2, (17, 24), 0.05, PoissonSpec(sweeps=sweeps, cold_sweeps=1))
    for _ in range(2):
        occupied = torch.from_numpy(rng.random((2, 17, 24)) < share)
        h = solver.solve(occupied)
        assert ((h > 0) == ~occupied).all()
        assert (h[occupied] < 0).all()


def worlds(robots: int, n: int, shift: int = 0) -> torch.Tensor:
    """Discs scattered over n x n cells, moved by some cells along the rows."""
    rng = np.random.default_rng(3)
    i, j = np.indices((n, n))
    out = np.zeros((robots, n, n), bool)
    for b in range(robots):
        for x, y, r in rng.uniform((0, 0, 4), (n, n, 9), (8, 3)):
            out[b] |= (i + shift - x) ** 2 + (j - y) ** 2 <= r**2
    return torch.from_numpy(out)


def test_warm_start_follows_a_moving_robot():
    solver = PoissonSolver(2, (120, 120), 0.05)
    for shift in range(0, 24, 4):
        h = solver.solve(worlds(2, 120, shift))
    exact = PoissonSolver(2, (120, 120), 0.05, CONVERGED).solve(worlds(2, 120, 20))
    free = exact > 0
    assert ((h - exact).abs()[free].max() / exact.max()) < 5e-3


def test_a_thread_per_cell_and_a_grid_per_core_give_the_same():
    """The kernel of a GPU, here on the CPU, warm and cold."""
    core, cells = (PoissonSolver(3, (41, 38), 0.05) for _ in range(2))
    cells._on_core = False
    for shift, fresh in ((0, []), (2, []), (4, [1]), (6, [0, 2])):
        for solver in (core, cells):
            solver.reset(torch.tensor(fresh, dtype=torch.long))
        grids = worlds(3, 41, shift)[:, :, :38].contiguous()
        a, b = core.solve(grids), cells.solve(grids)
        assert torch.equal(a > 0, b > 0)
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-7)


def test_robots_do_not_see_each_other():
    grids = worlds(3, 40)
    together = PoissonSolver(3, (40, 40), 0.05)
    alone = PoissonSolver(1, (40, 40), 0.05)
    mixed = together.solve(grids).clone()
    assert torch.equal(mixed[1:2], alone.solve(grids[1:2]))
    together.reset(torch.tensor([True, False, False]))
    warm, cold = together.solve(grids), PoissonSolver(1, (40, 40), 0.05).solve(grids[:1])
    assert torch.equal(warm[:1], cold)
    assert torch.equal(warm[1:2], alone.solve(grids[1:2]))


def test_no_free_cell_gives_no_gradient():
    h = PoissonSolver(1, (20, 20), 0.05).solve(torch.ones(1, 20, 20, dtype=torch.bool))
    assert (h < 0).all()
    assert h.abs().max() < 1e-6


def test_mistakes_are_named():
    with pytest.raises(RomnavError, match="no grid"):
        PoissonSolver(0, (20, 20), 0.05)
    with pytest.raises(RomnavError, match="this solver takes"):
        PoissonSolver(1, (20, 20), 0.05).solve(torch.zeros(1, 20, 21, dtype=torch.bool))
    with pytest.raises(RomnavError, match="uint8"):
        PoissonSolver(1, (20, 20), 0.05).solve(torch.zeros(1, 20, 20, dtype=torch.uint8))
