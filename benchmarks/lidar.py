"""LiDAR range images beside Embree, Open3D, Warp's mesh query and MuJoCo: same rays, tiles of all classes.

Every program casts the rays of the images of 2,048 poses, at the paper's resolution and at that of the "cpu"
scale. Peers get the rays ready-made; ours makes them, and applies the sensor's limits, within its time. All
use every core: Open3D by itself, the others by one thread per core, each with its share of the poses.

Agreement is judged against Open3D, an exact cast at the triangles of the same solids. Peers that are not
installed are left out: ``pip install romnav[bench]`` brings them.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
import torch
from _common import CORES, arguments, importable, report
from numpy.typing import NDArray

from romnav.sensing.lidar import Lidar
from romnav.sensing.spec import LidarSpec
from romnav.world.mesh import triangulate
from romnav.world.solids import Shape, Solids
from romnav.world.spec import WorldSpec
from romnav.world.tiles import generate

SIZES = {"paper": (59, 220), "cpu": (15, 55)}
SAME = 0.01
"""Largest difference of a range that agrees, m."""
CLOSE = 5.0
"""Range within which every solid that the exact cast sees must be seen, m."""
HAIR = 1e-4
"""Ten times what the kernel adds to footprints, so that seams are closed, m."""


class Poses(NamedTuple):
    """LiDAR poses, sorted by tile."""

    tile: torch.Tensor
    origin: torch.Tensor
    yaw: torch.Tensor

    def of(self, tile: int) -> Poses:
        chosen = self.tile == tile
        return Poses(self.tile[chosen], self.origin[chosen], self.yaw[chosen])


def draw(count: int, tiles: int) -> tuple[list[Solids], Poses]:
    """Tiles of all classes, and poses above free cells with any heading."""
    made = [generate(WorldSpec(), i) for i in range(tiles)]
    rng = np.random.default_rng(0)
    tile = np.sort(np.arange(count) % tiles)
    ground = np.stack([made[t][1].position[rng.integers(len(made[t][1].position))] for t in tile])
    ground += [0.0, 0.0, LidarSpec().height]
    yaw = torch.tensor(rng.uniform(-np.pi, np.pi, count), dtype=torch.float32)
    return [t.solids for t, _ in made], Poses(torch.tensor(tile, dtype=torch.int32), torch.tensor(ground), yaw)


def rays(poses: Poses, directions: torch.Tensor) -> NDArray[np.float32]:
    """(E, rows, columns, 6) origins and directions in the tile frame."""
    cos, sin = poses.yaw.cos()[:, None, None], poses.yaw.sin()[:, None, None]
    x, y, z = directions.unbind(-1)
    d = torch.stack([cos * x - sin * y, sin * x + cos * y, z.expand(len(cos), -1, -1)], dim=-1)
    return torch.cat([poses.origin[:, None, None].expand_as(d), d], dim=-1).numpy()


Cast = Callable[[NDArray[np.float32]], NDArray]


def open3d(solids: Solids) -> Cast:
    import open3d as o3d

    mesh, scene = triangulate(solids), o3d.t.geometry.RaycastingScene()
    scene.add_triangles(mesh.vertices.astype(np.float32), mesh.triangles.astype(np.uint32))
    return lambda bundle: scene.cast_rays(o3d.core.Tensor.from_numpy(bundle))["t_hit"].numpy()


def embree(solids: Solids) -> Cast:
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    mesh, scene = triangulate(solids), EmbreeScene()
    TriangleMesh(scene, mesh.vertices.astype(np.float32), mesh.triangles)

    def cast(bundle: NDArray[np.float32]) -> NDArray:
        flat = bundle.reshape(-1, 6)
        origins, directions = np.ascontiguousarray(flat[:, :3]), np.ascontiguousarray(flat[:, 3:])
        return scene.run(origins, directions, query="DISTANCE").reshape(bundle.shape[:-1])

    return by_pose([cast] * CORES)


def mj_multi_ray(solids: Solids) -> Cast:
    spec = mujoco.MjSpec()
    mesh = triangulate(solids)
    sloped = (solids.slope_bottom != 0) | (solids.slope_top != 0)
    for i in range(len(solids)):
        size = [*solids.half[i], (solids.top[i] - solids.bottom[i]) / 2]
        pose = {"pos": [*solids.centre[i], (solids.top[i] + solids.bottom[i]) / 2]}
        if sloped[i]:
            corners = mesh.vertices[np.unique(mesh.triangles[mesh.solid == i])]
            spec.add_mesh(name=str(i), uservert=corners.ravel())
            spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=str(i))
        elif solids.shape[i] == Shape.BOX:
            quat = [np.cos(solids.yaw[i] / 2), 0, 0, np.sin(solids.yaw[i] / 2)]
            spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=size, quat=quat, **pose)
        else:
            size = [size[0], size[2], 0]
            spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=size, **pose)
    model = spec.compile()

    def cast(data: mujoco.MjData, bundle: NDArray[np.float32]) -> NDArray:
        out = np.empty(bundle.shape[:-1])
        for image, distance in zip(bundle.astype(np.float64), out, strict=True):
            ray = image.reshape(-1, 6)
            found, hit = np.empty(len(ray)), np.empty(len(ray), np.int32)
            mujoco.mj_multiRay(
                model, data, ray[0, :3], ray[:, 3:].ravel(), None, True, -1, hit, found, None, len(ray), 1e3
            )
            distance[:] = found.reshape(distance.shape)
        return np.where(out < 0, np.inf, out)

    # rays use the scratch memory of the data
    states = [mujoco.MjData(model) for _ in range(CORES)]
    for state in states:
        mujoco.mj_forward(model, state)
    return by_pose([partial(cast, state) for state in states])


def by_pose(casts: list[Cast]) -> Cast:
    """One thread for each of ``casts``, each with its share of the poses."""

    def threaded(bundle: NDArray[np.float32]) -> NDArray:
        with ThreadPoolExecutor(len(casts)) as pool:
            shares = np.array_split(bundle, len(casts))
            return np.concatenate(list(pool.map(lambda cast, share: cast(share), casts, shares)))

    return threaded


PEERS = {"open3d": open3d, "embreex": embree, "mj_multiRay": mj_multi_ray}
MODULES = {"open3d": "open3d", "embreex": "embreex", "mj_multiRay": "mujoco"}


def per_tile(casts: list[Cast], poses: Poses, directions: torch.Tensor) -> Iterator[tuple[NDArray, float]]:
    """Distances and time, s, of every tile's rays in turn; they would not fit in memory at once."""
    for tile, cast in enumerate(casts):
        bundle = rays(poses.of(tile), directions)
        start = time.perf_counter()
        distance = cast(bundle)
        yield distance, time.perf_counter() - start


