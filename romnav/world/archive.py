"""A world as arrays and facts, and back."""

from __future__ import annotations

from dataclasses import asdict, fields
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from romnav.world.grids import Grids
from romnav.world.solids import Solids
from romnav.world.spec import WorldSpec
from romnav.world.tile import Connector, Tile
from romnav.world.world import World

TENSORS = [field.name for field in fields(World) if field.type == Tensor.__name__]
SOLIDS = [field.name for field in fields(Solids)]


def pack(world: World, key: str) -> tuple[dict[str, NDArray], dict[str, Any]]:
    """Arrays and facts of a world, which is called ``key``; what its tensors tell of the grids is not told twice."""
    arrays = {name: getattr(world, name).numpy() for name in TENSORS}
    arrays["label"] = np.full(world.node.shape, -1, np.int8)
    for t, grids in enumerate(world.grids):
        arrays["label"][t, : len(grids.label)] = grids.label
    arrays["connector"] = np.concatenate([grids.connector for grids in world.grids])
    for name in SOLIDS:
        arrays[f"solids.{name}"] = np.concatenate([getattr(tile.solids, name) for tile in world.tiles])
    return arrays, {"key": key, "seconds": world.seconds, "tiles": [_describe(tile) for tile in world.tiles]}


def unpack(spec: WorldSpec, key: str, arrays: dict[str, NDArray], facts: Any) -> World | None:
    """The world of ``spec`` that `pack` took apart; None where these are not the arrays and facts of ``key``."""
    try:
        if facts["key"] != key:
            return None
        tensors = {name: torch.from_numpy(arrays[name]) for name in TENSORS}
        tiles, grids = [], []
        first = 0
        for t, told in enumerate(facts["tiles"]):
            part = slice(first, first := first + told["solids"])
            solids = Solids(**{name: arrays[f"solids.{name}"][part] for name in SOLIDS})
            tiles.append(_tile(spec, told, solids))
            grids.append(_grids(spec, t, len(told["layers"]), arrays))
        return World(spec=spec, tiles=tuple(tiles), grids=tuple(grids), seconds=facts["seconds"], **tensors)
    except (KeyError, TypeError, ValueError, IndexError):
        return None


def _describe(tile: Tile) -> dict[str, Any]:
    connectors = [asdict(connector) | {"path": connector.path.tolist()} for connector in tile.connectors]
    facts = {"kind": tile.kind, "index": tile.index, "layers": tile.layers, "storeys": tile.storeys}
    return facts | {"draws": tile.draws, "solids": len(tile.solids), "connectors": connectors}


def _tile(spec: WorldSpec, told: dict[str, Any], solids: Solids) -> Tile:
    return Tile(
        kind=told["kind"],
        index=told["index"],
        side=spec.side,
        solids=solids,
        layers=tuple(told["layers"]),
        storeys=tuple(told["storeys"]),
        connectors=tuple(
            Connector(c["kind"], np.array(c["path"]), c["width"], tuple(c["layers"])) for c in told["connectors"]
        ),
        draws=told["draws"],
    )


def _grids(spec: WorldSpec, t: int, layers: int, arrays: dict[str, NDArray]) -> Grids:
    first, last = arrays["node_start"][t : t + 2]
    node = arrays["node"][t, :layers]
    return Grids(
        cell=spec.grid.cell,
        height=arrays["height"][t, :layers],
        label=arrays["label"][t, :layers],
        node=np.where(node >= 0, node - np.int32(first), np.int32(-1)),
        position=arrays["position"][first:last],
        layer=arrays["layer"][first:last].astype(np.int8),
        connector=arrays["connector"][first:last],
        switch=arrays["switch"][t, 1:layers],
    )
