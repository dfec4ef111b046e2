"""Range images of solids in closed form.

All rays of one image column share a vertical plane. In it an upright prism is a trapezoid over the horizontal
distance t: its footprint is an interval [t0, t1], each lid a line z = a0 + a1 t. So solids are drawn into a
z-buffer: the columns between the silhouettes of the footprint, the rows between the slopes of the trapezoid's
edges, and in each of these pixels the distance at which the ray has entered both footprint and lids. Bounds
only save work, every pixel is decided by the exact test.

Columns are taken `LANES` at a time as one vector, for which the compiler emits SIMD instructions on a CPU.
Vectors have no comparisons: conditions are differences, scaled by `BIG` and clamped.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from romnav.kernels import wp
from romnav.sensing.visibility import Places, place_of
from romnav.world.solids import Shape, Solids

wp.set_module_options(
    {
        "enable_backward": False,
        "optimization_level": 3,
        # without NaN and signed zeros, minimum and maximum are one instruction each and reduce as a tree
        "cpu_compiler_flags": "-march=native -menable-no-nans -fno-signed-zeros -w",
    }
)

LANES = 16
BIG = wp.constant(1.0e30)
TINY = wp.constant(1.0e-6)
SEAM = 1e-5
"""Margin by which footprints grow, m, so that no ray slips through the seam of two touching solids."""
ANGLE_ERROR = wp.constant(3.0e-4)
"""Bound of the error of `_atan2`, rad."""

Lanes = wp.types.vector(length=LANES, dtype=float)


@wp.struct
class Solid:
    """A solid in float32; `romnav.world.solids.Solids` defines the fields, the last three bound it."""

    x: float
    y: float
    cos: float
    sin: float
    half_u: float
    half_v: float
    bottom: float
    top: float
    slope_bottom: float
    slope_top: float
    cylinder: int
    label: float
    radius: float
    lowest: float
    highest: float


@wp.struct
class Image:
    """Pixels of a levelled image. Arrays over rows are scalars; over columns, `Lanes` from each column on."""

    rows: int
    columns: int
    slope: wp.array(dtype=float)
    cos: wp.array(dtype=float)
    sin: wp.array(dtype=float)
    heading_x: wp.array(dtype=Lanes)
    heading_y: wp.array(dtype=Lanes)
    left: float
    left_cos: float
    left_sin: float
    top: float
    columns_per_radian: float
    rows_per_radian: float
    min_range: float
    max_range: float
    min_field: float
    max_field: float


@wp.func
def _atan2(y: float, x: float) -> float:
    """Polynomial arc tangent, good to `ANGLE_ERROR`."""
    ax = wp.abs(x)
    ay = wp.abs(y)
    q = wp.min(ax, ay) / wp.max(wp.max(ax, ay), 1.0e-20)
    s = q * q
    a = ((-0.0464964749 * s + 0.15931422) * s - 0.327622764) * s * q + q
    a = wp.where(ay > ax, 1.57079637 - a, a)
    a = wp.where(x < 0.0, 3.14159274 - a, a)
    return wp.where(y < 0.0, -a, a)


@wp.func
def _silhouette(solid: Solid, ou: float, ov: float) -> wp.vec4:
    """Leftmost and rightmost point of a footprint seen from (ou, ov) outside it, both relative to there."""
    hu = solid.half_u
    hv = solid.half_v
    if solid.cylinder != 0:
        tangent = wp.sqrt(wp.max(ou * ou + ov * ov - hu * hu, 0.0))
        return wp.vec4(
            -ou * tangent + ov * hu, -ov * tangent - ou * hu, -ou * tangent - ov * hu, -ov * tangent + ou * hu
        )
    east = ou > hu
    west = ou < -hu
    north = ov > hv
    south = ov < -hv
    level = not (north or south)
    plumb = not (east or west)
    return wp.vec4(
        wp.where(north or (level and east), hu, -hu) - ou,
        wp.where(east or (plumb and south), -hv, hv) - ov,
        wp.where(south or (level and east), hu, -hu) - ou,
        wp.where(east or (plumb and north), hv, -hv) - ov,
    )


@wp.func
def _chord(half: float, o: float, d: Lanes):  # type: ignore[no-untyped-def]
    """Interval of distances within ``half`` of the origin along one axis."""
    inverse = 1.0 / (d + Lanes(1.0e-20))
    middle = -o * inverse
    reach = half * wp.abs(inverse)
    return middle - reach, middle + reach


@wp.func
def _disc(radius: float, ou: float, ov: float, du: Lanes, dv: Lanes, lanes: wp.vec2i):  # type: ignore[no-untyped-def]
    """Interval of distances inside a disc, for a range of ``lanes``; the others are empty."""
    t0 = Lanes(1.0)
    t1 = Lanes(0.0)
    for j in range(lanes[0], lanes[1]):
        across = ou * dv[j] - ov * du[j]
        under = radius * radius - across * across
        if under > 0.0:
            middle = -ou * du[j] - ov * dv[j]
            t0[j] = middle - wp.sqrt(under)
            t1[j] = middle + wp.sqrt(under)
    return t0, t1


@wp.func
def _draw(
    solid: Solid,
    image: Image,
    origin: wp.vec3,
    cos: float,
    sin: float,
    start: int,
    stop: int,
    env: int,
    ranges: wp.array3d(dtype=Lanes),
    labels: wp.array3d(dtype=Lanes),
):  # type: ignore[no-untyped-def]
    """Draw ``solid`` into columns ``start`` to ``stop`` seen from ``origin`` with heading (cos, sin)."""
    px = origin[0] - solid.x
    py = origin[1] - solid.y
    distance = wp.sqrt(px * px + py * py)
    near = wp.max(distance - solid.radius, 0.0)
    far = distance + solid.radius
    upper = image.slope[0]
    lower = image.slope[image.rows - 1]
    # how far the centre lies beyond the nearer of the image's left and right edge
    ahead = -cos * px - sin * py
    aside = wp.abs(cos * py - sin * px)
    beyond = image.left_cos * aside - image.left_sin * ahead
    if (
        near > image.max_range
        or beyond > solid.radius
        or solid.lowest - origin[2] > wp.max(upper * near, upper * far)
        or solid.highest - origin[2] < wp.min(lower * near, lower * far)
    ):
        return

    ou = solid.cos * px + solid.sin * py
    ov = solid.cos * py - solid.sin * px
    # the solid's u axis in the levelled frame
    ux = cos * solid.cos + sin * solid.sin
    uy = cos * solid.sin - sin * solid.cos
    left = start
    right = stop - 1
    first = start
    last = stop - 1
    outside = wp.abs(ou) > solid.half_u or wp.abs(ov) > solid.half_v
    if solid.cylinder != 0:
        outside = distance > solid.half_u
    if outside:
        edge = _silhouette(solid, ou, ov)
        a = _atan2(uy * edge[0] + ux * edge[1], ux * edge[0] - uy * edge[1])
        b = _atan2(uy * edge[2] + ux * edge[3], ux * edge[2] - uy * edge[3])
        left = int(wp.ceil((image.left - a - ANGLE_ERROR) * image.columns_per_radian - 0.5))
        right = int(wp.floor((image.left - b + ANGLE_ERROR) * image.columns_per_radian - 0.5))
        if a >= b:
            first = wp.max(first, left)
            last = wp.min(last, right)
        elif right < first and left > last:
            return
        # else it reaches around behind the sensor: columns up to right, and from left on

    a0 = solid.top + solid.slope_top * ou - origin[2]
    b0 = solid.bottom + solid.slope_bottom * ou - origin[2]
    column = first
    while column <= last:
        if column > right and column < left:
            column = left
        c = wp.min(column, stop - LANES)
        column += LANES
        du = ux * image.heading_x[c] + uy * image.heading_y[c]
        dv = ux * image.heading_y[c] - uy * image.heading_x[c]
        t0 = Lanes(0.0)
        t1 = Lanes(0.0)
        if solid.cylinder != 0:
            t0, t1 = _disc(solid.half_u, ou, ov, du, dv, wp.vec2i(wp.max(first - c, 0), wp.min(last + 1 - c, LANES)))
        else:
            u0, u1 = _chord(solid.half_u, ou, du)
            v0, v1 = _chord(solid.half_v, ov, dv)
            t0 = wp.max(u0, v0)
            t1 = wp.min(u1, v1)
        t0 = wp.max(t0, Lanes(TINY))
        missed = BIG * wp.max(t0 - t1, Lanes(0.0))
        t1 = wp.max(t1, Lanes(TINY))

        # slopes between which a ray meets the trapezoid: a lid seen from its outer side ends at the far wall
        a1 = solid.slope_top * du
        b1 = solid.slope_bottom * du
        highest = a1 - missed
        lowest = b1 + missed
        if a0 < 0.0:
            highest += a0 / t1
        else:
            highest += a0 / t0
        if b0 > 0.0:
            lowest += b0 / t1
        else:
            lowest += b0 / t0
        upper_edge = image.top - _atan2(wp.max(highest), 1.0) - ANGLE_ERROR
        lower_edge = image.top - _atan2(wp.min(lowest), 1.0) + ANGLE_ERROR
        row = wp.max(0, int(wp.ceil(upper_edge * image.rows_per_radian - 0.5)))
        end = wp.min(image.rows - 1, int(wp.floor(lower_edge * image.rows_per_radian - 0.5)))
        while row <= end:
            slope = Lanes(image.slope[row])
            t = t0
            if a0 < 0.0:
                t = wp.max(t, a0 / (slope - a1))
            if b0 > 0.0:
                t = wp.max(t, b0 / (slope - b1))
            outside_by = wp.max(wp.max(slope - highest, lowest - slope), Lanes(0.0))
            t = t / image.cos[row] + BIG * outside_by
            if labels:
                closer = wp.min(BIG * wp.max(ranges[env, row, c] - t, Lanes(0.0)), Lanes(1.0))
                labels[env, row, c] += wp.cw_mul(closer, Lanes(solid.label) - labels[env, row, c])
            ranges[env, row, c] = wp.min(ranges[env, row, c], t)
            row += 1


@wp.func
def _finish(
    image: Image,
    axis: wp.vec3,
    start: int,
    stop: int,
    env: int,
    ranges: wp.array3d(dtype=Lanes),
    labels: wp.array3d(dtype=Lanes),
):  # type: ignore[no-untyped-def]
    """Remove what lies outside the sensor's limits; ``axis`` is its own z axis in the levelled frame."""
    for row in range(image.rows):
        column = start
        while column < stop:
            c = wp.min(column, stop - LANES)
            column += LANES
            r = wp.min(ranges[env, row, c], Lanes(1.0e6))
            ahead = axis[0] * image.heading_x[c] + axis[1] * image.heading_y[c]
            height = image.cos[row] * ahead + Lanes(axis[2] * image.sin[row])
            inside = wp.min(
                wp.min(Lanes(image.max_range) - r, r - Lanes(image.min_range)),
                wp.min(Lanes(image.max_field) - height, height - Lanes(image.min_field)),
            )
            keep = wp.min(BIG * wp.max(inside, Lanes(0.0)), Lanes(1.0))
            ranges[env, row, c] = wp.cw_mul(r, keep)
            if labels:
                labels[env, row, c] = wp.cw_mul(labels[env, row, c] + Lanes(1.0), keep) - Lanes(1.0)


