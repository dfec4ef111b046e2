"""Range images by exact intersection of rays with the solids of a tile, one vertical plane of rays at a time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import torch
import warp as wp
from torch import Tensor

from romnav.sensing.spec import LidarSpec
from romnav.world.solids import Shape, Solids

wp.config.log_level = wp.LOG_WARNING
wp.set_module_options({"enable_backward": False})

SEAM = 1e-5
"""Margin by which footprints grow, m, so that no ray slips through the seam of two touching solids."""


@wp.struct
class Solid:
    """A solid in float32; `romnav.world.solids.Solids` defines the fields."""

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
    label: int


@wp.func
def _footprint(solid: Solid, ou: float, ov: float, du: float, dv: float):  # type: ignore[no-untyped-def]
    """Interval of distances over which a horizontal line is in the footprint; empty if the first is larger."""
    if solid.cylinder != 0:
        along = -(ou * du + ov * dv)
        across = ou * dv - ov * du
        under = solid.half_u * solid.half_u - across * across
        if under <= 0.0:
            return 1.0, 0.0
        chord = wp.sqrt(under)
        return along - chord, along + chord
    iu = 1.0 / wp.where(wp.abs(du) < 1.0e-9, 1.0e-9, du)
    iv = 1.0 / wp.where(wp.abs(dv) < 1.0e-9, 1.0e-9, dv)
    reach_u = wp.abs(solid.half_u * iu)
    reach_v = wp.abs(solid.half_v * iv)
    return wp.max(-ou * iu - reach_u, -ov * iv - reach_v), wp.min(-ou * iu + reach_u, -ov * iv + reach_v)


@wp.func
def _ray(m: float, t0: float, t1: float, a0: float, a1: float, b0: float, b1: float) -> float:
    """Distance at which a ray of slope ``m`` enters the trapezoid, 0 if it starts inside, -1 if it misses."""
    near = wp.max(t0, 0.0)
    far = t1
    above = m - a1
    below = m - b1
    if above > 0.0:
        far = wp.min(far, a0 / above)
    elif above < 0.0:
        near = wp.max(near, a0 / above)
    elif a0 < 0.0:
        far = -1.0
    if below < 0.0:
        far = wp.min(far, b0 / below)
    elif below > 0.0:
        near = wp.max(near, b0 / below)
    elif b0 > 0.0:
        far = -1.0
    return wp.where(near <= far, near, -1.0)


@wp.kernel
def _scan(
    solids: wp.array(dtype=Solid),
    first: wp.array(dtype=wp.int32),
    slopes: wp.array(dtype=float),
    directions: wp.array2d(dtype=wp.vec3),
    tile: wp.array(dtype=wp.int32),
    origin: wp.array(dtype=wp.vec3),
    yaw: wp.array(dtype=float),
    axis: wp.array(dtype=wp.vec3),
    field: wp.vec2,
    limits: wp.vec2,
    ranges: wp.array3d(dtype=float),
    labels: wp.array3d(dtype=wp.int8),
):
    env, column = wp.tid()
    rows = slopes.shape[0]
    ahead = directions[0, column]
    flat = 1.0 / wp.sqrt(ahead[0] * ahead[0] + ahead[1] * ahead[1])
    c = wp.cos(yaw[env])
    s = wp.sin(yaw[env])
    dx = (c * ahead[0] - s * ahead[1]) * flat
    dy = (s * ahead[0] + c * ahead[1]) * flat
    o = origin[env]
    for row in range(rows):
        ranges[env, row, column] = wp.inf
    for i in range(first[tile[env]], first[tile[env] + 1]):
        solid = solids[i]
        px = o[0] - solid.x
        py = o[1] - solid.y
        ou = solid.cos * px + solid.sin * py
        ov = solid.cos * py - solid.sin * px
        du = solid.cos * dx + solid.sin * dy
        dv = solid.cos * dy - solid.sin * dx
        t0, t1 = _footprint(solid, ou, ov, du, dv)
        if t0 <= t1 and t1 >= 0.0 and t0 < limits[1]:
            a0 = solid.top + solid.slope_top * ou - o[2]
            b0 = solid.bottom + solid.slope_bottom * ou - o[2]
            a1 = solid.slope_top * du
            b1 = solid.slope_bottom * du
            for row in range(rows):
                t = _ray(slopes[row], t0, t1, a0, a1, b0, b1)
                if t >= 0.0 and t < ranges[env, row, column]:
                    ranges[env, row, column] = t
                    if labels:
                        labels[env, row, column] = wp.int8(solid.label)
    for row in range(rows):
        d = directions[row, column]
        r = ranges[env, row, column] / wp.sqrt(d[0] * d[0] + d[1] * d[1])
        seen = wp.dot(axis[env], d)
        if r < limits[0] or r > limits[1] or seen < field[0] or seen > field[1]:
            r = 0.0
            if labels:
                labels[env, row, column] = wp.int8(-1)
        ranges[env, row, column] = r


class Lidar:
    """The LiDAR of every environment over a fixed set of tiles.

    The image is levelled: its rows are elevations above the horizon from the top edge down, its columns azimuths
    from the left edge to the right one, each pixel one ray through its centre. All rays of a column thus share
    a vertical plane, in which a solid is a trapezoid. The mounting of the sensor only decides which pixels lie
    in its field of view.

    A ray that starts inside a solid hits it at distance 0, hence has no return. Nothing bounds a tile but its
    solids.

    Args:
        solids: The solids of each tile.
        side: Tile side, m.
        spec: Image and sensor.
        device: Where to compute, "cpu" or "cuda".
    """

    directions: Tensor
    """(rows, columns, 3) unit vectors in the levelled LiDAR frame (x forward, y left, z up)."""

    def __init__(self, solids: Sequence[Solids], side: float, spec: LidarSpec, device: str = "cpu") -> None:
        wp.init()
        self.spec = spec
        self.device = device
        azimuth = math.radians(spec.azimuth) * (0.5 - (np.arange(spec.columns) + 0.5) / spec.columns)
        low, high = (math.radians(e) for e in spec.elevation)
        elevation = high - (high - low) * (np.arange(spec.rows) + 0.5) / spec.rows
        flat, up = np.cos(elevation)[:, None], np.sin(elevation)[:, None]
        rays = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), up + 0 * azimuth], axis=-1)
        self.directions = torch.tensor(rays, dtype=torch.float32, device=device)
        self._directions = wp.from_torch(self.directions, dtype=wp.vec3)
        self._slopes = wp.array(np.tan(elevation), dtype=float, device=device)
        self._solids = wp.array(np.concatenate([_pack(s) for s in solids]), dtype=Solid, device=device)
        first = np.concatenate([[0], np.cumsum([len(s) for s in solids])])
        self._first = wp.array(first, dtype=wp.int32, device=device)
        self._field = wp.vec2(*(math.sin(math.radians(e)) for e in spec.field))

    def scan(
        self, tile: Tensor, origin: Tensor, yaw: Tensor, *, labels: bool = False, tilt: Tensor | None = None
    ) -> Any:
        """Measure the noiseless range images.

        Args:
            tile: (E,) int32, tile of each environment.
            origin: (E, 3) float32, LiDAR centre in the tile frame, m.
            yaw: (E,) float32, heading of the image's centre column, rad.
            labels: Whether to return the `romnav.world.solids.Label` of each return as well.
            tilt: (E, 2) float32, roll and pitch of the torso that carries the sensor, rad; level if None.

        Returns:
            (E, rows, columns) float32 ranges in m, 0 where there is no return; with ``labels`` also
            (E, rows, columns) int8, -1 where there is no return.
        """
        count = len(tile)
        shape = (count, self.spec.rows, self.spec.columns)
        ranges = torch.empty(shape, device=self.device)
        classes = torch.full(shape, -1, dtype=torch.int8, device=self.device) if labels else None
        axis = self._axis(count, tilt)
        per_env = (
            tile.to(torch.int32).contiguous(),
            origin.float().contiguous(),
            yaw.float().contiguous(),
            axis,
            ranges,
            classes,
        )

        def launch(start: int, stop: int) -> None:
            t, o, y, a, r, k = (None if x is None else x[start:stop] for x in per_env)
            wp.launch(
                _scan,
                dim=(stop - start, self.spec.columns),
                inputs=[
                    self._solids,
                    self._first,
                    self._slopes,
                    self._directions,
                    wp.from_torch(t),
                    wp.from_torch(o, dtype=wp.vec3),
                    wp.from_torch(y),
                    wp.from_torch(a, dtype=wp.vec3),
                    self._field,
                    wp.vec2(self.spec.min_range, self.spec.max_range),
                    wp.from_torch(r),
                    None if k is None else wp.from_torch(k),
                ],
                device=self.device,
            )

        threads = torch.get_num_threads() if self.device == "cpu" else 1
        bounds = np.linspace(0, count, threads + 1).astype(int)
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(launch, bounds[:-1].tolist(), bounds[1:].tolist()))
        return (ranges, classes) if labels else ranges

    def _axis(self, count: int, tilt: Tensor | None) -> Tensor:
        """(E, 3) the sensor's own z axis in the levelled frame; mounted upside down, it points to the ground."""
        roll, pitch = torch.zeros(2, count, device=self.device) if tilt is None else tilt.float().T
        p = self.spec.mount_pitch
        x, z = -math.sin(p), -math.cos(p)
        forward, up = x, torch.cos(roll) * z
        return torch.stack(
            [
                torch.cos(pitch) * forward + torch.sin(pitch) * up,
                -torch.sin(roll) * z,
                torch.cos(pitch) * up - torch.sin(pitch) * forward,
            ],
            dim=1,
        ).contiguous()


def _pack(solids: Solids) -> np.ndarray:
    out = np.zeros(len(solids), Solid.numpy_dtype())
    out["x"], out["y"] = solids.centre.T
    out["cos"], out["sin"] = np.cos(solids.yaw), np.sin(solids.yaw)
    out["half_u"], out["half_v"] = solids.half.T + SEAM
    for name in ("bottom", "top", "slope_bottom", "slope_top", "label"):
        out[name] = getattr(solids, name)
    out["cylinder"] = solids.shape == Shape.CYLINDER
    return out
