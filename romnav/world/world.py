"""A set of tiles packed for batched use: cells, nodes, goals and their geodesic fields as flat tensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from romnav.world.geodesic import solve
from romnav.world.grids import Grids
from romnav.world.spec import WorldSpec
from romnav.world.tile import Tile

LEVEL_GAP = 0.5
"""Heights further apart than this are different levels, m (A: above every curb, below every platform with stairs)."""
STOREY, TWO_STOREYS = 3.5, 7.5
"""Least climb that counts as one storey and as two, m."""
MOUTH_RADIUS = 1.0
"""A spawn this near to the end of a stair or ramp is at its mouth, m (A)."""
SOLVED_AT_ONCE = 16
"""Tiles whose geodesics are computed together: enough for many workers, few enough to hold beside the result."""


@dataclass(frozen=True)
class World:
    """``T`` tiles with ``L`` layers (the most of any tile) of ``N x N`` cells, and ``G`` goals over all tiles.

    Nodes of all tiles are numbered through; node ids in the packed arrays are global. Fields lie one after the
    other in `fields`: the distance from node n of a goal's tile is ``fields[field_start[g] + n - node_start[tile]]``.
    """

    spec: WorldSpec
    tiles: tuple[Tile, ...]
    grids: tuple[Grids, ...]
    node: Tensor
    """(T, L, N, N) int32 global node of each cell, -1 where occupied."""
    height: Tensor
    """(T, L, N, N) float32 height of the walking surface, m; NaN where there is none."""
    switch: Tensor
    """(T, L + 1) float32: a robot is on layer l while its height is in (switch[l], switch[l + 1]]."""
    position: Tensor
    """(M, 3) float32 node positions, m, tile frame."""
    layer: Tensor
    """(M,) int64 layer of each node."""
    node_start: Tensor
    """(T + 1,) int64 first node of each tile."""
    spawn: Tensor
    """(S,) int64 nodes on or at the mouth of a stair or ramp, tile after tile."""
    spawn_start: Tensor
    """(T + 1,) int64 first entry of `spawn` of each tile."""
    storeys: Tensor
    """(T,) int64 number of floors."""
    goal: Tensor
    """(G,) int64 goal nodes, tile after tile."""
    goal_start: Tensor
    """(T + 1,) int64 first goal of each tile."""
    field_start: Tensor
    """(G,) int64 offset of each goal's field in `fields`."""
    fields: Tensor
    """(sum over goals of the tile's nodes,) uint16 planar geodesic distances, in `geodesic.UNIT`."""
    bends: Tensor
    """uint16, as `fields`: the corner of the goal's tile at which the path first bends, `geodesic.GOAL` if at none."""
    corner: Tensor
    """(C, 2) float32 corners of all tiles, tile after tile, m."""
    outward: Tensor
    """(C, 2) float32 signs of x and y away from the occupied cell of each corner."""
    corner_start: Tensor
    """(T + 1,) int64 first corner of each tile."""
    reach: Tensor
    """(sum over goals of the tile's corners,) float32 distance of each corner to the goal, m, goal after goal."""
    seconds: float = 0.0
    """Time that generating it took, s."""

    @property
    def cell(self) -> float:
        """Cell side, m."""
        return self.spec.grid.cell

    def to(self, device: str) -> World:
        """The same world with its tensors on ``device``."""
        moved: dict[str, Any] = {k: v.to(device) for k, v in self.__dict__.items() if isinstance(v, Tensor)}
        return replace(self, **moved)

    def field(self, goal: int) -> Tensor:
        """(nodes of its tile,) uint16 distance to a goal from every node of its tile, in `geodesic.UNIT`."""
        tile = int(torch.searchsorted(self.goal_start, goal, right=True)) - 1
        nodes = int(self.node_start[tile + 1] - self.node_start[tile])
        return self.fields[int(self.field_start[goal]) :][:nodes]

    def index(self, xy: Tensor) -> Tensor:
        """(E, 2) int64 cells of positions (E, 2), clamped to the tile: the only place that turns one into the other."""
        return (xy / self.cell).floor().long().clamp_(0, self.node.shape[-1] - 1)

    def node_at(self, tile: Tensor, layer: Tensor, xy: Tensor) -> Tensor:
        """(E,) int64 global node under positions (E, 2) on a layer, -1 where occupied or off the tile."""
        cell = self.index(xy)
        inside = ((xy >= 0) & (xy < self.spec.side)).all(dim=1)
        return torch.where(inside, self.node[tile, layer, cell[:, 0], cell[:, 1]].long(), -1)

    def surface(self, tile: Tensor, layer: Tensor, xy: Tensor) -> Tensor:
        """(E,) height of the walking surface under positions (E, 2), m."""
        cell = self.index(xy)
        return self.height[tile, layer, cell[:, 0], cell[:, 1]]