def scanned(lidar: Lidar, poses: Poses) -> tuple[torch.Tensor, float]:
    start = time.perf_counter()
    ranges = lidar.scan(*poses)
    return ranges, time.perf_counter() - start


def exact(solids: Solids) -> Callable[[NDArray[np.float32]], tuple[NDArray, NDArray]]:
    """Distance along each ray and the solid that it meets, any if none."""
    import open3d as o3d

    # finer than in the race: along a prism of 64 sides a grazing ray is a centimetre longer than along its cylinder
    mesh, scene = triangulate(solids, segments=512), o3d.t.geometry.RaycastingScene()
    scene.add_triangles(mesh.vertices.astype(np.float32), mesh.triangles.astype(np.uint32))

    def cast(bundle: NDArray[np.float32]) -> tuple[NDArray, NDArray]:
        hit = scene.cast_rays(o3d.core.Tensor.from_numpy(bundle))
        triangle = hit["primitive_ids"].numpy()
        return hit["t_hit"].numpy(), mesh.solid[np.minimum(triangle, len(mesh.solid) - 1)]

    return cast


def lost(
    casts: Sequence[Callable[[NDArray[np.float32]], tuple[NDArray, NDArray]]],
    poses: Poses,
    directions: torch.Tensor,
    ranges: NDArray[np.float32],
) -> tuple[int, int]:
    """Solids that the `exact` cast of each tile sees within `CLOSE`, summed over poses, and how many ours misses.

    A ray along an edge may fall on either side of it, so a ray counts where those beside it, `HAIR` away along each
    axis, meet the same solid.
    """
    seen = missed = first = 0
    for tile, cast in enumerate(casts):
        bundle = rays(poses.of(tile), directions)
        distance, solid = cast(bundle)
        near = (distance > LidarSpec().min_range) & (distance < CLOSE)
        for shift in HAIR * np.concatenate([np.eye(3), -np.eye(3)]):
            near &= cast(bundle + np.append(shift, np.zeros(3)).astype(np.float32))[1] == solid
        image, row, column = np.nonzero(near)
        of_pose = np.stack([image, solid[near]])
        same = np.abs(ranges[first + image, row, column] - distance[near]) <= SAME
        count = len(np.unique(of_pose, axis=1).T)
        seen, missed = seen + count, missed + count - len(np.unique(of_pose[:, same], axis=1).T)
        first += len(bundle)
    return seen, missed


