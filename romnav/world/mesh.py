"""Triangle mesh of solids: the exact view for oracles, pictures and physics."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from romnav.world.solids import Solids


@dataclass(frozen=True)
class Mesh:
    """Triangles, counter-clockwise seen from outside; every solid is a closed surface of its own."""

    vertices: NDArray[np.float64]
    """(V, 3) m."""
    triangles: NDArray[np.int32]
    """(T, 3) vertex indices."""
    solid: NDArray[np.int32]
    """(T,) solid that each triangle bounds."""
    label: NDArray[np.int8]
    """(T,) `Label` of that solid."""

    @property
    def corners(self) -> NDArray[np.float64]:
        """(T, 3, 3) corner positions of the triangles, m."""
        return self.vertices[self.triangles]


def triangulate(solids: Solids, segments: int = 64) -> Mesh:
    """Mesh of ``solids``; exact but for cylinders, which become inscribed prisms of ``segments`` sides."""
    vertices, triangles, owner = [], [], []
    count = 0
    for s, polygon in enumerate(solids.corners(segments)):
        k = len(polygon)
        offset = polygon - solids.centre[s]
        u = np.cos(solids.yaw[s]) * offset[:, 0] + np.sin(solids.yaw[s]) * offset[:, 1]
        lower = solids.bottom[s] + solids.slope_bottom[s] * u
        upper = solids.top[s] + solids.slope_top[s] * u
        vertices += [np.column_stack([polygon, lower]), np.column_stack([polygon, upper])]
        i = np.arange(k)
        j = (i + 1) % k
        fan = np.arange(1, k - 1)
        faces = np.concatenate(
            [
                np.column_stack([i, j, j + k]),
                np.column_stack([i, j + k, i + k]),
                np.column_stack([np.full(k - 2, k), fan + k, fan + k + 1]),
                np.column_stack([np.zeros(k - 2, int), fan + 1, fan]),
            ]
        )
        triangles.append(faces + count)
        owner.append(np.full(len(faces), s))
        count += 2 * k
    solid = np.concatenate(owner).astype(np.int32)
    return Mesh(
        vertices=np.concatenate(vertices),
        triangles=np.concatenate(triangles).astype(np.int32),
        solid=solid,
        label=solids.label[solid],
    )
