"""Occupancy, height and label grids per layer, derived from the solids (paper, Sec. III-D)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from romnav.world.solids import Label, Shape, Solids
from romnav.world.spec import GridSpec
from romnav.world.tile import Tile

SAME_SURFACE = 1e-6
OFFSETS_8 = np.array([(1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1)])


@dataclass(frozen=True)
class Grids:
    """Grids of a tile over ``L`` layers of ``N x N`` cells, ``[layer, ix, iy]``, and their free cells.

    Cell ``(ix, iy)`` covers ``[ix, ix + 1) x [iy, iy + 1)`` times ``cell`` metres. Free cells are *nodes*; a
    connector cell that two layers share is one node, named by both, so that motion and geodesics agree across
    layers. All nodes of a tile are mutually reachable.
    """

    cell: float
    height: NDArray[np.float32]
    """(L, N, N) height of the walking surface, m; NaN where the layer has none."""
    label: NDArray[np.int8]
    """(L, N, N) `Label` of the walking surface; -1 where the layer has none."""
    node: NDArray[np.int32]
    """(L, N, N) node of a free cell; -1 where occupied."""
    position: NDArray[np.float32]
    """(M, 3) centre of each node on the walking surface, m."""
    layer: NDArray[np.int8]
    """(M,) layer on which a robot at the node is, by the height threshold."""
    connector: NDArray[np.bool_]
    """(M,) whether the node lies on a stair or ramp."""
    switch: NDArray[np.float32]
    """(L - 1,) heights at which the robot changes between layers l and l + 1, m."""

    @property
    def free(self) -> NDArray[np.bool_]:
        """(L, N, N) whether a robot centre may be in the cell."""
        return self.node >= 0

    def neighbours(self) -> NDArray[np.int32]:
        """(M, 8) adjacent nodes in the order of `OFFSETS_8`, -1 where occupied.

        A diagonal step needs both cells beside it free, as the sliding motion does.
        """
        _, ix, iy = self._index()
        padded = np.pad(self.node, ((0, 0), (1, 1), (1, 1)), constant_values=-1)
        out = np.stack([padded[self.layer, ix + 1 + dx, iy + 1 + dy] for dx, dy in OFFSETS_8], axis=1)
        for k in (1, 3, 5, 7):
            out[(out[:, k - 1] < 0) | (out[:, (k + 1) % 8] < 0), k] = -1
        return out

    def _index(self) -> tuple[NDArray[np.int8], NDArray[np.intp], NDArray[np.intp]]:
        xy = np.floor(self.position[:, :2].astype(np.float64) / self.cell).astype(np.intp)
        return self.layer, xy[:, 0], xy[:, 1]


def rasterise(tile: Tile, spec: GridSpec) -> Grids:
    """Derive the grids of ``tile`` from its solids alone.

    A cell is occupied where its layer has no walking surface, where a solid fills part of the robot's
    cylinder above it, or where a drop-off (a height difference above ``max_step`` or the end of the surface)
    is nearer than the robot's radius. Terrain of the cell's own layers is no obstacle: the next step of a
    staircase rises higher than a robot could step over a box.
    """
    count = round(tile.side / spec.cell)
    layers = len(tile.layers)
    shape = (layers, count, count)
    height = np.full(shape, np.nan)
    surface = np.full(shape, -1, np.int32)
    centres = ((np.arange(count) + 0.5) * spec.cell).astype(np.float64)
    for layer in range(layers):
        for s in np.flatnonzero(_on_layer(tile.solids, layer)):
            window, u, _, inside = _footprint(tile.solids, int(s), centres, 0.0)
            z = tile.solids.top[s] + tile.solids.slope_top[s] * np.clip(
                u, -tile.solids.half[s, 0], tile.solids.half[s, 0]
            )
            h, top = height[layer][window], surface[layer][window]
            higher = (inside <= 0.0) & ~(z <= h)
            h[higher], top[higher] = z[higher], s
    free = ~np.isnan(height)
    for layer in np.flatnonzero(free.any(axis=(1, 2))).tolist():
        free[layer] &= ~_blocked_by_solids(tile.solids, layer, height[layer], surface[layer], centres, spec)
        free[layer] &= _edge_distance(height[layer], spec) >= spec.robot_radius
    return _number_nodes(tile, spec, centres, height, surface, free)


def _on_layer(solids: Solids, layer: int) -> NDArray[np.bool_]:
    return (solids.layers[:, 0] <= layer) & (layer <= solids.layers[:, 1])


def _footprint(
    solids: Solids, s: int, centres: NDArray[np.float64], margin: float
) -> tuple[tuple[slice, slice], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Window of cells within ``margin`` of solid ``s``: (slices, u, v, distance to it)."""
    half, yaw = solids.half[s], solids.yaw[s]
    c, sn = np.cos(yaw), np.sin(yaw)
    if solids.shape[s] == Shape.BOX:
        reach = np.array([abs(c) * half[0] + abs(sn) * half[1], abs(sn) * half[0] + abs(c) * half[1]])
    else:
        reach = half
    low = np.searchsorted(centres, solids.centre[s] - reach - margin - 1e-6)
    high = np.searchsorted(centres, solids.centre[s] + reach + margin + 1e-6, side="right")
    window = (slice(low[0], high[0]), slice(low[1], high[1]))
    dx = centres[window[0], None] - solids.centre[s, 0]
    dy = centres[None, window[1]] - solids.centre[s, 1]
    u, v = c * dx + sn * dy, c * dy - sn * dx
    if solids.shape[s] == Shape.BOX:
        # half a micrometre of slack: a cell centre on the seam of two slabs belongs to one of them
        distance = np.hypot(np.maximum(np.abs(u) - half[0] - 5e-7, 0), np.maximum(np.abs(v) - half[1] - 5e-7, 0))
    else:
        distance = np.maximum(np.hypot(u, v) - half[0], 0)
    return window, u, v, distance