@wp.kernel
def draw_columns(
    solids: wp.array(dtype=Solid),
    places: Places,
    image: Image,
    sectors: int,
    tile: wp.array(dtype=wp.int32),
    origin: wp.array(dtype=wp.vec3),
    yaw: wp.array(dtype=float),
    axis: wp.array(dtype=wp.vec3),
    ranges: wp.array3d(dtype=Lanes),
    labels: wp.array3d(dtype=Lanes),
):
    """Draw one of ``sectors`` equal parts of one environment's image; each has at least `LANES` columns."""
    env, sector = wp.tid()
    start = sector * image.columns / sectors
    stop = (sector + 1) * image.columns / sectors
    for row in range(image.rows):
        column = start
        while column < stop:
            ranges[env, row, wp.min(column, stop - LANES)] = Lanes(BIG)
            column += LANES
    cos = wp.cos(yaw[env])
    sin = wp.sin(yaw[env])
    place = place_of(places, tile[env], origin[env])
    for i in range(places.start[place], places.start[place + 1]):
        _draw(solids[places.solid[i]], image, origin[env], cos, sin, start, stop, env, ranges, labels)
    _finish(image, axis[env], start, stop, env, ranges, labels)


@wp.kernel
def cast_rays(
    meshes: wp.array(dtype=wp.uint64),
    first: wp.array(dtype=wp.int32),
    label: wp.array(dtype=wp.int8),
    directions: wp.array2d(dtype=wp.vec3),
    max_range: float,
    tile: wp.array(dtype=wp.int32),
    origin: wp.array(dtype=wp.vec3),
    yaw: wp.array(dtype=float),
    ranges: wp.array3d(dtype=float),
    labels: wp.array3d(dtype=float),
):
    """Cast one ray at the triangles of its tile; a face hit from behind says that it starts in a solid."""
    env, row, column = wp.tid()
    cos = wp.cos(yaw[env])
    sin = wp.sin(yaw[env])
    d = directions[row, column]
    ray = wp.vec3(cos * d[0] - sin * d[1], sin * d[0] + cos * d[1], d[2])
    hit = wp.mesh_query_ray(meshes[tile[env]], origin[env], ray, max_range)
    ranges[env, row, column] = wp.where(hit.result, wp.where(hit.sign > 0.0, hit.t, 0.0), BIG)
    if labels and hit.result:
        labels[env, row, column] = float(label[first[tile[env]] + hit.face])


