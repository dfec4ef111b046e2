"""The LiDAR of the robot: levelled range images of the solids of a tile (paper, Sec. III-A)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Literal, overload

import numpy as np
import torch
from torch import Tensor

from romnav.kernels import wp
from romnav.sensing import columns, visibility
from romnav.sensing.spec import LidarSpec
from romnav.world.mesh import triangulate
from romnav.world.solids import Solids


class Lidar:
    """The LiDAR of every environment over a fixed set of tiles.

    The image is levelled: its rows are elevations from the top edge down, its columns azimuths from the left
    edge to the right one, each pixel one ray through its centre. How the sensor is mounted and tilted only
    decides which pixels lie in its field of view; the others have no return.

    A ray that starts inside a solid hits it at distance 0, hence has no return. Solids may extend beyond
    their tile; a ray that meets none has no return.

    Args:
        solids: The solids of each tile.
        spec: Image and sensor.
        device: Where to compute, "cpu" or "cuda".
        cache: Folder where the lists of what can be seen from where are kept, which take long to make.
    """

    directions: Tensor
    """(rows, columns, 3) unit vectors in the levelled LiDAR frame (x forward, y left, z up)."""

    def __init__(
        self, solids: Sequence[Solids], spec: LidarSpec, device: str = "cpu", cache: Path | None = None
    ) -> None:
        self.spec = spec
        self.device = device
        width = math.radians(spec.azimuth)
        low, high = (math.radians(e) for e in spec.elevation)
        azimuth = width * (0.5 - (np.arange(spec.columns) + 0.5) / spec.columns)
        elevation = high - (high - low) * (np.arange(spec.rows) + 0.5) / spec.rows
        heading = np.stack([np.cos(azimuth), np.sin(azimuth), np.ones_like(azimuth)])
        cos, sin = np.cos(elevation), np.sin(elevation)
        rays = np.stack([cos, cos, sin], axis=1)[:, None] * heading.T
        self.directions = torch.tensor(rays, dtype=torch.float32, device=device).contiguous()
        self._heading = torch.tensor(heading, dtype=torch.float32, device=device)

        image = columns.Image()
        image.rows, image.columns = spec.rows, spec.columns
        image.slope = wp.array(np.tan(elevation), dtype=float, device=device)
        image.cos = wp.array(cos, dtype=float, device=device)
        image.sin = wp.array(sin, dtype=float, device=device)
        image.heading_x, image.heading_y = columns.lanes(self._heading[0]), columns.lanes(self._heading[1])
        image.left, image.columns_per_radian = width / 2, spec.columns / width
        image.top, image.rows_per_radian = high, spec.rows / (high - low)
        image.min_range, image.max_range = spec.min_range, spec.max_range
        image.min_field, image.max_field = (math.sin(math.radians(e)) for e in spec.field)
        self._image = image

        if spec.backend == "mesh":
            meshes = [triangulate(s) for s in solids]
            self._meshes = [
                wp.Mesh(
                    points=wp.array(m.vertices, dtype=wp.vec3, device=device),
                    indices=wp.array(m.triangles.ravel(), dtype=wp.int32, device=device),
                )
                for m in meshes
            ]
            first = np.cumsum([0, *(len(m.triangles) for m in meshes)])
            self._scene = [
                wp.array([m.id for m in self._meshes], dtype=wp.uint64, device=device),
                wp.array(first, dtype=wp.int32, device=device),
                wp.array(np.concatenate([m.label for m in meshes]), dtype=wp.int8, device=device),
                wp.from_torch(self.directions, dtype=wp.vec3),
            ]
        else:
            packed = np.concatenate([columns.pack(s) for s in solids])
            slopes = math.tan(elevation[-1]), math.tan(elevation[0])
            places = visibility.find(solids, slopes, spec.max_range, device, cache)
            self._scene = [wp.array(packed, dtype=columns.Solid, device=device), places]
        wp.load_module(columns, device=device)

    @overload
    def scan(
        self,
        tile: Tensor,
        origin: Tensor,
        yaw: Tensor,
        *,
        labels: Literal[False] = ...,
        tilt: Tensor | None = ...,
    ) -> Tensor: ...

    @overload
    def scan(
        self, tile: Tensor, origin: Tensor, yaw: Tensor, *, labels: Literal[True], tilt: Tensor | None = ...
    ) -> tuple[Tensor, Tensor]: ...

    def scan(
        self, tile: Tensor, origin: Tensor, yaw: Tensor, *, labels: bool = False, tilt: Tensor | None = None
    ) -> Tensor | tuple[Tensor, Tensor]:
        """Measure the range images, without noise.

        Args:
            tile: (E,) int32, tile of each environment.
            origin: (E, 3) float32, LiDAR centre in the tile frame, m.
            yaw: (E,) float32, heading of the image's centre, rad.
            labels: Whether to return the `romnav.world.solids.Label` of each return as well.
            tilt: (E, 2) float32, roll and pitch of the torso that carries the sensor, rad; None if upright.

        Returns:
            (E, rows, columns) float32 ranges in m, 0 where there is no return; with ``labels`` also
            (E, rows, columns) int8, -1 where there is no return.
        """
        count = len(tile)
        ranges = torch.empty(count, self.spec.rows, self.spec.columns, device=self.device)
        classes = torch.full_like(ranges, -1.0) if labels else None
        pose = tile.int().contiguous(), origin.float().contiguous(), yaw.float().contiguous()
        axis = self._axis(count, tilt)

        def launch(part: slice) -> None:
            self._launch(*(x[part] for x in pose), axis[part], ranges[part], None if classes is None else classes[part])

        # a launch on the CPU runs on one thread, but releases the interpreter's lock
        threads = torch.get_num_threads() if self.device == "cpu" else 1
        bounds = np.linspace(0, count, threads + 1).astype(int).tolist()
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(launch, map(slice, bounds[:-1], bounds[1:])))
        return ranges if classes is None else (ranges, classes.to(torch.int8))

    def _launch(
        self, tile: Tensor, origin: Tensor, yaw: Tensor, axis: Tensor, ranges: Tensor, labels: Tensor | None
    ) -> None:
        count, rows, width = ranges.shape
        pose = [wp.from_torch(tile), wp.from_torch(origin, dtype=wp.vec3), wp.from_torch(yaw)]
        mount = wp.from_torch(axis, dtype=wp.vec3)
        vectors = [columns.lanes(ranges), None if labels is None else columns.lanes(labels)]
        stream = None if self.device == "cpu" else wp.stream_from_torch(torch.device(self.device))
        if self.spec.backend == "mesh":
            meshes, first, label, directions = self._scene
            out = [wp.from_torch(ranges), None if labels is None else wp.from_torch(labels)]
            inputs = [meshes, first, label, directions, self.spec.max_range, *pose, *out]
            wp.launch(columns.cast_rays, (count, rows, width), inputs, device=self.device, stream=stream)
            wp.launch(columns.finish, count, [self._image, mount, *vectors], device=self.device, stream=stream)
        else:
            sectors = 1 if self.device == "cpu" else width // columns.LANES
            inputs = [*self._scene, self._image, sectors, *pose, mount, *vectors]
            wp.launch(columns.draw_columns, (count, sectors), inputs, device=self.device, stream=stream)

    def _axis(self, count: int, tilt: Tensor | None) -> Tensor:
        """(E, 3) the sensor's own z axis in the levelled frame: upside down, it points to the ground."""
        roll, pitch = (torch.zeros(count, 2, device=self.device) if tilt is None else tilt.float()).unbind(1)
        x, z = -math.sin(self.spec.mount_pitch), -math.cos(self.spec.mount_pitch)
        up = roll.cos() * z
        return torch.stack([pitch.cos() * x + pitch.sin() * up, -roll.sin() * z, pitch.cos() * up - pitch.sin() * x], 1)
