"""Control-barrier-function filter on a Poisson safety function.

The continuous filter is the paper's quadratic program (Sec. "Poisson Safety Filter"): the velocity nearest to
the desired one with ``grad h . v >= -alpha h``, solved in closed form. A command is held for a control
period, though, over which ``h`` bends; so the displacement is then followed through the grid, where bilinear
``h`` is a quadratic along a straight line within each patch, and the command is scaled back to the first
instant at which less than a fixed share of ``h`` would remain. That keeps ``h`` positive at every instant,
not only at the samples, and needs no Lipschitz constant.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import torch

from romnav.errors import RomnavError
from romnav.kernels import wp
from romnav.safety.spec import FilterSpec


class Status(IntEnum):
    """What the filter did; from `BLOCKED` on, the command is zero."""

    UNCHANGED = 0
    """The desired velocity is safe as it is."""
    FILTERED = 1
    """The nearest safe velocity, scaled back if the period required it."""
    ESCAPING = 2
    """The robot touches the boundary of the inflated region or is inside of it; the command leads outward."""
    BLOCKED = 3
    """No velocity fulfils the barrier condition: h has no gradient here, or there is no free cell at all."""
    OUTSIDE = 4
    """The position is not within the grid's outermost cell centres."""
    NO_POINTS = 5
    """The cloud is empty: a sensor that sees nothing, not even the ground, sees no obstacle either."""
    NOT_FINITE = 6
    """A position, a desired velocity, h or a valid point is NaN or infinite."""


# The boundary is where h is this many cells, not zero: far above rounding, far below any clearance.
_TOUCH = wp.constant(wp.float64(1e-3))
_INF = wp.constant(wp.float64(wp.inf))
# Squared gradient below which h is flat, (m/m)^2; the mean slope at a boundary is one.
_FLAT = wp.constant(wp.float64(1e-12))


@wp.func
def _clamp(x: wp.vec2d, lower: wp.vec2d, upper: wp.vec2d):
    return wp.min(wp.max(x, lower), upper)


@wp.func
def _cbf_qp(desired: wp.vec2d, normal: wp.vec2d, bound: wp.float64, lower: wp.vec2d, upper: wp.vec2d):
    """Nearest velocity in the box with ``normal . v >= bound``, and whether there is one.

    If the box's own nearest point misses the half-plane, the optimum lies on the line ``normal . v = bound``:
    the foot of the desired velocity there, clamped to the piece of the line within the box. Without such a
    piece, the corner that violates the condition least.
    """
    v = _clamp(desired, lower, upper)
    if wp.dot(normal, v) >= bound:
        return v, True
    square = wp.dot(normal, normal)
    if square < _FLAT:
        return v, False
    foot = desired + normal * ((bound - wp.dot(normal, desired)) / square)
    along = wp.vec2d(-normal[1], normal[0])
    first = -_INF
    last = _INF
    for k in range(2):
        if along[k] != wp.float64(0.0):
            a = (lower[k] - foot[k]) / along[k]
            b = (upper[k] - foot[k]) / along[k]
            first = wp.max(first, wp.min(a, b))
            last = wp.min(last, wp.max(a, b))
        elif foot[k] < lower[k] or foot[k] > upper[k]:
            last = -_INF
    if first > last:
        corner = wp.vec2d(
            wp.where(normal[0] > wp.float64(0.0), upper[0], lower[0]),
            wp.where(normal[1] > wp.float64(0.0), upper[1], lower[1]),
        )
        return corner, False
    return _clamp(foot + along * wp.clamp(wp.float64(0.0), first, last), lower, upper), True


@wp.func
def _patch(h: wp.array3d(dtype=float), b: int, i: int, j: int):
    """Coefficients of 1, x, y and xy of the bilinear patch whose lowest corner is node (i, j)."""
    h00 = wp.float64(h[b, i, j])
    h10 = wp.float64(h[b, i + 1, j])
    h01 = wp.float64(h[b, i, j + 1])
    h11 = wp.float64(h[b, i + 1, j + 1])
    return wp.vec4d(h00, h10 - h00, h01 - h00, h11 - h10 - h01 + h00)