def measure(name: str, solids: list[Solids], poses: Poses, repeats: int, out: Path) -> bool:
    """Measures one resolution, prints it and writes ``lidar-<name>.json``."""
    rows, columns = SIZES[name]
    spec = LidarSpec(rows=rows, columns=columns, field=(-90.0, 90.0))
    lidar = Lidar(solids, spec)
    mesh = Lidar(solids, spec.model_copy(update={"backend": "mesh"}))
    casts = {k: [make(s) for s in solids] for k, make in PEERS.items() if importable(MODULES[k])}
    ranges = lidar.scan(*poses).numpy()
    times: dict[str, list[float]] = {k: [] for k in ("romnav", "wp.mesh_query_ray", *casts)}
    agree = {}
    for turn in range(repeats + 1):
        # programs take turns, so that another load on the machine hits all of them
        for key in times:
            if key in casts:
                parts = list(per_tile(casts[key], poses, lidar.directions))
                distance, seconds = np.concatenate([d for d, _ in parts]), sum(t for _, t in parts)
            else:
                image, seconds = scanned(lidar if key == "romnav" else mesh, poses)
                distance = image.numpy()
            if turn == 0:
                distance = np.where((distance < spec.min_range) | (distance > spec.max_range), 0, distance)
                agree[key] = np.abs(distance - ranges) <= SAME
            else:
                times[key].append(seconds)
    rays_cast = ranges.size / 1e6
    rates = {key: [rays_cast / seconds for seconds in values] for key, values in times.items()}
    for key, same in agree.items():
        print(f"{name}: {key:20} {same.mean():.4%} of rays within {SAME} m of ours")
    good = all(a.mean() >= 0.985 for a in agree.values())
    if "open3d" in casts:
        seen, missed = lost([exact(s) for s in solids], poses, lidar.directions, ranges)
        print(f"solids seen within {CLOSE} m by the exact cast: {seen}, of them lost: {missed}")
        good &= missed == 0
    work = f"Range images of {len(ranges)} poses, {columns} x {rows} rays, {len(solids)} tiles"
    own = rates.pop("romnav")
    report(f"lidar-{name}", work, "M rays/s", own, rates, out, agree=good, larger_is_better=True)
    return good


def main() -> None:
    """Measures both resolutions."""
    options = arguments(__doc__, poses=2048, tiles=16, repeats=3)
    torch.set_num_threads(CORES)
    solids, poses = draw(options.poses, options.tiles)
    good = [measure(name, solids, poses, options.repeats, options.out) for name in SIZES]
    if not all(good):
        sys.exit("a solid was lost, or fewer than 98.5 % of the rays agree")


if __name__ == "__main__":
    main()
