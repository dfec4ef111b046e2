"""Paired episodes as data of the page: how each arm did, how hard they are, and where everyone went."""

from __future__ import annotations

import base64
import io
import zlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from PIL import Image

from romnav.evaluation.episodes import EpisodeSet
from romnav.evaluation.intervals import wilson
from romnav.evaluation.paired.rows import HOW, WHERE
from romnav.evaluation.tracks import RESOLUTION
from romnav.report.paired.gallery import EpisodeGallery
from romnav.report.paired.maps import shortest
from romnav.world.grids import Grids
from romnav.world.solids import Label
from romnav.world.tile import Tile
from romnav.world.world import STOREY, TWO_STOREYS

LENGTHS = (0.0, 5.0, 10.0, 15.0, 20.0, 25.0, 30.0)
"""Edges of the bins of the shortest path, m; the paper's cap is the last."""
CLIMBS = (0.0, 0.5, 2.0, STOREY, 5.5, TWO_STOREYS, 10.0)
"""Edges of the bins of the climb, m: levels differ from 0.5 m on."""
THIN = 3
"""Of the points of a shortest path, every one of this many is kept."""
PALETTE = {
    "nothing": (0, 0, 0, 0),
    "ground": (128, 128, 128, 36),
    "occupied": (110, 122, 140, 255),
    "stair": (230, 159, 0, 200),
    "ramp": (42, 157, 120, 200),
}
"""Colours of maps, translucent where the page's own colour is to show."""


def content(galleries: Mapping[str, EpisodeGallery]) -> dict[str, Any]:
    """What the page shows of episodes that several runs, by name, were evaluated on."""
    first = next(iter(galleries.values()))
    table, paired, world = first.table, first.episodes, first.world
    chosen = range(len(paired))
    columns = {"tile": "tile", "kind": "tile_class", "level": "level", "geodesic": "geodesic", "climb": "climb"}
    return {
        "episodes": {
            **{key: _plain(table[name], 2) for key, name in columns.items()},
            "start": _points(paired, "spawn"),
            "goal": _points(paired, "goal"),
        },
        "results": {name: _results(gallery.table) for name, gallery in galleries.items()},
        "bins": [
            _bins("shortest path", "m", "geodesic", LENGTHS, galleries),
            _bins("climb", "m", "climb", CLIMBS, galleries),
        ],
        "where": WHERE,
        "how": HOW,
        "periods": {name: gallery.period for name, gallery in galleries.items()},
        "tiles": {int(t): _maps(world.tiles[t], world.grids[t]) for t in np.unique(table.tile)},
        "ways": {
            **{name: _way(gallery) for name, gallery in galleries.items()},
            "shortest": _routes(shortest(world, paired, chosen)),
        },
    }


def pack(first: NDArray, columns: Mapping[str, NDArray]) -> dict[str, Any]:
    """Columns (N,) of samples, episode after episode, as deflated differences of whole centimetres and centiradians.

    ``first`` (n + 1,) is the first sample of each episode, and N.
    """
    whole = np.rint(np.stack([column.astype(np.float64) for column in columns.values()]) / RESOLUTION)
    steps = np.diff(whole, axis=1, prepend=0.0).astype("<i2")
    text = base64.b64encode(zlib.compress(steps.tobytes(), 9)).decode()
    return {"first": first.tolist(), "columns": list(columns), "steps": text}


def _way(gallery: EpisodeGallery) -> dict[str, Any]:
    tracks = gallery.tracks
    x, y, z = tracks.position.T
    return pack(tracks.first, {"x": x, "y": y, "z": z, "yaw": tracks.yaw, "contact": tracks.contact})


def _routes(routes: Sequence[NDArray]) -> dict[str, Any]:
    thin = [np.concatenate([route[:-1:THIN], route[-1:]]) for route in routes]
    x, y, z = np.concatenate(thin).T
    return pack(np.cumsum([0, *map(len, thin)]), {"x": x, "y": y, "z": z})


def _points(paired: EpisodeSet, end: str) -> list[list[float]]:
    return np.stack([paired.columns[f"{end}_{axis}"] for axis in "xyz"], axis=1).round(2).tolist()


def _results(table: pd.DataFrame) -> dict[str, list]:
    time = [None if np.isnan(t) else round(t, 1) for t in table.success_time]
    return {"success_time": time, "where": list(table["where"]), "how": list(table["how"])}


def _bins(
    title: str, unit: str, column: str, edges: Sequence[float], galleries: Mapping[str, EpisodeGallery]
) -> dict[str, Any]:
    """Success of every run in bins of a column; what lies beyond the last edge counts into the last bin."""
    runs = {}
    for name, gallery in galleries.items():
        at = np.clip(np.searchsorted(edges, gallery.table[column], side="right") - 1, 0, len(edges) - 2)
        solved = (gallery.table.outcome == "success").to_numpy()
        cells = []
        for k in range(len(edges) - 1):
            n, hits = int((at == k).sum()), int(solved[at == k].sum())
            lo, hi = wilson(hits, n)
            cells.append({"n": n, "rate": 100 * hits / n, "lo": 100 * lo, "hi": 100 * hi} if n else {"n": 0})
        runs[name] = cells
    return {"title": title, "unit": unit, "edges": edges, "runs": runs}


def _maps(tile: Tile, grids: Grids) -> dict[str, Any]:
    names = [
        f"floor {tile.storeys.index(k)}, {z:.1f} m" if k in tile.storeys else f"landings, {z:.1f} m"
        for k, z in enumerate(tile.layers)
    ]
    images = [_png(grids.label[k], grids.free[k]) for k in range(len(tile.layers))]
    return {"side": tile.side, "layers": tile.layers, "names": names, "images": images}


def _png(label: NDArray, free: NDArray) -> str:
    """Map of a layer, north up, as PNG in base64."""
    kinds = list(PALETTE)
    pixels = np.where(label < 0, kinds.index("nothing"), kinds.index("occupied")).astype(np.uint8)
    for kind, name in ((Label.GROUND, "ground"), (Label.STAIR, "stair"), (Label.RAMP, "ramp")):
        pixels[free & (label == kind)] = kinds.index(name)
    image = Image.fromarray(np.ascontiguousarray(pixels.T[::-1]), "P")
    image.putpalette(bytes(np.array(list(PALETTE.values()), np.uint8)), "RGBA")
    buffer = io.BytesIO()
    image.save(buffer, "PNG", optimize=True)
    return base64.b64encode(buffer.getvalue()).decode()


def _plain(column: pd.Series, decimals: int) -> list:
    return column.round(decimals).tolist() if column.dtype.kind == "f" else column.tolist()