@wp.func
def _value(h: wp.array3d(dtype=float), b: int, x: wp.vec2d):
    i = wp.min(int(x[0]), h.shape[1] - 2)
    j = wp.min(int(x[1]), h.shape[2] - 2)
    c = _patch(h, b, i, j)
    u = x[0] - wp.float64(i)
    w = x[1] - wp.float64(j)
    return c[0] + c[1] * u + c[2] * w + c[3] * u * w


@wp.func
def _slope(h: wp.array3d(dtype=float), b: int, x: wp.vec2d, last: wp.vec2d):
    """Central difference over one cell: the bilinear gradient in the middle of a patch, continuous elsewhere.

    The bilinear gradient itself jumps where patches meet, and a robot would get caught on the seams.
    """
    slope = wp.vec2d()
    for k in range(2):
        step = wp.vec2d()
        step[k] = wp.float64(0.5)
        ahead = wp.min(x + step, last)
        behind = wp.max(x - step, wp.vec2d())
        slope[k] = (_value(h, b, ahead) - _value(h, b, behind)) / (ahead[k] - behind[k])
    return slope


@wp.func
def _along(c: wp.vec4d, x: wp.float64, y: wp.float64, dx: wp.float64, dy: wp.float64):
    """Coefficients of 1, s and s^2 of a patch along the line (x + s dx, y + s dy)."""
    return wp.vec3d(
        c[0] + c[1] * x + c[2] * y + c[3] * x * y,
        c[1] * dx + c[2] * dy + c[3] * (x * dy + y * dx),
        c[3] * dx * dy,
    )


@wp.func
def _at(q: wp.vec3d, s: wp.float64):
    return q[0] + s * (q[1] + s * q[2])


@wp.func
def _first_below(q: wp.vec3d, target: wp.float64, start: wp.float64, stop: wp.float64):
    """First s in [start, stop] beyond which the quadratic falls below the target; infinity if it does not."""
    high = stop
    if _at(q, stop) >= target:
        if q[2] <= wp.float64(0.0):
            return _INF
        high = wp.clamp(-wp.float64(0.5) * q[1] / q[2], start, stop)
        if _at(q, high) >= target:
            return _INF
    low = start
    for _ in range(50):
        middle = wp.float64(0.5) * (low + high)
        if _at(q, middle) >= target:
            low = middle
        else:
            high = middle
    return low


@wp.func
def _safe_share(
    h: wp.array3d(dtype=float),
    b: int,
    x: wp.vec2d,
    d: wp.vec2d,
    target: wp.float64,
    escaping: bool,
    retain: wp.float64,
):
    """Share of the displacement d (in cells, from x) up to which h stays above the target.

    A robot on its way out of an obstacle must not fall back into one. The outermost nodes are never reached.
    """
    cell = wp.vec2i(wp.min(int(x[0]), h.shape[1] - 2), wp.min(int(x[1]), h.shape[2] - 2))
    s = wp.float64(0.0)
    while s < wp.float64(1.0):
        i = cell[0]
        j = cell[1]
        if i < 0 or j < 0 or i > h.shape[1] - 2 or j > h.shape[2] - 2:
            return wp.max(s - _TOUCH / wp.length(d), wp.float64(0.0))
        end = wp.vec2d(_INF, _INF)
        for k in range(2):
            if d[k] > wp.float64(0.0):
                end[k] = (wp.float64(cell[k] + 1) - x[k]) / d[k]
            elif d[k] < wp.float64(0.0):
                end[k] = (wp.float64(cell[k]) - x[k]) / d[k]
        stop = wp.clamp(wp.min(end), s, wp.float64(1.0))
        q = _along(_patch(h, b, i, j), x[0] - wp.float64(i), x[1] - wp.float64(j), d[0], d[1])
        if escaping and _at(q, s) > wp.float64(0.0):
            target = wp.max(target, retain * _at(q, s))
        below = _first_below(q, target, s, stop)
        if below <= stop:
            return below
        if end[0] <= end[1]:
            cell[0] += wp.where(d[0] > wp.float64(0.0), 1, -1)
        else:
            cell[1] += wp.where(d[1] > wp.float64(0.0), 1, -1)
        s = stop
    return wp.float64(1.0)


