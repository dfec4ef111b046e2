"""Geometry of the levelled range image: which way each pixel looks, and which pixel a point falls into."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from romnav.sensing.spec import LidarSpec


def angles(spec: LidarSpec) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Azimuth (columns,) and elevation (rows,) of the pixels' centres, rad: from the left edge, from the top edge."""
    width = math.radians(spec.azimuth)
    low, high = (math.radians(e) for e in spec.elevation)
    azimuth = width * (0.5 - (np.arange(spec.columns) + 0.5) / spec.columns)
    elevation = high - (high - low) * (np.arange(spec.rows) + 0.5) / spec.rows
    return azimuth, elevation


def directions(spec: LidarSpec) -> Tensor:
    """(rows, columns, 3) float32 unit vectors in the levelled LiDAR frame (x forward, y left, z up)."""
    azimuth, elevation = angles(spec)
    heading = np.stack([np.cos(azimuth), np.sin(azimuth), np.ones_like(azimuth)])
    cos, sin = np.cos(elevation), np.sin(elevation)
    rays = np.stack([cos, cos, sin], axis=1)[:, None] * heading.T
    return torch.tensor(rays, dtype=torch.float32).contiguous()


def project(points: Tensor, spec: LidarSpec) -> Tensor:
    """Range image (rows, columns) in m of a cloud: the nearest return of each pixel, 0 where there is none.

    Args:
        points: (N, 3) returns in the levelled LiDAR frame, m. Those out of range or out of the image are left out, and
            so are those that are not finite.
        spec: Image.
    """
    distance = torch.linalg.vector_norm(points, dim=1)
    azimuth = torch.atan2(points[:, 1], points[:, 0])
    elevation = torch.asin((points[:, 2] / distance).clamp(-1.0, 1.0))
    width = math.radians(spec.azimuth)
    low, high = (math.radians(e) for e in spec.elevation)
    column = torch.floor((0.5 - azimuth / width) * spec.columns)
    row = torch.floor((high - elevation) / (high - low) * spec.rows)
    seen = (distance >= spec.min_range) & (distance <= spec.max_range)
    seen &= (column >= 0) & (column < spec.columns) & (row >= 0) & (row < spec.rows)
    pixel = row[seen].long() * spec.columns + column[seen].long()
    image = torch.full((spec.rows * spec.columns,), torch.inf)
    image.scatter_reduce_(0, pixel, distance[seen].float(), "amin")
    return image.nan_to_num(posinf=0.0).view(spec.rows, spec.columns)


def level(points: Tensor, roll: float, pitch: float) -> Tensor:
    """Points (N, 3) in axes that are tilted by ``roll`` and ``pitch`` (rad; yaw-pitch-roll), in level axes."""
    (sr, cr), (sp, cp) = ((math.sin(a), math.cos(a)) for a in (roll, pitch))
    turn = [[cp, sp * sr, sp * cr], [0.0, cr, -sr], [-sp, cp * sr, cp * cr]]
    return points @ torch.tensor(turn, dtype=points.dtype).T
