"""From a point cloud to a local occupancy grid, inflated by the robot's radius.

The paper rasterises the cloud "after removing the ground" (Sec. "Poisson Safety Filter"). On slopes, stairs
and landings no plane is the ground, so it is grown here from under the robot's feet over a coarse height map:
a neighbouring cell belongs to it if its lowest return is within a step, give or take a slope, of it. What no way
leads to by such steps (a table top, the storey below a railing) inherits the ground next to it. A return is an
obstacle if it lies more than a step above the ground of its cell and lower than the robot's height; at the edge of a
ledge, such as a flight of stairs seen from beside it, the ground below counts as well.

What has left the field of view is remembered if the caller tells how the robot has moved: one return of each cell,
carried along at its own place rather than its cell's, so that nothing is rounded twice. It is forgotten after a while;
where it is so near to the robot that the sensor cannot see it again, not by time but by the way that the robot goes,
of which trembling is no part.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from romnav.errors import RomnavError
from romnav.kernels import wp
from romnav.safety.spec import GROUND_CELLS, OccupancySpec

# Occupancy cells along a side of a ground cell: enough returns in each on the ground a few metres away.
_GROUND_CELLS = wp.constant(GROUND_CELLS)
_UNSEEN = wp.constant(wp.inf)


@wp.func
def _cell_of(p: wp.vec3, half: float, cell: float):
    return wp.vec2i(int(wp.floor((p[0] + half) / cell)), int(wp.floor((p[1] + half) / cell)))


@wp.func
def _holds(at: wp.vec2i, rows: int, columns: int):
    return at[0] >= 0 and at[1] >= 0 and at[0] < rows and at[1] < columns


@wp.kernel(enable_backward=False)
def _lowest(
    points: wp.array2d(dtype=wp.vec3),
    valid: wp.array2d(dtype=wp.bool),
    half: float,
    cell: float,
    lowest: wp.array3d(dtype=float),
    used: wp.array(dtype=int),
    broken: wp.array(dtype=int),
):
    """Lowest return of every ground cell; valid and non-finite returns counted."""
    b, k = wp.tid()
    if not valid[b, k]:
        return
    p = points[b, k]
    if not wp.isfinite(p):
        wp.atomic_add(broken, b, 1)
        return
    wp.atomic_add(used, b, 1)
    at = _cell_of(p, half, cell)
    if _holds(at, lowest.shape[1], lowest.shape[2]):
        wp.atomic_min(lowest, b, at[0], at[1], p[2])


@wp.kernel(enable_backward=False)
def _grow(
    lowest: wp.array3d(dtype=float),
    cell: float,
    step: float,
    slope: float,
    queue: wp.array2d(dtype=int),
    gap: wp.array3d(dtype=float),
    ground: wp.array3d(dtype=float),
):
    """Ground height of every cell, from the robot's feet at height zero, and its way to ground that was seen, m.

    The tolerance is a step, and the steepest rise over that way. Ground that was seen is followed to its end before a
    gap is crossed, so that gaps are crossed where they are narrow, and all that can be climbed to before the rest
    inherits: treads are reached from the foot of their flight, not from beside it.
    """
    b = wp.tid()
    n = lowest.shape[1]
    centre = n // 2
    ground[b, centre, centre] = 0.0
    gap[b, centre, centre] = 0.0
    for inherits in range(2):
        head = wp.int32(0)
        tail = wp.int32(0)
        top = n * n  # a stack from the queue's other end: ground that was seen
        for here in range(n * n):
            if gap[b, here // n, here % n] >= 0.0:
                queue[b, tail] = here
                tail += 1
        while head < tail or top < n * n:
            if top < n * n:
                here = queue[b, top]
                top += 1
            else:
                here = queue[b, head]
                head += 1
            z = ground[b, here // n, here % n]
            unseen = gap[b, here // n, here % n]
            for k in range(9):
                i = here // n + k // 3 - 1
                j = here % n + k % 3 - 1
                if _holds(wp.vec2i(i, j), n, n) and gap[b, i, j] < 0.0:
                    low = lowest[b, i, j]
                    away = unseen + cell * wp.length(wp.vec2(float(k // 3 - 1), float(k % 3 - 1)))
                    if low != _UNSEEN and wp.abs(low - z) <= step + slope * away:
                        ground[b, i, j] = low
                        gap[b, i, j] = 0.0
                        top -= 1
                        queue[b, top] = i * n + j
                    elif low == _UNSEEN or inherits == 1:
                        ground[b, i, j] = z
                        gap[b, i, j] = wp.where(low == _UNSEEN, away, unseen)
                        queue[b, tail] = i * n + j
                        tail += 1


@wp.kernel(enable_backward=False)
def _ledges(ground: wp.array3d(dtype=float), gap: wp.array3d(dtype=float), drop: float, below: wp.array3d(dtype=float)):
    """The lowest ground seen beside a cell that lies more than ``drop`` below its own, which is then a ledge's edge."""
    b, i, j = wp.tid()
    z = ground[b, i, j]
    lowest = z
    for k in range(9):
        at = wp.vec2i(i + k // 3 - 1, j + k % 3 - 1)
        if _holds(at, ground.shape[1], ground.shape[2]) and gap[b, at[0], at[1]] == 0.0:
            other = ground[b, at[0], at[1]]
            if z - other > drop:
                lowest = wp.min(lowest, other)
    below[b, i, j] = lowest


# A remembered return: its age in sixteenths of a call (18 bits), how far it lies below `_TOP` (12), and its place (16
# each) as shares of the grid's side. Of two in one cell the least number is the youngest, then the highest.
_NOTHING = 2**62
_TICKS = wp.constant(16.0)
_TOP = wp.constant(8.0)
_HEIGHTS = wp.constant(16.0)
_DEPTH = wp.constant(4096.0)
_SHARE = wp.constant(65536.0)


@wp.func
def _pack(value: float, span: float, levels: float):
    """Number of the level of a value in [0, span], clamped."""
    return wp.int64(wp.clamp(value / span * levels, 0.0, levels - 1.0))


@wp.func
def _unpack(packed: wp.int64, shift: int, span: float, levels: float):
    """The middle of the level whose number starts at bit ``shift``."""
    number = (packed >> wp.int64(shift)) & wp.int64(int(levels) - 1)
    return (float(number) + 0.5) / levels * span


@wp.func
def _remember(p: wp.vec3, age: wp.int64, half: float, cell: float, b: int, memory: wp.array3d(dtype=wp.int64)):
    at = _cell_of(p, half, cell)
    if not _holds(at, memory.shape[1], memory.shape[2]):
        return
    depth = _pack(_TOP - p[2], _HEIGHTS, _DEPTH)
    u = _pack(p[0] + half, 2.0 * half, _SHARE)
    v = _pack(p[1] + half, 2.0 * half, _SHARE)
    packed = (age << wp.int64(44)) | (depth << wp.int64(32)) | (u << wp.int64(16)) | v
    wp.atomic_min(memory, b, at[0], at[1], packed)


@wp.kernel(enable_backward=False)
def _recall(
    before: wp.array3d(dtype=wp.int64),
    motion: wp.array(dtype=wp.vec4),
    way: wp.array(dtype=float),
    half: float,
    cell: float,
    step: float,
    height: float,
    slope: float,
    calls: float,
    blind: float,
    travel: float,
    memory: wp.array3d(dtype=wp.int64),
):
    """Carry remembered returns into the frame of a robot that has moved, older by a call, or nearby by the way.

    What is no higher than a step above the robot's feet is forgotten: a landing's edge is a ledge from below alone. So
    is what a robot that has gone down would pass beneath, however steep the way to it.
    """
    b, i, j = wp.tid()
    packed = before[b, i, j]
    age = float(packed >> wp.int64(44)) / _TICKS
    moved = motion[b]
    if age >= calls or not wp.isfinite(moved):
        return
    x = _unpack(packed, 16, 2.0 * half, _SHARE) - half - moved[0]
    y = _unpack(packed, 0, 2.0 * half, _SHARE) - half - moved[1]
    z = _TOP - _unpack(packed, 32, _HEIGHTS, _DEPTH) - moved[2]
    age += wp.where(wp.length(wp.vec2(x, y)) <= blind, calls * way[b] / travel, 1.0)
    if age >= calls or z <= step or z > height + slope * wp.length(wp.vec2(x, y)):
        return
    c = wp.cos(moved[3])
    s = wp.sin(moved[3])
    p = wp.vec3(c * x + s * y, c * y - s * x, z)
    _remember(p, wp.int64(wp.round(age * _TICKS)), half, cell, b, memory)


@wp.kernel(enable_backward=False)
def _mark(
    points: wp.array2d(dtype=wp.vec3),
    valid: wp.array2d(dtype=wp.bool),
    ground: wp.array3d(dtype=float),
    below: wp.array3d(dtype=float),
    half: float,
    cell: float,
    step: float,
    height: float,
    memory: wp.array3d(dtype=wp.int64),
):
    b, k = wp.tid()
    p = points[b, k]
    if not valid[b, k] or not wp.isfinite(p):
        return
    at = _cell_of(p, half, cell)
    if not _holds(at, memory.shape[1], memory.shape[2]):
        return
    i = at[0] // _GROUND_CELLS
    j = at[1] // _GROUND_CELLS
    above = p[2] - ground[b, i, j]
    edge = p[2] - below[b, i, j]
    if (above > step and above <= height) or (edge > step and edge <= height):
        _remember(p, wp.int64(0), half, cell, b, memory)


@wp.kernel(enable_backward=False)
def _distances(occupied: wp.array3d(dtype=wp.bool), distance: wp.array3d(dtype=int)):
    """Along one row, cells to the nearest occupied one."""
    b, i = wp.tid()
    n = occupied.shape[2]
    since = wp.int32(1 << 14)
    for j in range(n):
        since = wp.where(occupied[b, i, j], 0, since + 1)
        distance[b, i, j] = since
    since = wp.int32(1 << 14)
    for k in range(n):
        j = n - 1 - k
        since = wp.where(occupied[b, i, j], 0, since + 1)
        distance[b, i, j] = wp.min(distance[b, i, j], since)


# A loop over raw memory: it vectorises, and inflation is the longest loop of the module.
@wp.func_native("""
    const int* d = distance.data + source;
    bool* out = inflated.data + target;
    for (int j = 0; j < count; ++j) out[j] |= d[j] <= width;
""")
def _within(
    distance: wp.array3d(dtype=int),
    inflated: wp.array3d(dtype=wp.bool),
    source: int,
    target: int,
    count: int,
    width: int,
): ...


@wp.kernel(enable_backward=False)
def _dilate(
    distance: wp.array3d(dtype=int),
    half_width: wp.array(dtype=int),
    reach: int,
    inflated: wp.array3d(dtype=wp.bool),
):
    """A cell is inflated if in some row the nearest occupied cell is within the disc's half width there."""
    b, i = wp.tid()
    rows = inflated.shape[1]
    n = inflated.shape[2]
    for r in range(wp.max(0, i - reach), wp.min(rows, i + reach + 1)):
        _within(distance, inflated, (b * rows + r) * n, (b * rows + i) * n, n, half_width[wp.abs(r - i)])


def inflate(occupied: torch.Tensor, radius: float) -> torch.Tensor:
    """All cells whose centre is within ``radius`` of an occupied cell's centre (dilation by an exact disc).

    Args:
        occupied: (B, rows, columns) bool.
        radius: In cells.
    """
    if occupied.ndim != 3 or occupied.dtype != torch.bool:
        raise RomnavError(f"occupancy is {occupied.dtype} {tuple(occupied.shape)}; expected bool (B, rows, columns)")
    # Squares of integers against the square of the radius: no rounding at the disc's rim.
    square = int(radius * radius + 1e-9)
    reach = math.isqrt(square)
    widths = [math.isqrt(square - k * k) for k in range(reach + 1)]
    device = str(occupied.device)
    distance = torch.empty(occupied.shape, dtype=torch.int32, device=device)
    inflated = torch.zeros(occupied.shape, dtype=torch.bool, device=device)
    rows = occupied.shape[:2]
    into = wp.from_torch(distance)
    wp.launch(_distances, dim=rows, inputs=[wp.from_torch(occupied.contiguous())], outputs=[into], device=device)
    wp.launch(
        _dilate,
        dim=rows,
        inputs=[into, wp.array(widths, dtype=int, device=device), reach],
        outputs=[wp.from_torch(inflated)],
        device=device,
    )
    return inflated


@dataclass(frozen=True)
class Occupancy:
    """Local occupancy: rows along x (ahead), columns along y (left), the robot in the middle."""

    occupied: torch.Tensor
    """(B, n, n) bool, cells with a return off an obstacle, now or remembered."""
    inflated: torch.Tensor
    """(B, n, n) bool, cells where the robot's centre must not be."""
    ground: torch.Tensor
    """(B, n/2, n/2) height of the ground, m."""
    used: torch.Tensor
    """(B,) number of valid returns."""
    broken: torch.Tensor
    """(B,) number of valid returns that are NaN or infinite; they are left out."""


class Rasterizer:
    """Point clouds of ``robots`` robots to occupancy grids around them."""

    def __init__(self, robots: int, spec: OccupancySpec | None = None, device: str = "cpu") -> None:
        self.spec = spec = spec or OccupancySpec()
        cells, coarse = spec.cells, spec.cells // GROUND_CELLS
        self._reach = spec.radius + spec.margin
        self.shape = (cells, cells)
        self.centre = (cells - 1) * spec.cell / 2
        """Where the robot stands, from the centre of cell (0, 0), along both axes, m."""
        self._robots = robots
        self._device = device
        self._lowest = torch.empty(robots, coarse, coarse, device=device)
        self._gap = torch.empty_like(self._lowest)
        self._queue = wp.empty((robots, coarse * coarse), dtype=int, device=device)
        self._memory = torch.full((robots, *self.shape), _NOTHING, dtype=torch.int64, device=device)
        # from where its way was last counted to each robot, in its frame, m
        self._away = torch.zeros(robots, 2, device=device)

    def reset(self, robots: torch.Tensor | None = None) -> None:
        """Forget what ``robots`` have seen (a mask or indices; all of them by default)."""
        which = slice(None) if robots is None else robots
        self._memory[which] = _NOTHING
        self._away[which] = 0.0

    def carry(self, others: Sequence[Rasterizer], robots: torch.Tensor) -> None:
        """Remember what ``robots`` (indices) among those of ``others``, counted through, have seen."""
        self._memory = torch.cat([other._memory for other in others])[robots]
        self._away = torch.cat([other._away for other in others])[robots]

    def _walk(self, motion: torch.Tensor) -> torch.Tensor:
        """Ways (B,), m, that count now, and are therefore not counted again."""
        away = self._away + motion[:, :2].nan_to_num(0.0, 0.0, 0.0)
        far = away.norm(dim=1)
        counts = far >= self.spec.still
        c, s = torch.cos(motion[:, 3]).nan_to_num(1.0), torch.sin(motion[:, 3]).nan_to_num(0.0)
        turned = torch.stack([c * away[:, 0] + s * away[:, 1], c * away[:, 1] - s * away[:, 0]], dim=1)
        self._away = torch.where(counts[:, None], 0.0, turned)
        return torch.where(counts, far, 0.0)

    def __call__(
        self, points: torch.Tensor, valid: torch.Tensor | None = None, motion: torch.Tensor | None = None
    ) -> Occupancy:
        """Rasterise one cloud per robot.

        Args:
            points: (B, N, 3) returns in the gravity-aligned robot frame, m: x ahead, z up, the origin on the
                ground beneath the robot's centre.
            valid: (B, N) bool, which returns to use (padding is invalid); all by default.
            motion: (B, 4) how the robots have moved (x, y, z) and turned since the last call, in their frame of
                then, m and rad. Without it, or where it is not finite, what was seen before is forgotten.
        """
        if motion is not None and motion.shape != (self._robots, 4):
            raise RomnavError(f"motion has shape {tuple(motion.shape)}; expected ({self._robots}, 4)")
        if points.ndim != 3 or len(points) != self._robots or points.shape[2] != 3:
            raise RomnavError(f"points have shape {tuple(points.shape)}; expected ({self._robots}, N, 3)")
        spec, device = self.spec, self._device
        if valid is None:
            valid = torch.ones(points.shape[:2], dtype=torch.bool, device=device)
        if valid.shape != points.shape[:2] or valid.dtype != torch.bool:
            raise RomnavError(f"valid is {valid.dtype} {tuple(valid.shape)}; expected bool {tuple(points.shape[:2])}")
        cloud = wp.from_torch(points.float().contiguous(), dtype=wp.vec3)
        mask = wp.from_torch(valid.contiguous())
        used, broken = torch.zeros(2, self._robots, dtype=torch.int32, device=device)
        ground = torch.empty_like(self._lowest)
        before, self._memory = self._memory, torch.full_like(self._memory, _NOTHING)
        memory = wp.from_torch(self._memory)
        self._lowest.fill_(torch.inf)
        self._gap.fill_(-1.0)
        lowest, surface = wp.from_torch(self._lowest), wp.from_torch(ground)
        half, coarse = self.shape[0] * spec.cell / 2, _GROUND_CELLS * spec.cell
        wp.launch(
            _lowest,
            dim=cloud.shape,
            inputs=[cloud, mask, half, coarse],
            outputs=[lowest, wp.from_torch(used), wp.from_torch(broken)],
            device=device,
        )
        wp.launch(
            _grow,
            dim=self._robots,
            inputs=[lowest, coarse, spec.step, spec.slope, self._queue],
            outputs=[wp.from_torch(self._gap), surface],
            device=device,
        )
        # from here on the lowest returns are not needed; between the far ends of two cells a stair may rise, too
        wp.launch(
            _ledges,
            dim=self._lowest.shape,
            inputs=[surface, wp.from_torch(self._gap), spec.step + 2.0 * coarse * spec.slope],
            outputs=[lowest],
            device=device,
        )
        if motion is not None and spec.memory > 1:
            motion = motion.float().contiguous()
            wp.launch(
                _recall,
                dim=before.shape,
                inputs=[
                    wp.from_torch(before),
                    wp.from_torch(motion, dtype=wp.vec4),
                    wp.from_torch(self._walk(motion)),
                    half,
                    spec.cell,
                    spec.step,
                    spec.height,
                    spec.slope,
                    float(spec.memory),
                    spec.blind,
                    spec.travel,
                ],
                outputs=[memory],
                device=device,
            )
        wp.launch(
            _mark,
            dim=cloud.shape,
            inputs=[cloud, mask, surface, lowest, half, spec.cell, spec.step, spec.height],
            outputs=[memory],
            device=device,
        )
        occupied = self._memory < _NOTHING
        inflated = inflate(occupied, self._reach / spec.cell)
        return Occupancy(occupied, inflated, ground, used, broken)