@wp.kernel(enable_backward=False)
def _filter(
    h: wp.array3d(dtype=float),
    cell: wp.float64,
    position: wp.array(dtype=wp.vec2d),
    desired: wp.array(dtype=wp.vec2d),
    alpha: wp.float64,
    period: wp.float64,
    retain: wp.float64,
    escape: wp.float64,
    lower: wp.vec2d,
    upper: wp.vec2d,
    velocity: wp.array(dtype=wp.vec2d),
    level: wp.array(dtype=wp.float64),
    gradient: wp.array(dtype=wp.vec2d),
    status: wp.array(dtype=int),
):
    b = wp.tid()
    velocity[b] = wp.vec2d()
    level[b] = wp.float64(wp.nan)
    gradient[b] = wp.vec2d()
    x = position[b] / cell
    wanted = desired[b]
    if not (wp.isfinite(x) and wp.isfinite(wanted)):
        status[b] = wp.static(int(Status.NOT_FINITE))
        return
    last = wp.vec2d(wp.float64(h.shape[1] - 1), wp.float64(h.shape[2] - 1))
    if wp.min(x) < wp.float64(0.0) or wp.min(last - x) < wp.float64(0.0):
        status[b] = wp.static(int(Status.OUTSIDE))
        return
    value = _value(h, b, x)
    slope = _slope(h, b, x, last) / cell
    if not (wp.isfinite(value) and wp.isfinite(slope)):
        status[b] = wp.static(int(Status.NOT_FINITE))
        return
    level[b] = value
    gradient[b] = slope
    bound = alpha * (_TOUCH * cell - value)
    touches = bound >= wp.float64(0.0)
    if touches:
        bound = wp.max(bound, escape * wp.length(slope))
    v, feasible = _cbf_qp(wanted, slope, bound, lower, upper)
    if not feasible and (wp.length_sq(slope) < _FLAT or not touches):
        status[b] = wp.static(int(Status.BLOCKED))
        return
    target = wp.where(touches, value, retain * value)
    share = _safe_share(h, b, x, v * (period / cell), target, touches, retain)
    if touches and share < wp.float64(1.0):
        # What is wanted leads out nowhere, so straight out; a dip on the way does not matter inside.
        v, feasible = _cbf_qp(wp.vec2d(), slope, bound, lower, upper)
        target = wp.where(value > wp.float64(0.0), value, -_INF)
        share = _safe_share(h, b, x, v * (period / cell), target, touches, retain)
    v = v * share
    velocity[b] = v
    if share == wp.float64(0.0):
        status[b] = wp.static(int(Status.BLOCKED))
    elif touches:
        status[b] = wp.static(int(Status.ESCAPING))
    elif v == wanted:
        status[b] = wp.static(int(Status.UNCHANGED))
    else:
        status[b] = wp.static(int(Status.FILTERED))


@wp.kernel(enable_backward=False)
def _solve_qp(
    desired: wp.array(dtype=wp.vec2d),
    normal: wp.array(dtype=wp.vec2d),
    bound: wp.array(dtype=wp.float64),
    lower: wp.vec2d,
    upper: wp.vec2d,
    velocity: wp.array(dtype=wp.vec2d),
    feasible: wp.array(dtype=wp.bool),
):
    k = wp.tid()
    v, exists = _cbf_qp(desired[k], normal[k], bound[k], lower, upper)
    velocity[k] = v
    feasible[k] = exists


