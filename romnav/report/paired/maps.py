"""Maps of chosen episodes: where the robot went, on every layer, beside the shortest way."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from romnav.evaluation.episodes import EpisodeSet
from romnav.evaluation.tracks import Tracks
from romnav.report.pictures import draw_grid
from romnav.world.lookup import GeodesicLookup
from romnav.world.world import World

TRACK, SHORTEST = "#1f6fb4", "#7b3294"
SIZE = 3.6
"""Side of a map, inches."""


def draw_maps(
    world: World, episodes: EpisodeSet, tracks: Tracks, titles: Mapping[int, str], arm: str, path: Path
) -> None:
    """Draw the episodes of ``titles``, one row each, and save the figure to ``path`` (type by its suffix).

    A row has the layers that the robot, its start or its goal were on.
    """
    rows = [_layers(world, episodes, tracks, episode) for episode in titles]
    columns = max(map(len, rows))
    figure = Figure(figsize=(SIZE * columns, SIZE * len(rows) + 0.6), layout="constrained")
    grid = figure.subplots(len(rows), columns, squeeze=False)
    routes = shortest(world, episodes, list(titles))
    for axes_of, (episode, title), layers, route in zip(grid, titles.items(), rows, routes, strict=True):
        for axes, layer in zip(axes_of, layers, strict=False):
            _draw(axes, world, episodes, tracks, route, episode, layer)
        for axes in axes_of[len(layers) :]:
            axes.set_axis_off()
        axes_of[0].set_ylabel(title, fontsize=8)
    legend = "way (blue), shortest way (violet), start (dot), goal (star)"
    figure.suptitle(f"{arm} on {episodes.name}: {legend}", fontsize=9)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def _layers(world: World, episodes: EpisodeSet, tracks: Tracks, episode: int) -> list[int]:
    tile = world.tiles[episodes.columns["tile"][episode]]
    ends = [episodes.columns[f"{end}_z"][episode] for end in ("spawn", "goal")]
    heights = np.concatenate([tracks.position[tracks.of(episode), 2], ends])
    return sorted(set(_nearest(tile.layers, heights).tolist()))


def _nearest(layers: Sequence[float], height: NDArray) -> NDArray[np.intp]:
    return np.abs(np.asarray(height)[:, None] - np.asarray(layers)).argmin(axis=1)


def shortest(world: World, episodes: EpisodeSet, chosen: Sequence[int]) -> list[NDArray[np.float32]]:
    """Points (K, 3) of the shortest path of each chosen episode, m."""
    start, rows = episodes.start("cpu"), torch.tensor(chosen)
    return GeodesicLookup(world).routes(start.tile[rows], start.layer[rows], start.xy[rows], start.goal[rows])


def _draw(
    axes: Axes,
    world: World,
    episodes: EpisodeSet,
    tracks: Tracks,
    route: NDArray,
    episode: int,
    layer: int,
) -> None:
    c = episodes.columns
    index = c["tile"][episode]
    tile = world.tiles[index]
    draw_grid(axes, tile, world.grids[index], layer)
    for line, colour, style in ((route, SHORTEST, "--"), (tracks.position[tracks.of(episode)], TRACK, "-")):
        off = _nearest(tile.layers, line[:, 2]) != layer
        shown = np.where(off[:, None], np.nan, line[:, :2])
        axes.plot(*shown.T, color=colour, linestyle=style, linewidth=1.3)
    for end, marker in (("spawn", "o"), ("goal", "*")):
        if _nearest(tile.layers, c[f"{end}_z"][episode : episode + 1])[0] == layer:
            axes.plot(c[f"{end}_x"][episode], c[f"{end}_y"][episode], marker=marker, color="k", markersize=6)
