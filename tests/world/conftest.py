"""Tiles shared by the world's tests, and exact geometry to judge them by, as fixtures."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from romnav.world.grids import Grids
from romnav.world.mesh import Mesh
from romnav.world.solids import Solids
from romnav.world.spec import WorldSpec
from romnav.world.tile import Tile
from romnav.world.tiles import generate

COUNT = 30


@cache
def _tiles(name: str) -> list[tuple[Tile, Grids]]:
    """`COUNT` tiles of one class."""
    spec = WorldSpec(classes=(name,), seed=5)
    return [generate(spec, index) for index in range(COUNT)]


def _vertical_hits(mesh: Mesh, xy: NDArray[np.float64]) -> list[tuple[NDArray, NDArray]]:
    """Triangles that the vertical line through each point (P, 2) crosses, and at what heights."""
    a, b, c = mesh.corners.transpose(1, 0, 2)
    out = []
    for p in xy:
        w = [
            (q[:, 0] - p[0]) * (r[:, 1] - p[1]) - (r[:, 0] - p[0]) * (q[:, 1] - p[1])
            for q, r in ((b, c), (c, a), (a, b))
        ]
        total = w[0] + w[1] + w[2]
        hit = np.flatnonzero(
            ((np.sign(w[0]) == np.sign(w[1])) & (np.sign(w[1]) == np.sign(w[2]))) & (np.abs(total) > 1e-12)
        )
        z = sum(w[k][hit] * t[hit, 2] for k, t in enumerate((a, b, c))) / total[hit]
        out.append((hit, z))
    return out


def _inside(solids: Solids, points: NDArray[np.float64], slack: float = 0.0) -> NDArray[np.bool_]:
    """(S, P) whether ``points`` (P, 3) lie deeper than ``slack`` in each solid."""
    u, v = solids.local(points[:, :2])
    hu, hv = solids.half[:, :1] - slack, solids.half[:, 1:] - slack
    box = (np.abs(u) < hu) & (np.abs(v) < hv)
    footprint = np.where(solids.shape[:, None] == 0, box, np.hypot(u, v) < hu)
    low = solids.bottom[:, None] + solids.slope_bottom[:, None] * u + slack
    high = solids.top[:, None] + solids.slope_top[:, None] * u - slack
    return footprint & (points[:, 2] > low) & (points[:, 2] < high)


@pytest.fixture(scope="session")
def tiles() -> Callable:
    """`_tiles`."""
    return _tiles


@pytest.fixture(scope="session")
def vertical_hits() -> Callable:
    """`_vertical_hits`."""
    return _vertical_hits


@pytest.fixture(scope="session")
def inside() -> Callable:
    """`_inside`."""
    return _inside