def cbf_qp(
    desired: torch.Tensor,
    normal: torch.Tensor,
    bound: torch.Tensor,
    lower: tuple[float, float] = (-torch.inf, -torch.inf),
    upper: tuple[float, float] = (torch.inf, torch.inf),
) -> tuple[torch.Tensor, torch.Tensor]:
    """Exact solution of ``min |v - desired|^2  s.t.  normal . v >= bound, lower <= v <= upper``, batched.

    Args:
        desired: (K, 2), m/s.
        normal: (K, 2) gradient of the barrier.
        bound: (K,) the barrier condition's right-hand side, m/s.
        lower: Least velocity; unlimited by default.
        upper: Largest velocity; unlimited by default.

    Returns:
        velocity (K, 2) and feasible (K,). Where nothing is feasible, the velocity in the box that violates
        the half-plane least.
    """
    device = str(desired.device)
    velocity = torch.empty(len(desired), 2, dtype=torch.float64, device=device)
    feasible = torch.empty(len(desired), dtype=torch.bool, device=device)
    wp.launch(
        _solve_qp,
        dim=len(desired),
        inputs=[
            _vectors(desired),
            _vectors(normal),
            wp.from_torch(bound.double().contiguous()),
            wp.vec2d(*lower),
            wp.vec2d(*upper),
        ],
        outputs=[_vectors(velocity), wp.from_torch(feasible)],
        device=device,
    )
    return velocity, feasible


def _vectors(x: torch.Tensor) -> wp.array:
    return wp.from_torch(x.double().contiguous(), dtype=wp.vec2d)


@dataclass(frozen=True)
class Filtered:
    """A filtered command and what led to it, one row per robot."""

    velocity: torch.Tensor
    """(B, 2) safe velocity, m/s; zero where ``status >= Status.BLOCKED``."""
    status: torch.Tensor
    """(B,) int32 `Status`."""
    h: torch.Tensor
    """(B,) safety function at the robot, m; NaN where it could not be evaluated."""
    gradient: torch.Tensor
    """(B, 2) its gradient, m/m."""


def filter_velocity(
    h: torch.Tensor,
    cell: float,
    position: torch.Tensor,
    velocity: torch.Tensor,
    spec: FilterSpec | None = None,
) -> Filtered:
    """Nearest velocity that keeps h positive for one control period.

    Args:
        h: (B, rows, columns) safety function on cell centres, as of `PoissonSolver.solve`; any other function
            that is positive in free space will do.
        cell: Side of a cell, m.
        position: (B, 2) from the centre of cell (0, 0), along rows and columns, m.
        velocity: (B, 2) desired velocity in the grid's axes, m/s.
        spec: Barrier and limits.
    """
    robots = len(h)
    if h.ndim != 3 or min(h.shape[1:]) < 2 or h.dtype != torch.float32:
        raise RomnavError(f"h is {h.dtype} {tuple(h.shape)}; expected torch.float32 (robots, rows, columns)")
    for name, x in (("position", position), ("velocity", velocity)):
        if x.shape != (robots, 2) or not x.is_floating_point():
            raise RomnavError(f"{name} is {x.dtype} {tuple(x.shape)}; expected floating point ({robots}, 2)")
    spec = spec or FilterSpec()
    limit = torch.inf
    lower, upper = (-limit, -limit), (limit, limit)
    if spec.box:
        lower, upper = (-spec.reverse, -spec.lateral), (spec.forward, spec.lateral)
    safe = torch.empty(robots, 2, dtype=torch.float64, device=h.device)
    gradient = torch.empty_like(safe)
    level = torch.empty(robots, dtype=torch.float64, device=h.device)
    status = torch.empty(robots, dtype=torch.int32, device=h.device)
    wp.launch(
        _filter,
        dim=robots,
        inputs=[
            wp.from_torch(h.contiguous()),
            cell,
            _vectors(position),
            _vectors(velocity),
            spec.alpha,
            spec.period,
            spec.retain,
            spec.escape,
            wp.vec2d(*lower),
            wp.vec2d(*upper),
        ],
        outputs=[_vectors(safe), wp.from_torch(level), _vectors(gradient), wp.from_torch(status)],
        device=str(h.device),
    )
    kind = velocity.dtype
    return Filtered(safe.to(kind), status, level.to(kind), gradient.to(kind))
