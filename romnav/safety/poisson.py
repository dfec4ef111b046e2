"""Poisson safety functions on occupancy grids, batched over robots.

The safety function ``h`` solves ``Lap h = -P / A`` in free space and ``Lap h = +P / A`` inside obstacles,
with ``h = 0`` on the boundary between them and on the edge of the grid (paper, "Poisson Safety Filter";
Bahati et al., arXiv 2505.06794; Bena et al., arXiv 2508.11129). ``A`` is the area of free space and ``P`` the
length of its boundary: by the divergence theorem the mean slope of ``h`` over the boundary is one ("average
flux"), so near an obstacle ``h`` reads like a distance in metres. The barrier condition is homogeneous in
``h``, so that the scale has no effect on a filter.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch

from romnav.errors import RomnavError
from romnav.kernels import wp
from romnav.safety.spec import PoissonSpec

# Cells lie at the centres; a boundary is the face between a free and an occupied cell, where h = 0. By linear
# extrapolation over that face the neighbour of the other phase counts as -h_i, which adds one to the
# diagonal, so a cell's neighbours of its own phase are all that couple to it. h is positive in one phase and
# negative in the other, hence the sum over same-phase neighbours is the sum of max(s h_j, 0) with s the sign
# of the cell, and one signed array per colour is all the memory that a sweep touches. The colours are stored
# apart, so that the loop is contiguous and vectorises.
_RELAX = """
    const float* up = h.data + other - stride;
    const float* down = h.data + other + stride;
    const float* left = h.data + other + shift - 1;
    const float* right = h.data + other + shift;
    const float* w = weight.data + own;
    float* __restrict__ x = h.data + own;
    for (int k = 0; k < count; ++k) {
        const float s = w[k] < 0.0f ? -1.0f : 1.0f;
        const float a = s * w[k];
        const float u = s * up[k], d = s * down[k], l = s * left[k], r = s * right[k];
        const float sum = (u > 0.0f ? u : 0.0f) + (d > 0.0f ? d : 0.0f)
                        + (l > 0.0f ? l : 0.0f) + (r > 0.0f ? r : 0.0f);
        const float y = (1.0f - omega) * s * x[k] + omega * a * (sum + forcing);
        const float least = 1e-9f * a;
        x[k] = s * (y > least ? y : least);
    }
