"""Picture of how far and how high the goals of each sampler lie."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from romnav.evaluation.difficulty import Goals
from romnav.world.world import STOREY, TWO_STOREYS

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7")
DASHES = ("-", "--", ":")
LENGTH, CLIMB = 2.0, 0.5
"""Widths of the bins, m."""
CAP = 30.0
"""The paper's geodesic cap, m."""


def draw_difficulty(goals: Mapping[str, Goals], path: Path) -> None:
    """Draw histograms of shortest paths on one level and across levels, and of climbs, and save them to ``path``.

    Each is a share of all goals of its sampler, so that panels compare; samplers that draw the same share a line.
    """
    figure = Figure(figsize=(11.0, 3.2), layout="constrained")
    same, cross, climb = figure.subplots(1, 3)
    alike: dict[bytes, list[str]] = {}
    for name, drawn in goals.items():
        alike.setdefault(drawn.geodesic.tobytes(), []).append(name)
    for k, names in enumerate(alike.values()):
        drawn = goals[names[0]]
        colour, dashes = COLOURS[k % len(COLOURS)], DASHES[k // len(COLOURS) % len(DASHES)]
        for axes, values, width in (
            (same, drawn.geodesic[~drawn.cross], LENGTH),
            (cross, drawn.geodesic[drawn.cross], LENGTH),
            (climb, drawn.climb[drawn.cross], CLIMB),
        ):
            edges = np.arange(0.0, max(float(values.max(initial=0.0)), width) + width, width)
            share = np.histogram(values, edges)[0] / len(drawn.cross)
            axes.stairs(share, edges, color=colour, linestyle=dashes, label=", ".join(names))
    for axes in (same, cross):
        axes.axvline(CAP, color="0.6", linewidth=0.8)
    for height in (STOREY, TWO_STOREYS):
        climb.axvline(height, color="0.6", linewidth=0.8)
    for axes, title, label in (
        (same, "one level", "shortest path, m"),
        (cross, "across levels", "shortest path, m"),
        (climb, "across levels", "climb, m"),
    ):
        axes.set(title=title, xlabel=label, xlim=(0.0, None), ylim=(0.0, None))
    same.set_ylabel("share of goals")
    handles, labels = same.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=max(len(labels), 1), frameon=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)