@wp.kernel
def finish(
    image: Image,
    axis: wp.array(dtype=wp.vec3),
    ranges: wp.array3d(dtype=Lanes),
    labels: wp.array3d(dtype=Lanes),
):
    """Remove what lies outside the sensor's limits from raw distances."""
    env = wp.tid()
    _finish(image, axis[env], 0, image.columns, env, ranges, labels)


def lanes(tensor: Tensor) -> Any:
    """View of a float32 tensor: element ``[..., c]`` is the vector of its columns c to c + LANES - 1."""
    return wp.array(
        ptr=tensor.data_ptr(),
        dtype=Lanes,
        shape=(*tensor.shape[:-1], tensor.shape[-1] - LANES + 1),
        strides=tuple(4 * s for s in tensor.stride()),
        device=wp.device_from_torch(tensor.device),
    )


def pack(solids: Solids) -> NDArray:
    """Solids as an array of `Solid`."""
    out = np.zeros(len(solids), Solid.numpy_dtype())
    half = solids.half + SEAM
    out["x"], out["y"] = solids.centre.T
    out["cos"], out["sin"] = np.cos(solids.yaw), np.sin(solids.yaw)
    out["half_u"], out["half_v"] = half.T
    for name in ("bottom", "top", "slope_bottom", "slope_top", "label"):
        out[name] = getattr(solids, name)
    out["cylinder"] = solids.shape == Shape.CYLINDER
    # rounded outwards: bounds may not cut what the exact tests would see
    out["radius"] = np.hypot(*half.T) + 10 * SEAM
    out["lowest"] = solids.bottom - np.abs(solids.slope_bottom) * half[:, 0] - 10 * SEAM
    out["highest"] = solids.top + np.abs(solids.slope_top) * half[:, 0] + 10 * SEAM
    return out
