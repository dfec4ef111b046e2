"""Static geoms within reach: a robot's model holds only what it can touch from where it is.

Space is divided into cubes. While a pelvis is in one of them, the robot's model holds the geoms that come nearer to the
cube than a robot reaches. That depends on the position alone, so a run that is restored goes on with the same model.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

OBSTACLES = "obstacles"
"""Body of the ground that feet should not touch."""
BOX = int(mujoco.mjtGeom.mjGEOM_BOX)
CYLINDER = int(mujoco.mjtGeom.mjGEOM_CYLINDER)
MESH = int(mujoco.mjtGeom.mjGEOM_MESH)
CUBE = 1.0
"""Side of a cube, m."""
REACH = 1.0
"""No part of a robot is further from its pelvis, m, and what it moves in a control step is in it."""
FIELDS = ("geom_pos", "geom_quat", "geom_size", "geom_rbound", "geom_aabb", "geom_dataid")
"""Fields of a model that tell what its slots hold."""
VOLUMES = "bvh_aabb"
"""Field of a model: bounding volumes, by which native MuJoCo finds pairs of geoms; they follow what slots hold."""
_AWAY = (0.0, 0.0, -50.0)
"""Where geoms are that are not needed, m."""
_SLACK = 1e-6
"""Bounding volumes are larger than what they hold by this much, m."""
_BOUNDLESS = 1e10
_ASKEW = (0.8, 0.6, 0.0, 0.0)
"""Orientation of slots when compiled: MuJoCo passes over those of geoms that lie along their body."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Geoms:
    """Static geoms on the plane z = 0, as a struct of arrays over `n` of them.

    Attributes:
        kind: (n,) `BOX`, `CYLINDER` (upright) or `MESH`.
        position: (n, 3), m.
        quat: (n, 4), wxyz.
        half: (n, 3) half extents of boxes and cylinders, m.
        hull: (n,) row of `hulls` for a mesh, else -1.
        hulls: (h, 8, 3) corners of convex meshes in their geoms' frames, m.
        obstacle: (n,) whether it is in the way, not ground to walk on.
    """

    kind: NDArray[np.int64]
    position: Array
    quat: Array
    half: Array
    hull: NDArray[np.int64]
    hulls: Array
    obstacle: NDArray[np.bool_]

    @classmethod
    def boxes(cls, centre: Array, half: Array, quat: Array) -> Geoms:
        """Boxes to walk on: centres (n, 3) and half extents (n, 3), m, and orientations (n, 4), wxyz."""
        n = len(centre)
        return cls(np.full(n, BOX), centre, quat, half, np.full(n, -1), np.zeros((0, 8, 3)), np.zeros(n, bool))

    def __len__(self) -> int:
        return len(self.kind)

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lowest and highest corners, (n, 3) each, of the upright boxes around them, m."""
        corners = self.half[:, None] * np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3), axis=-1).reshape(1, 8, 3)
        mesh = self.hull >= 0
        corners[mesh] = self.hulls[self.hull[mesh]]
        at = np.einsum("nij,nkj->nki", _rotation(self.quat).as_matrix(), corners) + self.position[:, None]
        return at.min(1), at.max(1)

    def add_to(self, model: mujoco.MjSpec) -> None:
        """Add them all: what is walked on to the world body, what is in the way to the body `OBSTACLES`."""
        names = _add_hulls(model, self.hulls)
        for i, kind in enumerate(self.kind.tolist()):
            geom = _add(model, kind, bool(self.obstacle[i]))
            geom.pos, geom.quat, geom.size = self.position[i], self.quat[i], _size(self.kind, self.half)[i]
            if kind == MESH:
                geom.meshname = names[self.hull[i]]


NOTHING = Geoms.boxes(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 4)))
"""Flat ground."""


class Slots:
    """Places for static geoms in the model of every robot of a batch, each robot on one of several grounds.

    MuJoCo steps different models as a batch where they differ in numbers only: there are as many slots of each kind,
    for ground and for obstacles, as are ever within reach. What is not needed lies far below.

    Args:
        grounds: that robots may be on.

    Attributes:
        ids: (k,) geoms of the compiled model that are slots.
    """

    def __init__(self, grounds: Sequence[Geoms]) -> None:
        self._bounds = [ground.bounds for ground in grounds]
        self._groups = [_group(ground) for ground in grounds]
        self._hulls, hull = _merged(grounds)
        shape = _measured(self._hulls)
        self._fields = [_fields(ground, rows, shape) for ground, rows in zip(grounds, hull, strict=True)]
        most = np.max([_most(*bounds, group) for bounds, group in zip(self._bounds, self._groups, strict=True)], axis=0)
        # one more, so that the body of the obstacles is never empty
        most[_OBSTACLE_BOX] += 1
        self._count = most.tolist()
        self.ids = np.zeros(0, int)

    def add_to(self, model: mujoco.MjSpec) -> None:
        """Add the slots, empty."""
        names = _add_hulls(model, self._hulls)
        for group, count in enumerate(self._count):
            for k in range(count):
                geom = _add(model, _KINDS[group % 3], group >= 3)
                geom.name, geom.pos, geom.quat, geom.size = f"slot{group}_{k}", _AWAY, _ASKEW, [0.1, 0.1, 0.1]
                if geom.type == mujoco.mjtGeom.mjGEOM_MESH:
                    geom.meshname = names[0]

    def attach(self, model: mujoco.MjModel) -> None:
        """Find the slots in a compiled model; whatever holds them and the floor is everywhere in it from now on."""
        self.ids = np.array(
            [model.geom(f"slot{group}_{k}").id for group, count in enumerate(self._count) for k in range(count)]
        )
        self._empty = {name: getattr(model, name)[self.ids].copy() for name in FIELDS}
        bodies = (0, model.body(OBSTACLES).id)
        self._nodes, self._leaves, self._ranges = _volumes(model, bodies, self.ids)

    def fill(self, fields: Mapping[str, NDArray], robot: int, ground: int, cube: NDArray[np.int64]) -> None:
        """Hold what is within reach of a cube.

        Args:
            fields: `FIELDS`, (robots, geoms, ...), and `VOLUMES`, (robots, volumes, 6), where there are any; changed
                in place.
            robot: whose slots to fill.
            ground: that it is on.
            cube: (3,) floor of its pelvis's position over `CUBE`.
        """
        low, high = self._bounds[ground]
        near = np.flatnonzero(((low < (cube + 1) * CUBE + REACH) & (high > cube * CUBE - REACH)).all(1))
        group = self._groups[ground][near]
        slots, begin = np.full(len(self.ids), -1), 0
        for k, count in enumerate(self._count):
            mine = near[group == k]
            slots[begin : begin + len(mine)] = mine
            begin += count
        held = slots >= 0
        for name in FIELDS:
            value = self._empty[name].copy()
            value[held] = self._fields[ground][name][slots[held]]
            fields[name][robot, self.ids] = value
        if VOLUMES in fields:
            ends = np.tile(np.array(_AWAY), (2, len(self.ids), 1))
            ends[0, held], ends[1, held] = low[slots[held]], high[slots[held]]
            lowest = np.minimum.reduceat(ends[0, self._leaves], self._ranges)[::2]
            highest = np.maximum.reduceat(ends[1, self._leaves], self._ranges)[::2]
            volumes = np.concatenate([lowest + highest, highest - lowest + _SLACK], axis=1) / 2
            fields[VOLUMES][robot, self._nodes] = volumes


_KINDS = (CYLINDER, BOX, MESH)
_OBSTACLE_BOX = 4


def _group(ground: Geoms) -> NDArray[np.int64]:
    """(n,) which kind of slot each takes."""
    return 3 * ground.obstacle + np.searchsorted(_KINDS, ground.kind)


def _most(low: Array, high: Array, group: NDArray[np.int64]) -> NDArray[np.int64]:
    """(6,) largest number of each group within reach of any cube."""
    if not len(low):
        return np.zeros(6, int)
    first = np.floor((low - REACH) / CUBE).astype(int)
    beyond = np.floor((high + REACH) / CUBE).astype(int) + 1
    origin = first.min(0)
    counts = np.zeros((6, *(beyond.max(0) - origin + 1)), np.int64)
    for k, a, b in zip(group, first - origin, beyond - origin, strict=True):
        counts[k, a[0] : b[0], a[1] : b[1], a[2] : b[2]] += 1
    return counts.max((1, 2, 3))


def _merged(grounds: Sequence[Geoms]) -> tuple[Array, list[NDArray[np.int64]]]:
    """Hulls (h, 8, 3) that differ, and the row in them of each ground's geoms, (n,) each, -1 for none."""
    every = np.concatenate([ground.hulls for ground in grounds])
    _, first, which = np.unique(every.round(6).reshape(-1, 24), axis=0, return_index=True, return_inverse=True)
    start = np.cumsum([0] + [len(ground.hulls) for ground in grounds])
    rows = [np.append(which[a:b], -1)[ground.hull] for ground, a, b in zip(grounds, start, start[1:], strict=False)]
    return every[first], rows