def _blocked_by_solids(
    solids: Solids,
    layer: int,
    height: NDArray[np.float64],
    surface: NDArray[np.int32],
    centres: NDArray[np.float64],
    spec: GridSpec,
) -> NDArray[np.bool_]:
    blocked = np.zeros(height.shape, bool)
    low = solids.bottom - np.abs(solids.slope_bottom) * solids.half[:, 0]
    high = solids.top + np.abs(solids.slope_top) * solids.half[:, 0]
    relevant = (high > np.nanmin(height)) & (low < np.nanmax(height) + spec.robot_height)
    for s in map(int, np.flatnonzero(relevant)):
        window, u, _, distance = _footprint(solids, s, centres, spec.robot_radius)
        h, below = height[window], surface[window]
        half, reach = solids.half[s, 0], spec.robot_radius
        # inclined lids count where they reach furthest towards the robot, anywhere within its radius
        lean, lean_top = solids.slope_bottom[s], solids.slope_top[s]
        bottom = solids.bottom[s] + lean * np.clip(u - np.sign(lean) * reach, -half, half)
        top = solids.top[s] + lean_top * np.clip(u + np.sign(lean_top) * reach, -half, half)
        near = (distance < spec.robot_radius) & (bottom < h + spec.robot_height)
        if solids.layers[s, 0] < 0:
            blocked[window] |= near & (top > h + 0.05)
            continue
        own = solids.layers[below]
        related = (solids.layers[s, 0] <= own[..., 1]) & (own[..., 0] <= solids.layers[s, 1])
        overhead = (distance <= 0.0) & (bottom > h + spec.max_step)
        blocked[window] |= near & (top > h + 0.05) & (overhead | ~related)
    return blocked


def _edge_distance(height: NDArray[np.float64], spec: GridSpec) -> NDArray[np.float64]:
    """Distance from each cell centre to the nearest drop-off, m.

    Drop-offs lie on the borders between cells, that is on the odd points of a lattice of half cells.
    """
    h = np.pad(np.where(np.isnan(height), -1e9, height), 1, constant_values=-1e9)
    n = h.shape[0]
    clear = np.ones((2 * n - 1, 2 * n - 1), bool)
    clear[1::2, ::2] = np.abs(np.diff(h, axis=0)) <= spec.max_step
    clear[::2, 1::2] = np.abs(np.diff(h, axis=1)) <= spec.max_step
    distance = ndimage.distance_transform_edt(clear, sampling=spec.cell / 2)
    return distance[2:-2:2, 2:-2:2] + 1e-9


def _number_nodes(
    tile: Tile,
    spec: GridSpec,
    centres: NDArray[np.float64],
    height: NDArray[np.float64],
    surface: NDArray[np.int32],
    free: NDArray[np.bool_],
) -> Grids:
    layers, count, _ = height.shape
    reference = np.array(tile.layers)
    switch = (reference[1:] + reference[:-1]) / 2
    owner = np.broadcast_to(np.arange(layers)[:, None, None], height.shape).copy()
    for lower in range(layers - 1):
        upper = lower + 1
        shared = np.abs(height[lower] - height[upper]) <= SAME_SURFACE
        owner[lower][shared & (height[lower] > switch[lower])] = upper
        owner[upper][shared & (height[upper] <= switch[lower])] = lower
    ix, iy = np.meshgrid(np.arange(count), np.arange(count), indexing="ij")
    free = free[owner, ix, iy]
    flat = (owner * count + ix) * count + iy
    keep = free & (owner == np.arange(layers)[:, None, None])
    component = _components(np.where(free, flat, -1), layers)
    sizes = np.bincount(component[keep], minlength=1)
    keep &= component == sizes.argmax()
    number = np.full(height.size, -1, np.int32)
    number[keep.ravel()] = np.arange(keep.sum(), dtype=np.int32)
    node = np.where(free, number[flat], -1).astype(np.int32)
    k, i, j = np.nonzero(keep)
    label = np.where(surface >= 0, tile.solids.label[surface], -1).astype(np.int8)
    return Grids(
        cell=spec.cell,
        height=height.astype(np.float32),
        label=label,
        node=node,
        position=np.stack([centres[i], centres[j], height[k, i, j]], axis=1).astype(np.float32),
        layer=k.astype(np.int8),
        connector=np.isin(label[k, i, j], (Label.STAIR, Label.RAMP)),
        switch=switch.astype(np.float32),
    )


def _components(identity: NDArray[np.intp], layers: int) -> NDArray[np.int32]:
    """Component of each cell; ``identity`` names a shared cell alike on both layers, -1 if not free."""
    pairs = []
    for a, b in (
        (identity[:, 1:], identity[:, :-1]),
        (identity[:, :, 1:], identity[:, :, :-1]),
    ):
        both = (a >= 0) & (b >= 0)
        pairs.append(np.stack([a[both], b[both]]))
    edges = np.concatenate(pairs, axis=1)
    graph = coo_array((np.ones(edges.shape[1], np.int8), (edges[0], edges[1])), shape=(identity.size,) * 2)
    _, component = connected_components(graph, directed=False)
    return component[np.where(identity >= 0, identity, 0)].astype(np.int32)
