"""Headings and horizontal vectors, batched."""

from __future__ import annotations

import torch
from torch import Tensor


def wrap(angle: Tensor) -> Tensor:
    """Angle in (-pi, pi]."""
    return torch.atan2(torch.sin(angle), torch.cos(angle))


def turn_xy(vector: Tensor, angle: Tensor) -> Tensor:
    """Rotate horizontal vectors (..., 2) by angle (...), rad."""
    c, s = torch.cos(angle), torch.sin(angle)
    x, y = vector[..., 0], vector[..., 1]
    return torch.stack([c * x - s * y, s * x + c * y], dim=-1)


def heading_of(orientation: Tensor) -> Tensor:
    """Yaw (n,) of rotations (n, 3, 3)."""
    return torch.atan2(orientation[:, 1, 0], orientation[:, 0, 0])
