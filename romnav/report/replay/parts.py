"""What stands in the pictures: a tile cut into storeys and classes, and the humanoid's meshes."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from romnav.robot.g1 import build_spec
from romnav.robot.spec import RobotSpec
from romnav.robot.statics import NOTHING
from romnav.world.mesh import triangulate
from romnav.world.solids import Label
from romnav.world.tile import Tile

COLOURS = {
    Label.GROUND: (214, 208, 194),
    Label.OBSTACLE: (125, 141, 163),
    Label.STAIR: (230, 159, 0),
    Label.RAMP: (42, 157, 120),
}
"""Classes of solids, RGB."""
ARMS = ((31, 111, 180), (213, 94, 0), (0, 158, 115), (204, 121, 167), (148, 130, 0), (86, 180, 233))
"""Arms beside each other, RGB."""
SLAB = 0.5
"""A solid this little below a floor belongs to the storey above it, m: thicker than any slab."""


class Part(NamedTuple):
    """The solids of one class on one storey."""

    label: Label
    storey: int
    vertices: NDArray[np.float32]
    """(V, 3) tile frame, m."""
    triangles: NDArray[np.int32]
    """(T, 3)."""


def storeys(tile: Tile) -> NDArray[np.intp]:
    """(S,) storey that each solid of a tile stands on, or is the floor of."""
    floors = np.array([tile.layers[layer] for layer in tile.storeys])
    return np.clip(np.searchsorted(floors - SLAB, tile.solids.bottom, side="right") - 1, 0, None)


def parts(tile: Tile) -> list[Part]:
    """A tile, storey by storey and class by class; what has no solids is left out."""
    on, out = storeys(tile), []
    for storey in range(len(tile.storeys)):
        for label in Label:
            chosen = (on == storey) & (tile.solids.label == label)
            if chosen.any():
                mesh = triangulate(tile.solids[chosen], segments=20)
                out.append(Part(label, storey, mesh.vertices.astype(np.float32), mesh.triangles))
    return out


class Motion:
    """The humanoid between the samples of its joints, by cubic splines: a step takes two samples only.

    Args:
        joints: (K + 1, Q) generalised positions.
    """

    def __init__(self, joints: NDArray[np.float64]) -> None:
        smooth, turn = joints.copy(), joints[:, 3:7]
        # a quaternion and its negative are one orientation
        same = np.where((turn[1:] * turn[:-1]).sum(axis=1) < 0, -1.0, 1.0)
        smooth[1:, 3:7] *= np.cumprod(same)[:, None]
        self._spline = CubicSpline(np.arange(len(smooth)), smooth)

    def __call__(self, at: float) -> NDArray[np.float64]:
        """(Q,) at a time, in samples; MuJoCo normalises the quaternion."""
        between: NDArray[np.float64] = self._spline(at)
        return between


class Figure:
    """The humanoid as rigid meshes, each at its place for given joints."""

    def __init__(self, spec: RobotSpec) -> None:
        self.model = build_spec(spec, NOTHING, visual=True).compile()
        self._data = mujoco.MjData(self.model)
        shown = self.model.geom_type == mujoco.mjtGeom.mjGEOM_MESH
        self._geoms = np.flatnonzero(shown & (self.model.geom_contype == 0) & (self.model.geom_conaffinity == 0))

    def meshes(self) -> list[tuple[NDArray[np.float32], NDArray[np.int32], NDArray[np.uint8]]]:
        """Vertices (V, 3) in the mesh's own frame, m, triangles (T, 3) and colour, RGB, of each mesh."""
        model, out = self.model, []
        for geom in self._geoms:
            mesh = model.geom_dataid[geom]
            first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
            start, faces = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
            material = model.geom_matid[geom]
            rgba = model.mat_rgba[material] if material >= 0 else model.geom_rgba[geom]
            colour = (255 * rgba[:3]).astype(np.uint8)
            out.append((model.mesh_vert[first : first + count], model.mesh_face[start : start + faces], colour))
        return out

    def place(self, joints: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Positions (G, 3), m, and orientations (G, 4), wxyz, of the meshes with generalised positions (Q,)."""
        self._data.qpos[:] = joints
        mujoco.mj_kinematics(self.model, self._data)
        turns = np.zeros((len(self._geoms), 4))
        for turn, geom in zip(turns, self._geoms, strict=True):
            mujoco.mju_mat2Quat(turn, self._data.geom_xmat[geom])
        return self._data.geom_xpos[self._geoms].copy(), turns