"""


@wp.func_native(_RELAX)
def _relax(
    h: wp.array(dtype=float),
    weight: wp.array(dtype=float),
    own: int,
    other: int,
    stride: int,
    shift: int,
    count: int,
    omega: float,
    forcing: float,
): ...


@wp.func
def _free(occupied: wp.array3d(dtype=wp.uint8), b: int, i: int, j: int) -> int:
    """1 for a free cell, 0 for an occupied one and beyond the grid, where nothing is known."""
    if i < 0 or j < 0 or i >= occupied.shape[1] or j >= occupied.shape[2]:
        return 0
    return wp.where(occupied[b, i, j] == wp.uint8(0), 1, 0)


@wp.kernel(enable_backward=False)
def _discretise(
    occupied: wp.array3d(dtype=wp.uint8),
    fresh: wp.array(dtype=int),
    half: int,
    plane: int,
    weight: wp.array(dtype=float),
    h: wp.array(dtype=float),
    counts: wp.array(dtype=wp.vec3i),
):
    """One row: reciprocal diagonals, signed by phase; the iteration's start; what the forcing needs to know.

    The counts are free cells and unlike neighbours along the axes and the diagonals, the outside included.
    """
    b, row = wp.tid()
    i = row - 1
    rows = occupied.shape[1]
    columns = occupied.shape[2]
    count = wp.vec3i(0, 0, 0)
    left = wp.int32(0)
    here = wp.int32(0)
    below = wp.int32(0)
    for j in range(-1, columns):
        right = _free(occupied, b, i, j + 1)
        across = _free(occupied, b, i + 1, j + 1)
        count[1] += wp.abs(here - right) + wp.abs(here - below)
        count[2] += wp.abs(here - across) + wp.abs(right - below)
        if i >= 0 and j >= 0:
            above = _free(occupied, b, i - 1, j)
            unlike = wp.abs(here - left) + wp.abs(here - right) + wp.abs(here - above) + wp.abs(here - below)
            diagonal = 4 + unlike
            if here == 0:
                # An obstacle goes on beyond the edge of the grid: no flux, so that no way out leads there.
                diagonal -= wp.where(i == 0, 1, 0) + wp.where(i == rows - 1, 1, 0)
                diagonal -= wp.where(j == 0, 1, 0) + wp.where(j == columns - 1, 1, 0)
            sign = float(2 * here - 1)
            k = ((i + j) & 1) * plane + (b * (rows + 2) + i + 1) * (half + 2) + 1 + (j >> 1)
            weight[k] = sign / float(diagonal)
            h[k] = wp.where(fresh[b] != 0, 0.0, sign * wp.max(sign * h[k], 0.0))
            count[0] += here
        left = here
        here = right
        below = across
    wp.atomic_add(counts, b, count)


@wp.func
def _forcing(count: wp.vec3i, cell: float) -> float:
    """cell^2 P / A, the perimeter by Cauchy-Crofton in four directions."""
    perimeter = 0.125 * wp.pi * (float(count[1]) + float(count[2]) / wp.sqrt(2.0))
    return cell * perimeter / float(wp.max(count[0], 1))


@wp.kernel(enable_backward=False)
def _sweep(
    weight: wp.array(dtype=float),
    counts: wp.array(dtype=wp.vec3i),
    active: wp.array(dtype=int),
    colour: int,
    half: int,
    rows: int,
    plane: int,
    cell: float,
    omega: float,
    h: wp.array(dtype=float),
):
    """Relax one cell of one colour."""
    b, i, k = wp.tid()
    if active[b] == 0:
        return
    row = (b * (rows + 2) + i + 1) * (half + 2) + 1 + k
    own = colour * plane + row
    other = (1 - colour) * plane + row
    _relax(h, weight, own, other, half + 2, (i + colour) & 1, 1, omega, _forcing(counts[b], cell))


@wp.kernel(enable_backward=False)
def _sweep_grid(
    weight: wp.array(dtype=float),
    counts: wp.array(dtype=wp.vec3i),
    fresh: wp.array(dtype=int),
    sweeps: int,
    more: int,
    half: int,
    rows: int,
    plane: int,
    cell: float,
    omega: float,
    h: wp.array(dtype=float),
):
    """All sweeps over one robot's grid, ``more`` of them if it is fresh: they stay in a core's cache."""
    b = wp.tid()
    forcing = _forcing(counts[b], cell)
    for _ in range(sweeps + more * fresh[b]):
        for colour in range(2):
            for i in range(rows):
                row = (b * (rows + 2) + i + 1) * (half + 2) + 1
                own = colour * plane + row
                other = (1 - colour) * plane + row
                _relax(h, weight, own, other, half + 2, (i + colour) & 1, half, omega, forcing)


@wp.kernel(enable_backward=False)
def _unpack(h: wp.array(dtype=float), half: int, plane: int, out: wp.array3d(dtype=float)):
    b, i = wp.tid()
    row = (b * (out.shape[1] + 2) + i + 1) * (half + 2) + 1
    for j in range(out.shape[2]):
        out[b, i, j] = h[((i + j) & 1) * plane + row + (j >> 1)]


class PoissonSolver:
    """Solves for the safety functions of ``robots`` grids of one shape, each from its own previous solution.

    After any number of sweeps ``h`` is positive in exactly the free cells and negative in the others, so that
    a filter on top of it is safe however far the iteration has come; convergence only shapes ``h``.

    Args:
        robots: Number of grids.
        shape: Rows and columns; cell (i, j) is centred at (i, j) * cell from the first cell's centre.
        cell: Side of a cell, m.
        spec: Relaxation and numbers of sweeps.
        device: Torch device.
    """

    def __init__(
        self,
        robots: int,
        shape: tuple[int, int],
        cell: float,
        spec: PoissonSpec | None = None,
        device: str = "cpu",
    ) -> None:
        if robots < 1 or min(shape) < 2 or not cell > 0:
            raise RomnavError(f"no grid to solve on: {robots} robots, shape {shape}, cell {cell} m")
        spec = spec or PoissonSpec()
        self.shape = (robots, *shape)
        self._device = device
        rows, half = shape[0], (shape[1] + 1) // 2
        plane = robots * (rows + 2) * (half + 2)
        # The last row's right neighbour of the second colour reads one past the end.
        packed = [wp.zeros(2 * plane + 1, dtype=float, device=device) for _ in range(2)]
        self._weight, self._iterate = packed
        self._counts = wp.zeros(robots, dtype=wp.vec3i, device=device)
        self._fresh = torch.ones(robots, dtype=torch.int32, device=device)
        self._any_fresh = True
        self._h = torch.zeros(self.shape, device=device)
        self._layout = (half, plane)
        self._sweeps = spec.sweeps, max(0, spec.cold_sweeps - spec.sweeps)
        fresh, everyone = wp.from_torch(self._fresh), wp.ones(robots, dtype=int, device=device)
        grid = half, rows, plane, cell, spec.omega

        def recorded(kernel: wp.Kernel, dim: int | tuple[int, ...], *inputs: object) -> wp.Launch:
            given = [self._weight, self._counts, *inputs, *grid]
            return wp.launch(kernel, dim, given, [self._iterate], device=device, record_cmd=True)

        # a core takes a grid at a time, a GPU wants a thread per cell
        self._on_core = wp.get_device(device).is_cpu
        self._sweep_grid = recorded(_sweep_grid, robots, fresh, *self._sweeps)
        self._sweep_all, self._sweep_fresh = (
            [recorded(_sweep, (robots, rows, half), active, colour) for colour in (0, 1)]
            for active in (everyone, fresh)
        )

    def reset(self, robots: torch.Tensor | None = None) -> None:
        """Forget the previous solution of ``robots`` (a mask or indices; all of them by default)."""
        self._fresh[slice(None) if robots is None else robots] = 1
        self._any_fresh = True

    def carry(self, solvers: Sequence[PoissonSolver], robots: torch.Tensor) -> None:
        """Start from the previous solutions of ``robots`` (indices) among those of ``solvers``, counted through."""
        iterates = torch.cat([s._planes() for s in solvers], dim=1)
        self._planes()[:] = iterates[:, robots]
        self._fresh[:] = torch.cat([s._fresh for s in solvers])[robots]
        self._any_fresh = bool(self._fresh.any())

    def _planes(self) -> torch.Tensor:
        """(2, robots, rows + 2, columns / 2 + 2) view of both colours of the iterate."""
        robots, rows, _ = self.shape
        return wp.to_torch(self._iterate)[:-1].view(2, robots, rows + 2, self._layout[0] + 2)

    def _sweep_cells(self) -> None:
        warm, more = self._sweeps
        for commands, sweeps in ((self._sweep_fresh, more * self._any_fresh), (self._sweep_all, warm)):
            for _ in range(sweeps):
                for command in commands:
                    command.launch()

    def solve(self, occupied: torch.Tensor) -> torch.Tensor:
        """Safety function on the cells.

        Args:
            occupied: (robots, rows, columns) bool, inflated by the robot's radius already.

        Returns:
            h (robots, rows, columns), m; a buffer that the next call overwrites. A grid without a free cell
            has h below zero and no gradient.
        """
        if occupied.shape != self.shape or occupied.dtype != torch.bool:
            raise RomnavError(
                f"occupancy is {occupied.dtype} {tuple(occupied.shape)}; this solver takes torch.bool {self.shape}"
            )
        half, plane = self._layout
        grid = wp.from_torch(occupied.contiguous().view(torch.uint8))
        self._counts.zero_()
        wp.launch(
            _discretise,
            dim=(self.shape[0], self.shape[1] + 1),
            inputs=[grid, wp.from_torch(self._fresh), half, plane],
            outputs=[self._weight, self._iterate, self._counts],
            device=self._device,
        )
        if self._on_core:
            self._sweep_grid.launch()
        else:
            self._sweep_cells()
        wp.launch(
            _unpack,
            dim=self.shape[:2],
            inputs=[self._iterate, half, plane],
            outputs=[wp.from_torch(self._h)],
            device=self._device,
        )
        self._fresh.zero_()
        self._any_fresh = False
        return self._h
