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
STEP = 0.1
"""Spacing of the points of a shortest way, m."""
SIZE = 3.6
"""Side of a map, inches."""


def draw_maps(
    world: World, episodes: EpisodeSet, tracks: Tracks, titles: Mapping[int, str], arm: str, path: Path
) -> None:
    """Draw the episodes of ``titles``, one row each, and save the figure to ``path`` (type by its suffix).

    A row has the layers that the robot, its start or its goal were on.
    """
    lookup = GeodesicLookup(world)
    rows = [_layers(world, episodes, tracks, episode) for episode in titles]
    columns = max(map(len, rows))
    figure = Figure(figsize=(SIZE * columns, SIZE * len(rows) + 0.6), layout="constrained")
    grid = figure.subplots(len(rows), columns, squeeze=False)
    for axes_of, (episode, title), layers in zip(grid, titles.items(), rows, strict=True):
        shortest = _shortest(world, lookup, episodes, episode)
        for axes, layer in zip(axes_of, layers, strict=False):
            _draw(axes, world, episodes, tracks, shortest, episode, layer)
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


def _shortest(world: World, lookup: GeodesicLookup, episodes: EpisodeSet, episode: int) -> NDArray:
    """(N, 3) points of the shortest way of an episode, m."""
    start = episodes.start("cpu")
    tile, layer, xy, goal = (getattr(start, name)[episode : episode + 1] for name in ("tile", "layer", "xy", "goal"))
    points = []
    for _ in range(round(1.2 * float(episodes.columns["geodesic"][episode]) / STEP) + 1):
        points.append([*xy[0].tolist(), float(world.surface(tile, layer, xy))])
        distance, direction = lookup(tile, layer, xy, goal)
        if distance < STEP:
            break
        ahead = xy + STEP * direction
        node = world.node_at(tile, layer, ahead)
        layer = torch.where(node >= 0, world.layer[node], layer)
        xy = ahead
    return np.array(points)


def _draw(
    axes: Axes,
    world: World,
    episodes: EpisodeSet,
    tracks: Tracks,
    shortest: NDArray,
    episode: int,
    layer: int,
) -> None:
    c = episodes.columns
    index = c["tile"][episode]
    tile = world.tiles[index]
    draw_grid(axes, tile, world.grids[index], layer)
    for line, colour, style in ((shortest, SHORTEST, "--"), (tracks.position[tracks.of(episode)], TRACK, "-")):
        off = _nearest(tile.layers, line[:, 2]) != layer
        shown = np.where(off[:, None], np.nan, line[:, :2])
        axes.plot(*shown.T, color=colour, linestyle=style, linewidth=1.3)
    for end, marker in (("spawn", "o"), ("goal", "*")):
        if _nearest(tile.layers, c[f"{end}_z"][episode : episode + 1])[0] == layer:
            axes.plot(c[f"{end}_x"][episode], c[f"{end}_y"][episode], marker=marker, color="k", markersize=6)
