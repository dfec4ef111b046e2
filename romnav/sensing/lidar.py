"""The LiDAR of the robot: levelled range images of the solids of a tile (paper, Sec. III-B)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from romnav.kernels import wp
from romnav.sensing import columns, visibility
from romnav.sensing.image import angles, directions
from romnav.sensing.sensor import Sensor
from romnav.sensing.spec import LidarSpec
from romnav.world.mesh import triangulate
from romnav.world.solids import Solids


class Lidar(Sensor):
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

    spec: LidarSpec
    directions: Tensor
    """(rows, columns, 3) unit vectors in the levelled LiDAR frame (x forward, y left, z up)."""
    _label_type: ClassVar[torch.dtype] = torch.float32  # as the ranges, in whose vectors the kernel keeps them

    def __init__(
        self, solids: Sequence[Solids], spec: LidarSpec, device: str = "cpu", cache: Path | None = None
    ) -> None:
        self.spec = spec
        self.device = device
        width = math.radians(spec.azimuth)
        low, high = (math.radians(e) for e in spec.elevation)
        azimuth, elevation = angles(spec)
        heading = np.stack([np.cos(azimuth), np.sin(azimuth), np.ones_like(azimuth)])
        self.directions = directions(spec).to(device)
        self._heading = torch.tensor(heading, dtype=torch.float32, device=device)

        image = columns.Image()
        image.rows, image.columns = spec.rows, spec.columns
        image.slope = wp.array(np.tan(elevation), dtype=float, device=device)
        image.cos = wp.array(np.cos(elevation), dtype=float, device=device)
        image.sin = wp.array(np.sin(elevation), dtype=float, device=device)
        image.heading_x, image.heading_y = columns.lanes(self._heading[0]), columns.lanes(self._heading[1])
        image.left, image.columns_per_radian = width / 2, spec.columns / width
        image.left_cos, image.left_sin = math.cos(width / 2), math.sin(width / 2)
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

    def _launch(self, pose: list[Tensor], ranges: Tensor, labels: Tensor | None) -> None:
        count, rows, width = ranges.shape
        tile, origin, yaw, axis = pose
        where = [wp.from_torch(tile), wp.from_torch(origin, dtype=wp.vec3), wp.from_torch(yaw)]
        mount = wp.from_torch(axis, dtype=wp.vec3)
        vectors = [columns.lanes(ranges), None if labels is None else columns.lanes(labels)]
        stream = None if self.device == "cpu" else wp.stream_from_torch(torch.device(self.device))
        if self.spec.backend == "mesh":
            meshes, first, label, directions = self._scene
            out = [wp.from_torch(ranges), None if labels is None else wp.from_torch(labels)]
            inputs = [meshes, first, label, directions, self.spec.max_range, *where, *out]
            wp.launch(columns.cast_rays, (count, rows, width), inputs, device=self.device, stream=stream)
            wp.launch(columns.finish, count, [self._image, mount, *vectors], device=self.device, stream=stream)
        else:
            sectors = 1 if self.device == "cpu" else width // columns.LANES
            inputs = [*self._scene, self._image, sectors, *where, mount, *vectors]
            wp.launch(columns.draw_columns, (count, sectors), inputs, device=self.device, stream=stream)

    def _orientation(self, yaw: Tensor, tilt: Tensor) -> tuple[Tensor, ...]:
        """Heading and the sensor's own z axis (E, 3) in the levelled frame: upside down, it points to the ground."""
        roll, pitch = tilt.unbind(1)
        x, z = -math.sin(self.spec.mount_pitch), -math.cos(self.spec.mount_pitch)
        up = roll.cos() * z
        axis = [pitch.cos() * x + pitch.sin() * up, -roll.sin() * z, pitch.cos() * up - pitch.sin() * x]
        return yaw.contiguous(), torch.stack(axis, 1)
