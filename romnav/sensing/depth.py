"""Depth images of the camera that looks down from the robot's head (paper, Sec. III-B)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from romnav.kernels import wp
from romnav.sensing import columns
from romnav.sensing.sensor import Sensor
from romnav.sensing.spec import DepthSpec
from romnav.world.solids import Solids

wp.set_module_options({"enable_backward": False, "optimization_level": 3})

_MARGIN = wp.constant(1.0e-4)
"""Slack of the tests that leave a solid out, m: rounding may not cut what the exact tests would see."""


@wp.func
def _clip(span: wp.vec2, normal: float, offset: float):  # type: ignore[no-untyped-def]
    """Part of ``span`` where ``normal t <= offset``; empty if its end is the smaller."""
    if normal < 0.0:
        span[0] = wp.max(span[0], offset / normal)
    elif normal > 0.0:
        span[1] = wp.min(span[1], offset / normal)
    elif offset < 0.0:
        span[1] = -1.0
    return span


@wp.func
def _slab(span: wp.vec2, half: float, o: float, d: float):  # type: ignore[no-untyped-def]
    return _clip(_clip(span, d, half - o), -d, half + o)


@wp.func
def _disc(span: wp.vec2, radius: float, ou: float, ov: float, du: float, dv: float):  # type: ignore[no-untyped-def]
    a = du * du + dv * dv
    across = ou * dv - ov * du
    under = a * radius * radius - across * across
    if under <= 0.0:
        return wp.where(a == 0.0 and ou * ou + ov * ov <= radius * radius, span, wp.vec2(1.0, 0.0))
    middle = -(ou * du + ov * dv) / a
    reach = wp.sqrt(under) / a
    return wp.vec2(wp.max(span[0], middle - reach), wp.min(span[1], middle + reach))


@wp.func
def _furthest(solid: columns.Solid, ou: float, ov: float, height: float, d: wp.vec3):  # type: ignore[no-untyped-def]
    """Largest ``d . p`` of the points p of the solid's bounding box, seen from the camera."""
    du = solid.cos * d[0] + solid.sin * d[1]
    dv = solid.cos * d[1] - solid.sin * d[0]
    middle = 0.5 * (solid.lowest + solid.highest) - height
    half = 0.5 * (solid.highest - solid.lowest)
    nearest = d[2] * middle - du * ou - dv * ov
    return nearest + solid.half_u * wp.abs(du) + solid.half_v * wp.abs(dv) + half * wp.abs(d[2])


@wp.func
def _inward(a: wp.vec3, b: wp.vec3, inside: wp.vec3):  # type: ignore[no-untyped-def]
    """Normal of the plane of two rays, to the side of a third."""
    normal = wp.cross(a, b)
    return wp.where(wp.dot(normal, inside) < 0.0, -normal, normal)


