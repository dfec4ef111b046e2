"""Convex solids: the one description from which every view of a tile is derived."""

from __future__ import annotations

from dataclasses import dataclass, fields
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray


class Label(IntEnum):
    """Semantic class of a surface (paper, Sec. III-A: ground/obstacle/stair/ramp segmentation)."""

    GROUND = 0
    OBSTACLE = 1
    STAIR = 2
    RAMP = 3


class Shape(IntEnum):
    """Footprint of a solid in the horizontal plane."""

    BOX = 0
    CYLINDER = 1


@dataclass(frozen=True)
class Solids:
    """A set of ``S`` upright prisms with planar, possibly inclined, lids, as a struct of arrays.

    A solid is the set of points whose local horizontal coordinates ``(u, v)`` (rotated by ``yaw`` about
    ``centre``) lie in the footprint, and whose height lies in
    ``[bottom + slope_bottom * u, top + slope_top * u]``. The footprint of a box is
    ``|u| <= half[0], |v| <= half[1]``; of a cylinder, the disc of radius ``half[0] == half[1]``.
    Boxes, walls, steps, wedges (ramps), inclined slabs and handrails, poles and drums are all of this form,
    and all are convex. Metres and radians, tile frame (origin at the tile's corner, z up, ground floor z = 0).

    Walkable solids name the range of layers ``layers[:, 0] .. layers[:, 1]`` (inclusive) whose walking surface
    they belong to: a floor slab one layer, the steps of a staircase the two layers that it joins. Everything
    else carries ``(-1, -1)``.
    """

    shape: NDArray[np.int8]
    """(S,) `Shape`."""
    label: NDArray[np.int8]
    """(S,) `Label`."""
    centre: NDArray[np.float64]
    """(S, 2) footprint centre, m."""
    yaw: NDArray[np.float64]
    """(S,) rotation of the local u axis from x, rad."""
    half: NDArray[np.float64]
    """(S, 2) half extents along u and v, m."""
    bottom: NDArray[np.float64]
    """(S,) height of the lower lid at the centre, m."""
    top: NDArray[np.float64]
    """(S,) height of the upper lid at the centre, m."""
    slope_bottom: NDArray[np.float64]
    """(S,) dz/du of the lower lid."""
    slope_top: NDArray[np.float64]
    """(S,) dz/du of the upper lid."""
    layers: NDArray[np.int8]
    """(S, 2) first and last layer of which the upper lid is walking surface; -1 if it is none."""

    def __len__(self) -> int:
        return len(self.shape)

    def __getitem__(self, index: NDArray | slice) -> Solids:
        return Solids(**{f.name: getattr(self, f.name)[index] for f in fields(self)})

    @property
    def walkable(self) -> NDArray[np.bool_]:
        """(S,) whether the upper lid is walking surface of some layer."""
        return self.layers[:, 0] >= 0

    def local(self, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Local footprint coordinates ``(u, v)``, each (S, P), of horizontal ``points`` (P, 2)."""
        d = points[None] - self.centre[:, None]
        c, s = np.cos(self.yaw)[:, None], np.sin(self.yaw)[:, None]
        return c * d[..., 0] + s * d[..., 1], c * d[..., 1] - s * d[..., 0]

    def corners(self, segments: int = 24) -> list[NDArray[np.float64]]:
        """Footprint polygon of every solid, counter-clockwise, each (K, 2): K = 4 for boxes, else ``segments``."""
        unit = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
        angle = np.linspace(0.0, 2.0 * np.pi, segments, endpoint=False)
        disc = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        out = []
        for i in range(len(self)):
            c, s = np.cos(self.yaw[i]), np.sin(self.yaw[i])
            local = (unit if self.shape[i] == Shape.BOX else disc) * self.half[i]
            out.append(local @ np.array([[c, s], [-s, c]]) + self.centre[i])
        return out


class SolidsBuilder:
    """Collects solids one at a time; `build` packs them."""

    def __init__(self) -> None:
        self._rows: list[tuple] = []

    def box(
        self,
        centre: tuple[float, float],
        size: tuple[float, float],
        z: tuple[float, float],
        *,
        yaw: float = 0.0,
        slope: float = 0.0,
        slope_bottom: float = 0.0,
        label: Label = Label.OBSTACLE,
        layers: tuple[int, int] = (-1, -1),
    ) -> None:
        """Add a box of full extents ``size`` along its local axes.

        ``z`` holds the heights of both lids at the centre, ``slope`` and ``slope_bottom`` their dz/du: a wedge
        has ``slope`` alone, an inclined slab or handrail has both equal.
        """
        half = (size[0] / 2, size[1] / 2)
        if min(half) <= 0 or z[1] <= z[0]:
            raise ValueError(f"degenerate box: size {size}, z {z}")
        self._rows.append((Shape.BOX, label, centre, yaw, half, z[0], z[1], slope_bottom, slope, layers))

    def cylinder(
        self,
        centre: tuple[float, float],
        radius: float,
        z: tuple[float, float],
        *,
        label: Label = Label.OBSTACLE,
        layers: tuple[int, int] = (-1, -1),
    ) -> None:
        """Add an upright cylinder."""
        if radius <= 0 or z[1] <= z[0]:
            raise ValueError(f"degenerate cylinder: radius {radius}, z {z}")
        self._rows.append((Shape.CYLINDER, label, centre, 0.0, (radius, radius), z[0], z[1], 0.0, 0.0, layers))

    def segment(
        self,
        start: tuple[float, float],
        end: tuple[float, float],
        width: float,
        z: tuple[float, float],
        *,
        rise: float = 0.0,
        label: Label = Label.OBSTACLE,
    ) -> None:
        """Add a wall or rail from ``start`` to ``end``; ``z`` at the start, both lids ``rise`` higher at the end."""
        du = (end[0] - start[0], end[1] - start[1])
        length = float(np.hypot(*du))
        self.box(
            ((start[0] + end[0]) / 2, (start[1] + end[1]) / 2),
            (length, width),
            (z[0] + rise / 2, z[1] + rise / 2),
            yaw=float(np.arctan2(du[1], du[0])),
            slope=rise / length,
            slope_bottom=rise / length,
            label=label,
        )

    def build(self) -> Solids:
        """Pack the solids in the order in which they were added."""
        columns = list(zip(*self._rows, strict=True))
        shape, label, centre, yaw, half, bottom, top, slope_bottom, slope_top, layers = columns
        return Solids(
            shape=np.array(shape, np.int8),
            label=np.array(label, np.int8),
            centre=np.array(centre, np.float64).reshape(-1, 2),
            yaw=np.array(yaw, np.float64),
            half=np.array(half, np.float64).reshape(-1, 2),
            bottom=np.array(bottom, np.float64),
            top=np.array(top, np.float64),
            slope_bottom=np.array(slope_bottom, np.float64),
            slope_top=np.array(slope_top, np.float64),
            layers=np.array(layers, np.int8).reshape(-1, 2),
        )
