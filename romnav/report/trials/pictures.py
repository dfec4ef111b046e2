"""Pictures of trials in scenes: trajectories with the safety filter off and on, collisions marked."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon
from numpy.typing import NDArray

from romnav.evaluation.trials.rows import TrialRows
from romnav.evaluation.trials.statistics import closed_routes, held_trials, summarise
from romnav.report.pictures import project, render
from romnav.world.scenes.scene import Scene

SHOWN = 10
"""Trials shown of each obstacle set: those that the table counts as the paper does."""
DEPLOYED = 12
"""Trials shown of each deployment."""
VIEWS = {"lab": (-60.0, 50.0), "stairwell": (-60.0, 28.0), "entrance": (-65.0, 38.0), "outdoors": (-60.0, 48.0)}
"""Azimuth and elevation of the viewer, degrees."""
OFF, ON, HIT = "#1f6fb4", "#e07b00", "#c1121f"
SOLID, HANGING = "#7d8da3", "#c9b6d9"


def draw_safety(run: TrialRows, scenes: Sequence[Scene], path: Path) -> None:
    """Draw the shared trials of every obstacle set, filter off and on, and one that ends with the filter holding the
    robot, if any: rather one that it solves untouched without the filter."""
    figure = Figure(figsize=(4.1 * len(scenes), 11.2), layout="constrained")
    axes = figure.subplots(3, len(scenes), squeeze=False)
    for scene, column in zip(scenes, axes.T, strict=True):
        for filtered, ax in zip((False, True), column, strict=False):
            _draw_plan(ax, scene)
            for trial in range(min(SHOWN, len(run.of(scene.name, filtered)["trial"]))):
                _draw_trial(ax, run, scene.name, filtered, trial)
            s = summarise(run, scene.name, filtered, SHOWN)
            state = "CBF" if filtered else "no CBF"
            ax.set_title(
                f"{scene.label}, {state}: {s.successes}/{s.n} reached, {s.collided}/{s.n} collided", fontsize=9
            )
        closed, held, ax = closed_routes(run, scene.name), held_trials(run, scene.name), column[2]
        shown = int([*closed, *held][0]) if len(held) else None
        _draw_plan(ax, scene)
        if shown is not None:
            for filtered in (False, True):
                _draw_trial(ax, run, scene.name, filtered, shown)
        example = "" if shown is None else f"\n(trial {shown})"
        trials = summarise(run, scene.name, True).n
        ax.set_title(
            f"held by the CBF: {len(held)} of {trials}, {len(closed)} of them untouched without it{example}", fontsize=9
        )
    handles = [
        Line2D([], [], color=OFF, label="filter off"),
        Line2D([], [], color=ON, label="filter on"),
        Line2D([], [], color=HIT, marker="x", linestyle="", label="collision"),
        Line2D([], [], color="k", marker="o", markersize=4, linestyle="", label="start"),
        Line2D([], [], color="k", marker="o", markerfacecolor="none", linestyle="", label="goal"),
        Patch(color=SOLID, label="on the ground"),
        Patch(color=HANGING, label="off the ground"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False, fontsize=9)
    figure.suptitle(f"{run.arm}, {run.provenance.scale} scale")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)


def draw_deployments(run: TrialRows, scenes: Sequence[Scene], path: Path) -> None:
    """Draw every deployment in 3D with its first trajectories, filter off and on."""
    figure = Figure(figsize=(13.0, 10.4), layout="constrained")
    for ax, scene in zip(figure.subplots(2, 2).ravel(), scenes, strict=True):
        view = VIEWS[scene.name]
        ax.imshow(render(scene.tile, *view))
        for filtered, colour in ((False, OFF), (True, ON)):
            c = run.of(scene.name, filtered)
            for track, hits in zip(run.tracks(scene.name, filtered)[:DEPLOYED], c["hits"], strict=False):
                line = project(scene.tile, track, *view)
                ax.plot(*line.T, color=colour, linewidth=0.9, alpha=0.8)
                ax.plot(*line[hits].T, color=HIT, marker="x", markersize=5, linestyle="")
                ax.plot(*line[0], color="k", marker="o", markersize=2)
        goal = np.array([[c[f"goal_{axis}"][0] for axis in "xyz"]])
        ax.plot(*project(scene.tile, goal, *view)[0], color="k", marker="*", markersize=11, markerfacecolor="w")
        results = [summarise(run, scene.name, filtered) for filtered in (False, True)]
        rates = " / ".join(f"{s.successes}" for s in results), " / ".join(f"{s.collided}" for s in results)
        ax.set_title(f"{scene.label}: of {results[0].n}, {rates[0]} reached, {rates[1]} collided (filter off / on)")
        ax.set_axis_off()
    handles = [
        Line2D([], [], color=OFF, label="filter off"),
        Line2D([], [], color=ON, label="filter on"),
        Line2D([], [], color=HIT, marker="x", linestyle="", label="collision"),
        Line2D([], [], color="k", marker="*", markerfacecolor="w", linestyle="", label="goal"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)
    figure.suptitle(f"{run.arm}, {run.provenance.scale} scale; the first {DEPLOYED} trials")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)


def _draw_plan(ax: Axes, scene: Scene) -> None:
    """A one-storey scene from above."""
    solids = scene.tile.solids
    lowest = solids.bottom - np.abs(solids.slope_bottom) * solids.half[:, 0]
    for polygon, low, walkable in zip(solids.corners(), lowest, solids.walkable, strict=True):
        if not walkable:
            ax.add_patch(Polygon(polygon, color=HANGING if low > 0.3 else SOLID, linewidth=0))
    free = np.concatenate([polygon for polygon, w in zip(solids.corners(), solids.walkable, strict=True) if w])
    ax.set_xlim(free[:, 0].min(), free[:, 0].max())
    ax.set_ylim(free[:, 1].min(), free[:, 1].max())
    ax.set_aspect("equal")
    ax.tick_params(labelsize=7)


def _draw_trial(ax: Axes, run: TrialRows, scene: str, filtered: bool, trial: int) -> None:
    c = run.of(scene, filtered)
    track: NDArray[np.float64] = run.tracks(scene, filtered)[trial]
    ax.plot(*track[:, :2].T, color=ON if filtered else OFF, linewidth=1.0)
    ax.plot(*track[0, :2], color="k", marker="o", markersize=3)
    goal = c["goal_x"][trial], c["goal_y"][trial]
    ax.plot(*goal, color="k", marker="o", markersize=5, markerfacecolor="none")
    hits = c["hits"][trial]
    ax.plot(*track[hits, :2].T, color=HIT, marker="x", markersize=6, markeredgewidth=1.6, linestyle="")
