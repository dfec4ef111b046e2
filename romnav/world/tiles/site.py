"""Local frames and reservations: what the tile generators build with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from romnav.world.solids import Label, SolidsBuilder

Span = tuple[float, float]

MAX_FITS = 1000
"""Outlines of a building or room that are drawn until one fits into the tile."""


@dataclass(frozen=True)
class Frame:
    """Horizontal frame ``(u, v)`` at ``(x, y)``, rotated by ``yaw`` (m, rad)."""

    x: float
    y: float
    yaw: float = 0.0

    def at(self, u: float, v: float) -> tuple[float, float]:
        """Tile coordinates of a local point."""
        c, s = float(np.cos(self.yaw)), float(np.sin(self.yaw))
        return self.x + c * u - s * v, self.y + s * u + c * v

    def local(self, x: float, y: float) -> tuple[float, float]:
        """Local coordinates of a point of the tile."""
        c, s = float(np.cos(self.yaw)), float(np.sin(self.yaw))
        return c * (x - self.x) + s * (y - self.y), c * (y - self.y) - s * (x - self.x)

    def sub(self, u: float, v: float, yaw: float = 0.0) -> Frame:
        """Frame at a local point, turned by ``yaw`` against this one."""
        return Frame(*self.at(u, v), self.yaw + yaw)

    def path(self, points: list[tuple[float, float, float]]) -> NDArray[np.float64]:
        """(K, 3) tile coordinates of local points ``(u, v, z)``."""
        return np.array([(*self.at(u, v), z) for u, v, z in points])


def block(
    solids: SolidsBuilder,
    frame: Frame,
    u: Span,
    v: Span,
    z: Span,
    *,
    slope: float = 0.0,
    slope_bottom: float = 0.0,
    label: Label = Label.OBSTACLE,
    layers: tuple[int, int] = (-1, -1),
) -> None:
    """Add the box over the local rectangle ``u x v``; ``z`` and the slopes as in `SolidsBuilder.box`."""
    solids.box(
        frame.at((u[0] + u[1]) / 2, (v[0] + v[1]) / 2),
        (u[1] - u[0], v[1] - v[0]),
        z,
        yaw=frame.yaw,
        slope=slope,
        slope_bottom=slope_bottom,
        label=label,
        layers=layers,
    )


def edges(frame: Frame, size: tuple[float, float]) -> list[tuple[Frame, float]]:
    """Sides of the rectangle ``[0, size[0]] x [0, size[1]]``: frames (u along, v outward) and lengths."""
    u, v = size
    return [
        (frame.sub(u, 0.0, np.pi), u),
        (frame.sub(u, v, -np.pi / 2), v),
        (frame.sub(0.0, v), u),
        (frame.sub(0.0, 0.0, np.pi / 2), v),
    ]


def cut(outer: tuple[Span, Span], holes: list[tuple[Span, Span]]) -> list[tuple[Span, Span]]:
    """Rectangles that cover ``outer`` less ``holes`` exactly, without overlap."""
    parts = [outer]
    for hu, hv in holes:
        rest = []
        for (u0, u1), (v0, v1) in parts:
            a0, a1, b0, b1 = max(u0, hu[0]), min(u1, hu[1]), max(v0, hv[0]), min(v1, hv[1])
            if a0 >= a1 or b0 >= b1:
                rest.append(((u0, u1), (v0, v1)))
                continue
            strips = [((u0, a0), (v0, v1)), ((a1, u1), (v0, v1)), ((a0, a1), (v0, b0)), ((a0, a1), (b1, v1))]
            rest += [(su, sv) for su, sv in strips if su[1] - su[0] > 1e-9 and sv[1] - sv[0] > 1e-9]
        parts = rest
    return parts


class Floor:
    """Reservations on one storey, on a 0.1 m raster: keep furniture out of doorways, stairs and furniture."""

    def __init__(self, side: float, cell: float = 0.1) -> None:
        self._centres = (np.arange(round(side / cell)) + 0.5) * cell
        self._taken = np.ones((len(self._centres),) * 2, bool)

    def open(self, frame: Frame, u: Span, v: Span) -> None:
        """Declare a local rectangle free."""
        window, inside = self._inside(frame, u, v)
        self._taken[window][inside] = False

    def reserve(self, frame: Frame, u: Span, v: Span, margin: float = 0.0) -> None:
        """Take a local rectangle, grown by ``margin``."""
        window, inside = self._inside(frame, (u[0] - margin, u[1] + margin), (v[0] - margin, v[1] + margin))
        self._taken[window][inside] = True

    def fits(self, frame: Frame, u: Span, v: Span) -> bool:
        """Whether nothing is taken inside a local rectangle."""
        window, inside = self._inside(frame, u, v)
        return not (self._taken[window] & inside).any()

    def _inside(self, frame: Frame, u: Span, v: Span) -> tuple[tuple[slice, slice], NDArray[np.bool_]]:
        corners = np.array([frame.at(a, b) for a in u for b in v])
        low = np.searchsorted(self._centres, corners.min(axis=0))
        high = np.searchsorted(self._centres, corners.max(axis=0))
        window = (slice(low[0], high[0]), slice(low[1], high[1]))
        c, s = np.cos(frame.yaw), np.sin(frame.yaw)
        dx, dy = self._centres[window[0], None] - frame.x, self._centres[None, window[1]] - frame.y
        lu, lv = c * dx + s * dy, c * dy - s * dx
        return window, (lu >= u[0]) & (lu <= u[1]) & (lv >= v[0]) & (lv <= v[1])
