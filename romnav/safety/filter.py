"""The Poisson safety filter as a whole: point clouds and desired velocities in, safe velocities out."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import torch

from romnav.errors import RomnavError
from romnav.kernels import wp
from romnav.safety.barrier import Filtered, Status, filter_velocity
from romnav.safety.occupancy import Rasterizer
from romnav.safety.poisson import PoissonSolver
from romnav.safety.spec import SafetySpec


class SafetyFilter:
    """Point clouds and desired velocities of ``robots`` robots in, safe velocities out.

    A robot's result depends on its own inputs and previous calls only, whatever the number of workers.

    Args:
        robots: Number of robots.
        spec: All settings.
        device: Torch device.
        workers: Threads (CPU); kernels release the interpreter lock.

    Raises:
        RomnavError: There is no robot; also of all methods, for shapes and types that do not fit.
    """

    def __init__(self, robots: int, spec: SafetySpec | None = None, device: str = "cpu", workers: int = 1) -> None:
        self.spec = spec or SafetySpec()
        self._device = device
        self._pool = ThreadPoolExecutor(workers) if workers > 1 else None
        self._prepare(robots)

    def _prepare(self, robots: int) -> None:
        if robots < 1:
            raise RomnavError(f"a safety filter of {robots} robots; it needs one or more")
        # A few robots at a time keep their grids in a core's cache; a GPU takes all at once.
        share = min(robots, 4) if wp.get_device(self._device).is_cpu else robots
        self._chunks = [slice(i, min(i + share, robots)) for i in range(0, robots, share)]
        self._stages = []
        for chunk in self._chunks:
            size = chunk.stop - chunk.start
            occupancy = self.spec.occupancy
            rasterizer = Rasterizer(size, occupancy, self._device)
            solver = PoissonSolver(size, rasterizer.shape, occupancy.cell, self.spec.poisson, self._device)
            self._stages.append((rasterizer, solver))
        self._robots = robots

    def select(self, robots: torch.Tensor) -> None:
        """Keep only ``robots`` (indices), in that order, with their past."""
        if robots.ndim != 1 or robots.is_floating_point() or robots.dtype == torch.bool:
            raise RomnavError(f"robots are {robots.dtype} {tuple(robots.shape)}; expected indices, integers (K,)")
        if len(robots) and (robots.min() < 0 or robots.max() >= self._robots):
            raise RomnavError(f"robots are {robots.tolist()}; the filter has {self._robots}")
        rasterizers, solvers = zip(*self._stages, strict=True)
        self._prepare(len(robots))
        for chunk, (rasterizer, solver) in zip(self._chunks, self._stages, strict=True):
            rasterizer.carry(rasterizers, robots[chunk])
            solver.carry(solvers, robots[chunk])

    def reset(self, robots: torch.Tensor | None = None) -> None:
        """Forget the past of ``robots`` (bool mask; all by default), as after a jump to another place."""
        if robots is not None and (robots.dtype != torch.bool or robots.shape != (self._robots,)):
            raise RomnavError(
                f"robots are {robots.dtype} {tuple(robots.shape)}; expected a mask, bool ({self._robots},)"
            )
        for chunk, (rasterizer, solver) in zip(self._chunks, self._stages, strict=True):
            for part in (rasterizer, solver):
                part.reset(None if robots is None else robots[chunk])

    def __call__(
        self,
        points: torch.Tensor,
        velocity: torch.Tensor,
        valid: torch.Tensor | None = None,
        motion: torch.Tensor | None = None,
    ) -> Filtered:
        """Filter one control period's commands.

        Args:
            points: (B, N, 3) returns in the gravity-aligned robot frame, m: x ahead, z up, the origin on the
                ground beneath the robot's centre.
            velocity: (B, 2) desired (vx, vy) in that frame, m/s. The yaw rate passes the filter by.
            valid: (B, N) bool, which returns to use; all by default.
            motion: (B, 4) how the robots have moved (x, y, z) and turned since the last call, in their frame of
                then, m and rad: what has left the field of view is then remembered for a while, else forgotten.
        """
        if velocity.shape != (self._robots, 2) or not velocity.is_floating_point():
            raise RomnavError(
                f"velocity is {velocity.dtype} {tuple(velocity.shape)}; expected floating point ({self._robots}, 2)"
            )
        if motion is not None and motion.shape != (self._robots, 4):
            raise RomnavError(f"motion has shape {tuple(motion.shape)}; expected ({self._robots}, 4)")
        if points.ndim != 3 or len(points) != self._robots or (valid is not None and valid.shape != points.shape[:2]):
            raise RomnavError(
                f"points are {tuple(points.shape)}, valid {None if valid is None else tuple(valid.shape)}; "
                f"expected ({self._robots}, N, 3) and ({self._robots}, N)"
            )

        def work(index: int) -> Filtered:
            chunk = self._chunks[index]
            rasterizer, solver = self._stages[index]
            seen = (None if x is None else x[chunk] for x in (valid, motion))
            grid = rasterizer(points[chunk], *seen)
            h = solver.solve(grid.inflated)
            centre = torch.full((len(h), 2), rasterizer.centre, dtype=torch.float64, device=h.device)
            out = filter_velocity(h, self.spec.occupancy.cell, centre, velocity[chunk], self.spec.filter)
            for mask, status in ((grid.used == 0, Status.NO_POINTS), (grid.broken > 0, Status.NOT_FINITE)):
                out.velocity[mask] = 0.0
                out.status[mask] = status
            return out

        indices = range(len(self._chunks))
        parts = list(map(work, indices) if self._pool is None else self._pool.map(work, indices))
        return Filtered(
            *(torch.cat([getattr(p, name) for p in parts]) for name in ("velocity", "status", "h", "gradient"))
        )
