"""Tiles of the world as the ground of the humanoid: collision geoms from the solids, and the layer underfoot."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from romnav.robot.statics import BOX, CYLINDER, MESH, Geoms
from romnav.world.solids import Shape, Solids
from romnav.world.world import World


def geoms(solids: Solids) -> Geoms:
    """Solids that rise above the ground floor, which is a plane already, as geoms of MuJoCo.

    Upright boxes and cylinders are MuJoCo's own, inclined solids convex meshes. What is not walkable is an obstacle.
    """
    solids = solids[solids.top + np.abs(solids.slope_top) * solids.half[:, 0] > 1e-6]
    n, inclined = len(solids), (solids.slope_top != 0) | (solids.slope_bottom != 0)
    hull = np.full(n, -1)
    hull[inclined] = np.arange(inclined.sum())
    zero = np.zeros(n)
    return Geoms(
        kind=np.where(inclined, MESH, np.where(solids.shape == Shape.CYLINDER, CYLINDER, BOX)),
        position=np.column_stack([solids.centre, (solids.top + solids.bottom) / 2]),
        quat=np.column_stack([np.cos(solids.yaw / 2), zero, zero, np.sin(solids.yaw / 2)]),
        half=np.column_stack([solids.half, (solids.top - solids.bottom) / 2]),
        hull=hull,
        hulls=_corners(solids[inclined]),
        obstacle=~solids.walkable,
    )


def _corners(solids: Solids) -> NDArray[np.float64]:
    """(n, 8, 3) corners of boxes in the frame of their middle and yaw; nothing thinner than a centimetre, since the
    sharp edge of a wedge would be no triangle."""
    u, v = solids.half[:, :1] * np.array([1, 1, -1, -1]), solids.half[:, 1:] * np.array([1, -1, 1, -1])
    half = ((solids.top - solids.bottom) / 2)[:, None]
    upper = half + solids.slope_top[:, None] * u
    lower = -half + solids.slope_bottom[:, None] * u
    lower -= np.maximum(0.01 - (upper - lower).min(1, keepdims=True), 0.0)
    return np.concatenate([np.stack([u, v, z], axis=-1) for z in (upper, lower)], axis=1)


def change_layer(world: World, tile: Tensor, layer: Tensor, xy: Tensor, z: Tensor) -> Tensor:
    """Layers (n,) of robots that were on `layer` (n,) and are at `xy` (n, 2) and height `z` (n,) of a tile (n,) now."""
    up = (z > world.switch[tile, layer + 1]).long()
    down = (z <= world.switch[tile, layer]).long()
    now = layer + up - down
    exists = world.surface(tile, now.clamp(0, world.height.shape[1] - 1), xy).isfinite()
    return torch.where(exists, now, layer)