def _measured(hulls: Array) -> dict[str, NDArray]:
    """`FIELDS` of geoms of the hulls at the origin, whose frames MuJoCo moves to their centres of mass."""
    spec = mujoco.MjSpec()
    for name in _add_hulls(spec, hulls):
        _add(spec, MESH, False).meshname = name
    model = spec.compile()
    return {name: getattr(model, name).copy() for name in FIELDS}


def _volumes(
    model: mujoco.MjModel, bodies: Sequence[int], ids: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Nodes (k,) of the bodies' volumes that hold slots alone, slots in the order of the leaves, and ranges (2 k,) of
    those, begin and end in turn, that each node holds. Nodes that hold the floor, too, become boundless."""
    slot = {geom: k for k, geom in enumerate(ids.tolist())}
    nodes: list[int] = []
    leaves: list[int] = []
    ranges: list[int] = []

    def visit(node: int, first: int) -> bool:
        begin, children = len(leaves), [first + child for child in model.bvh_child[node].tolist() if child >= 0]
        geom = int(model.bvh_nodeid[node])
        if not children and geom in slot:
            leaves.append(slot[geom])
        alone = all([visit(child, first) for child in children]) if children else geom in slot
        if alone:
            nodes.append(node)
            ranges.extend((begin, len(leaves)))
        elif children:
            model.bvh_aabb[node] = (0.0, 0.0, 0.0, *[_BOUNDLESS] * 3)
        return alone

    for body in bodies:
        visit(int(model.body_bvhadr[body]), int(model.body_bvhadr[body]))
    # the last range ends at a leaf that is none
    return np.array(nodes), np.array([*leaves, 0]), np.array(ranges)


def _fields(ground: Geoms, hull: NDArray[np.int64], shape: Mapping[str, NDArray]) -> dict[str, NDArray]:
    """`FIELDS` of a ground's geoms."""
    size = _size(ground.kind, ground.half)
    radius = np.where(ground.kind == CYLINDER, np.hypot(size[:, 0], size[:, 1]), np.linalg.norm(size, axis=1))
    aabb = np.concatenate([np.zeros((len(ground), 3)), ground.half], axis=1)
    fields = {
        "geom_pos": ground.position.copy(), "geom_quat": ground.quat.copy(), "geom_size": size,
        "geom_rbound": radius, "geom_aabb": aabb, "geom_dataid": np.full(len(ground), -1),
    }  # fmt: skip
    mesh = hull >= 0
    if mesh.any():
        which, turn = hull[mesh], _rotation(ground.quat[mesh])
        for name in ("geom_size", "geom_rbound", "geom_aabb", "geom_dataid"):
            fields[name][mesh] = shape[name][which]
        fields["geom_pos"][mesh] += turn.apply(shape["geom_pos"][which])
        fields["geom_quat"][mesh] = (turn * _rotation(shape["geom_quat"][which])).as_quat(scalar_first=True)
    return fields


def _size(kind: NDArray[np.int64], half: Array) -> Array:
    """Sizes (n, 3) as MuJoCo has them, of half extents (n, 3)."""
    cylinder = np.stack([half[:, 0], half[:, 2], np.zeros(len(half))], axis=1)
    return np.where((kind == CYLINDER)[:, None], cylinder, half)


def _rotation(quat: Array) -> Rotation:
    return Rotation.from_quat(quat, scalar_first=True)


def _add_hulls(model: mujoco.MjSpec, hulls: Array) -> list[str]:
    names = [f"hull{k}" for k in range(len(hulls))]
    for name, corners in zip(names, hulls, strict=True):
        model.add_mesh(name=name).uservert = corners.flatten()
    return names


def _add(model: mujoco.MjSpec, kind: int, obstacle: bool) -> mujoco.MjsGeom:
    body = model.body(OBSTACLES) if obstacle else model.worldbody
    return body.add_geom(type=kind, contype=1, conaffinity=1, mass=0.0)