@wp.kernel
def _list(
    solids: wp.array(dtype=columns.Solid),
    first: wp.array(dtype=wp.int32),
    rays: wp.array2d(dtype=wp.vec3),
    reach: float,
    tile: wp.array(dtype=wp.int32),
    origin: wp.array(dtype=wp.vec3),
    torso: wp.array(dtype=wp.mat33),
    near: wp.array2d(dtype=wp.int32),
    count: wp.array(dtype=wp.int32),
):
    """Solids that may reach into an image: within reach, and between the planes of its edges."""
    env = wp.tid()
    o = origin[env]
    rows = rays.shape[0]
    last = rays.shape[1] - 1
    middle = torso[env] * rays[rows // 2, last // 2]
    a = torso[env] * rays[0, 0]
    b = torso[env] * rays[0, last]
    c = torso[env] * rays[rows - 1, last]
    d = torso[env] * rays[rows - 1, 0]
    above = _inward(a, b, middle)
    right = _inward(b, c, middle)
    below = _inward(c, d, middle)
    left = _inward(d, a, middle)
    found = int(0)  # noqa: RUF046, UP018 - in Warp, int() declares a variable that changes
    for i in range(first[tile[env]], first[tile[env] + 1]):
        solid = solids[i]
        px = o[0] - solid.x
        py = o[1] - solid.y
        distance = solid.radius + reach
        if px * px + py * py > distance * distance or solid.lowest > o[2] + reach or solid.highest < o[2] - reach:
            continue
        ou = solid.cos * px + solid.sin * py
        ov = solid.cos * py - solid.sin * px
        if (
            _furthest(solid, ou, ov, o[2], above) < -_MARGIN
            or _furthest(solid, ou, ov, o[2], right) < -_MARGIN
            or _furthest(solid, ou, ov, o[2], below) < -_MARGIN
            or _furthest(solid, ou, ov, o[2], left) < -_MARGIN
        ):
            continue
        near[env, found] = i
        found += 1
    count[env] = found


@wp.kernel
def _cast(
    solids: wp.array(dtype=columns.Solid),
    near: wp.array2d(dtype=wp.int32),
    count: wp.array(dtype=wp.int32),
    rays: wp.array2d(dtype=wp.vec3),
    limits: wp.vec2,
    origin: wp.array(dtype=wp.vec3),
    torso: wp.array(dtype=wp.mat33),
    depth: wp.array3d(dtype=float),
    labels: wp.array3d(dtype=wp.int8),
):
    env, row = wp.tid()
    o = origin[env]
    # the rays of a row lie in a plane, between two half planes: few solids reach into it
    left = torso[env] * rays[row, 0]
    right = torso[env] * rays[row, rays.shape[1] - 1]
    plane = wp.cross(left, right)
    for column in range(rays.shape[1]):
        depth[env, row, column] = limits[1]
    for i in range(count[env]):
        solid = solids[near[env, i]]
        px = o[0] - solid.x
        py = o[1] - solid.y
        ou = solid.cos * px + solid.sin * py
        ov = solid.cos * py - solid.sin * px
        if (
            _furthest(solid, ou, ov, o[2], plane) < -_MARGIN
            or _furthest(solid, ou, ov, o[2], -plane) < -_MARGIN
            or _furthest(solid, ou, ov, o[2], wp.cross(plane, left)) < -_MARGIN
            or _furthest(solid, ou, ov, o[2], wp.cross(right, plane)) < -_MARGIN
        ):
            continue
        top = solid.top + solid.slope_top * ou - o[2]
        bottom = solid.bottom + solid.slope_bottom * ou - o[2]
        for column in range(rays.shape[1]):
            d = torso[env] * rays[row, column]
            du = solid.cos * d[0] + solid.sin * d[1]
            dv = solid.cos * d[1] - solid.sin * d[0]
            span = wp.vec2(0.0, depth[env, row, column])
            span = _clip(span, d[2] - solid.slope_top * du, top)
            span = _clip(span, solid.slope_bottom * du - d[2], -bottom)
            if solid.cylinder != 0:
                span = _disc(span, solid.half_u, ou, ov, du, dv)
            else:
                span = _slab(_slab(span, solid.half_u, ou, du), solid.half_v, ov, dv)
            if span[0] <= span[1] and span[0] < depth[env, row, column]:
                depth[env, row, column] = span[0]
                if labels:
                    labels[env, row, column] = wp.int8(solid.label)
    for column in range(rays.shape[1]):
        z = depth[env, row, column]
        if z < limits[0] or z >= limits[1]:
            depth[env, row, column] = 0.0
            if labels:
                labels[env, row, column] = wp.int8(-1)


class DepthCamera(Sensor):
    """The depth camera of every environment over a fixed set of tiles.

    A pinhole camera, fixed to the torso; each pixel is one ray through its centre and holds the depth along
    the optical axis. A ray that starts inside a solid has no return.

    Args:
        solids: The solids of each tile.
        spec: Image and mounting.
        device: Where to compute, "cpu" or "cuda".
    """

    spec: DepthSpec
    directions: Tensor
    """(rows, columns, 3), torso frame (x forward, y left, z up): a pixel's point is ``depth * direction``."""

    def __init__(self, solids: Sequence[Solids], spec: DepthSpec, device: str = "cpu") -> None:
        self.spec = spec
        self.device = device
        across, down = (math.tan(math.radians(f) / 2) for f in spec.field)
        left = across * (1 - (2 * np.arange(spec.columns) + 1) / spec.columns)
        up = down * (1 - (2 * np.arange(spec.rows) + 1) / spec.rows)[:, None]
        c, s = math.cos(math.radians(spec.pitch)), math.sin(math.radians(spec.pitch))
        rays = np.stack(np.broadcast_arrays(c + s * up, left, c * up - s), axis=-1)
        self.directions = torch.tensor(rays, dtype=torch.float32, device=device)
        self._rays = wp.from_torch(self.directions, dtype=wp.vec3)
        self._reach = spec.max_range * float(np.linalg.norm(rays, axis=-1).max())
        packed = np.concatenate([columns.pack(s) for s in solids])
        self._solids = wp.array(packed, dtype=columns.Solid, device=device)
        self._most = max(map(len, solids))
        self._first = wp.array(np.cumsum([0, *map(len, solids)]), dtype=wp.int32, device=device)
        wp.load_module(device=device)

    def _launch(self, pose: list[Tensor], ranges: Tensor, labels: Tensor | None) -> None:
        limits = wp.vec2(self.spec.min_range, self.spec.max_range)
        tile, origin, torso = (
            wp.from_torch(x, dtype=t) for x, t in zip(pose, (wp.int32, wp.vec3, wp.mat33), strict=True)
        )
        near = wp.empty((len(ranges), self._most), dtype=wp.int32, device=self.device)
        count = wp.empty(len(ranges), dtype=wp.int32, device=self.device)
        stream = None if self.device == "cpu" else wp.stream_from_torch(torch.device(self.device))
        inputs = [self._solids, self._first, self._rays, self._reach, tile, origin, torso]
        wp.launch(_list, len(ranges), inputs, [near, count], device=self.device, stream=stream)
        inputs = [self._solids, near, count, self._rays, limits, origin, torso]
        outputs = [wp.from_torch(ranges), None if labels is None else wp.from_torch(labels)]
        wp.launch(_cast, ranges.shape[:2], inputs, outputs, device=self.device, stream=stream)

    def _orientation(self, yaw: Tensor, tilt: Tensor) -> tuple[Tensor, ...]:
        """Rotation (E, 3, 3) from the torso to the tile frame, by yaw, then pitch, then roll."""
        roll, pitch = tilt.unbind(1)
        (cy, cp, cr), (sy, sp, sr) = ([f(a) for a in (yaw, pitch, roll)] for f in (torch.cos, torch.sin))
        rows = [
            torch.stack([cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr], 1),
            torch.stack([sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr], 1),
            torch.stack([-sp, cp * sr, cp * cr], 1),
        ]
        return (torch.stack(rows, 1).contiguous(),)