def pack(
    spec: WorldSpec,
    tiles: Sequence[Tile],
    grids: Sequence[Grids],
    goals: Sequence[NDArray],
) -> World:
    """Pack tiles, their grids and their goals (local node ids per tile) into a `World`."""
    count = grids[0].node.shape[-1]
    layers = max(g.node.shape[0] for g in grids)
    node_start = np.concatenate([[0], np.cumsum([len(g.position) for g in grids])])
    node = np.full((len(tiles), layers, count, count), -1, np.int32)
    height = np.full(node.shape, np.nan, np.float32)
    switch = np.full((len(tiles), layers + 1), np.inf, np.float32)
    switch[:, 0] = -np.inf
    spawn = []
    for t, (tile, g) in enumerate(zip(tiles, grids, strict=True)):
        n = g.node.shape[0]
        node[t, :n] = np.where(g.node >= 0, g.node + node_start[t], -1)
        height[t, :n] = g.height
        switch[t, 1:n] = g.switch
        spawn.append(np.flatnonzero(_stair_spawns(tile, g)) + node_start[t])
    per_goal = np.repeat([len(g.position) for g in grids], [len(g) for g in goals])
    fields, bends = np.empty(per_goal.sum(), np.uint16), np.empty(per_goal.sum(), np.uint16)
    paths, done = [], 0
    for first in range(0, len(tiles), SOLVED_AT_ONCE):
        some = slice(first, first + SOLVED_AT_ONCE)
        for path in solve(list(grids[some]), [np.asarray(g) for g in goals[some]]):
            part = slice(done, done := done + path.distance.size)
            fields[part], bends[part] = path.distance.ravel(), path.source.ravel()
            paths.append((path.corner, path.outward, path.reach))
    corner, outward, reach = zip(*paths, strict=True)
    return World(
        spec=spec,
        tiles=tuple(tiles),
        grids=tuple(grids),
        node=torch.from_numpy(node),
        height=torch.from_numpy(height),
        switch=torch.from_numpy(switch),
        position=torch.from_numpy(np.concatenate([g.position for g in grids])),
        layer=torch.from_numpy(np.concatenate([g.layer for g in grids]).astype(np.int64)),
        node_start=torch.from_numpy(node_start),
        spawn=torch.from_numpy(np.concatenate(spawn)),
        spawn_start=torch.from_numpy(np.concatenate([[0], np.cumsum([len(s) for s in spawn])])),
        storeys=torch.tensor([len(tile.storeys) for tile in tiles]),
        goal=torch.from_numpy(np.concatenate([g + s for g, s in zip(goals, node_start, strict=False)])),
        goal_start=torch.from_numpy(np.concatenate([[0], np.cumsum([len(g) for g in goals])])),
        field_start=torch.from_numpy(np.concatenate([[0], np.cumsum(per_goal)[:-1]])),
        fields=torch.from_numpy(fields),
        bends=torch.from_numpy(bends),
        corner=torch.from_numpy(np.concatenate(corner)),
        outward=torch.from_numpy(np.concatenate(outward)),
        corner_start=torch.from_numpy(np.concatenate([[0], np.cumsum([len(c) for c in corner])])),
        reach=torch.from_numpy(np.concatenate([r.ravel() for r in reach])),
    )


def _stair_spawns(tile: Tile, grid: Grids) -> NDArray[np.bool_]:
    """(M,) nodes on a stair or ramp, or within `MOUTH_RADIUS` of either end of one."""
    chosen = grid.connector.copy()
    for connector in tile.connectors:
        for mouth in connector.path[[0, -1]]:
            offset = grid.position - mouth
            chosen |= (np.hypot(offset[:, 0], offset[:, 1]) < MOUTH_RADIUS) & (np.abs(offset[:, 2]) < LEVEL_GAP)
    return chosen
