"""Distance and direction to goals at any position, from the geodesics of a world's nodes."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor

from romnav.kernels import wp
from romnav.world.geodesic import links
from romnav.world.world import World

wp.set_module_options({"enable_backward": False})


@wp.struct
class Paths:
    """`Geodesics` of all tiles, end to end, with the offsets of each goal, and the nodes of all tiles."""

    source: wp.array[wp.int16]
    """The bits of uint16: the only integers of this width that Torch and Warp share."""
    source_offset: wp.array[wp.int64]
    reach: wp.array[wp.float32]
    reach_offset: wp.array[wp.int64]
    corner: wp.array[wp.vec2]
    outward: wp.array[wp.vec2]
    corner_offset: wp.array[wp.int64]
    goal: wp.array[wp.vec2]
    position: wp.array[wp.vec2]
    link: wp.array2d[wp.int32]
    cell: float


@wp.func
def bend(paths: Paths, goal: wp.int64, node: wp.int64, clearance: float):
    """Where the path from ``node`` first bends (x, y), ``clearance`` off the corner; its distance to the goal."""
    source = wp.int64(wp.uint16(paths.source[paths.source_offset[goal] + node]))
    if source == wp.int64(65535):
        return wp.vec3(paths.goal[goal][0], paths.goal[goal][1], 0.0)
    corner = paths.corner_offset[goal] + source
    at = paths.corner[corner] + clearance * paths.outward[corner]
    return wp.vec3(at[0], at[1], paths.reach[paths.reach_offset[goal] + source])


@wp.kernel
def look(
    paths: Paths,
    at: wp.array[wp.int64],
    position: wp.array[wp.vec2],
    goals: wp.array[wp.int64],
    distance: wp.array[wp.float32],
    direction: wp.array[wp.vec2],
):
    e = wp.tid()
    node = at[e]
    if node < wp.int64(0):
        distance[e] = wp.inf
        direction[e] = wp.vec2(0.0, 0.0)
        return
    p = position[e]
    g = goals[e]
    offset = (p - paths.position[node]) / paths.cell
    along = 2
    if offset[0] < 0.0:
        along = 3
    across = 0
    if offset[1] < 0.0:
        across = 1
    a = paths.link[node, along]
    b = paths.link[node, across]
    diagonal = -1
    if a >= 0:
        diagonal = paths.link[a, across]
    if diagonal < 0 and b >= 0:
        diagonal = paths.link[b, along]
    u = wp.min(wp.abs(offset[0]), 0.5)
    v = wp.min(wp.abs(offset[1]), 0.5)
    total = 0.0
    weights = 0.0
    for k in range(4):
        n = node
        weight = (1.0 - u) * (1.0 - v)
        if k == 1:
            n = wp.int64(a)
            weight = u * (1.0 - v)
        if k == 2:
            n = wp.int64(b)
            weight = (1.0 - u) * v
        if k == 3:
            n = wp.int64(diagonal)
            weight = u * v
        if n >= wp.int64(0):
            end = bend(paths, g, n, 0.0)
            total += weight * (end[2] + wp.length(p - wp.vec2(end[0], end[1])))
            weights += weight
    distance[e] = total / weights
    # past the corner, not at it: there the heading would be into the face of the occupied cell
    end = bend(paths, g, node, 0.05 * paths.cell)
    direction[e] = wp.normalize(wp.vec2(end[0], end[1]) - p)


STRIDE = 0.1
"""Spacing of the points of a route, m."""


class GeodesicLookup:
    """Distance and direction to the goals of a world at any position, not at nodes alone.

    The distance blends, bilinearly, what the paths of the surrounding nodes give when they start at the position
    itself: it is exact where those nodes see the same corner, and continuous everywhere.
    """

    def __init__(self, world: World) -> None:
        self._world = world
        tile = torch.repeat_interleave(world.goal_start.diff())
        nodes, corners = world.node_start, world.corner_start
        steps = [links(g) for g in world.grids]
        steps = [np.where(step >= 0, step + n, -1) for step, n in zip(steps, nodes.tolist(), strict=False)]
        count = corners.diff()[tile]
        position = world.position[:, :2].contiguous()
        self._paths = Paths()
        self._paths.cell = world.cell
        for key, value, kind in (
            ("source", world.bends.view(torch.int16), wp.int16),
            ("source_offset", world.field_start - nodes[tile], wp.int64),
            ("reach", world.reach, wp.float32),
            ("reach_offset", count.cumsum(0) - count, wp.int64),
            ("corner", world.corner, wp.vec2),
            ("outward", world.outward, wp.vec2),
            ("corner_offset", corners[tile], wp.int64),
            ("goal", position[world.goal], wp.vec2),
            ("position", position, wp.vec2),
            ("link", torch.from_numpy(np.concatenate(steps)).to(position.device), wp.int32),
        ):
            setattr(self._paths, key, wp.from_torch(value, dtype=kind))
        self._nearest = torch.from_numpy(_nearest_free(world.node.cpu().numpy())).to(world.node.device)

    def __call__(self, tile: Tensor, layer: Tensor, xy: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
        """Planar distance (E,), m, and unit direction (E, 2) of the shortest path to goals (E,).

        Robots are at ``xy`` (E, 2), m, on a layer of a tile (E,). A body may be off the free cells, nearer to a solid
        than they allow: it goes to the nearest free cell of its layer first.
        """
        free = self._world.node_at(tile, layer, xy)
        cell = self._world.index(xy)
        node = torch.where(free >= 0, free, self._nearest[tile, layer, cell[:, 0], cell[:, 1]].long())
        off = (free < 0)[:, None]
        at = torch.where(off, self._world.position[node, :2], xy)
        distance, direction = self._look(node, at, goal)
        back = at - xy
        # on along the path and back to it at once: back alone would lead in circles around a corner
        on = torch.nn.functional.normalize(direction + back / self._world.cell, dim=1)
        return distance + torch.linalg.vector_norm(back, dim=1), torch.where(off, on, direction)

    def routes(self, tile: Tensor, layer: Tensor, xy: Tensor, goal: Tensor) -> list[NDArray[np.float32]]:
        """Shortest paths (K, 3) of robots placed as in a call to their goals, points about `STRIDE` apart, m."""
        world = self._world
        height = world.surface(tile, layer, xy)
        walking = torch.ones(len(xy), dtype=torch.bool, device=xy.device)
        count, points = torch.zeros(len(xy), dtype=torch.int64, device=xy.device), []
        longest = float(self(tile, layer, xy, goal)[0].max())
        for _ in range(round(2.0 * longest / STRIDE) + 1):
            points.append(torch.cat([xy, height[:, None]], dim=1))
            distance, direction = self(tile, layer, xy, goal)
            count += walking
            walking &= distance >= STRIDE
            if not walking.any():
                break
            step = STRIDE * direction * walking[:, None]
            for axis in (0, 1):  # slide along what is in the way: paths are those of the middles of cells
                along = step * torch.eye(2, device=xy.device)[axis]
                free = torch.stack([world.node_at(tile, layer, xy + s) >= 0 for s in (step, along)])
                step = torch.where((~free[0] & free[1])[:, None], along, step)
            xy = xy + step
            node = world.node_at(tile, layer, xy)
            layer = torch.where(node >= 0, world.layer[node], layer)
            surface = world.surface(tile, layer, xy)
            height = torch.where(surface.isnan(), height, surface)
        whole = torch.stack(points, dim=1).cpu().numpy()
        return [path[:n] for path, n in zip(whole, count.tolist(), strict=True)]

    def _look(self, node: Tensor, xy: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
        """The same at positions (E, 2) in the cells of nodes (E,)."""
        distance = torch.empty(len(xy), device=xy.device)
        direction = torch.empty(len(xy), 2, device=xy.device)
        wp.launch(
            look,
            len(xy),
            [
                self._paths,
                wp.from_torch(node),
                wp.from_torch(xy.contiguous(), dtype=wp.vec2),
                wp.from_torch(goal),
                wp.from_torch(distance),
                wp.from_torch(direction, dtype=wp.vec2),
            ],
            device=str(xy.device),
        )
        return distance, direction


def _nearest_free(node: NDArray[np.int32]) -> NDArray[np.int32]:
    """(T, L, N, N) nearest free node to each cell within its layer; where a layer has none, any of the tile."""
    out = np.empty_like(node)
    for t in range(len(node)):
        anywhere = node[t].max()
        for k, layer in enumerate(node[t]):
            free = layer >= 0
            if not free.any():
                out[t, k] = anywhere
                continue
            x, y = ndimage.distance_transform_edt(~free, return_distances=False, return_indices=True)
            out[t, k] = layer[x, y]
    return out
