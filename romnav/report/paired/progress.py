"""Success of the policies kept along the runs of an experiment, over steps and over CPU time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from romnav.report.formats import literal
from romnav.report.lines import styles

PANELS = (
    ("steps", "sr_120_same", "same level, 120 s"),
    ("steps", "sr_120_cross", "across levels, 120 s"),
    ("hours", "sr_120_all", "all, 120 s"),
)


def slope(runs: Sequence[pd.DataFrame], rate: str) -> float:
    """Points of ``rate`` that a doubling of the steps gives, by least squares with an intercept for each run.

    Args:
        runs: Rows of ``kept.csv``, one table a training seed.
        rate: Column of success.

    Returns:
        The gain; NaN where no run has two policies.
    """
    x, y = (
        np.concatenate([values - values.mean() for values in columns])
        for columns in ([np.log2(run["steps"].to_numpy(float)) for run in runs], [run[rate] for run in runs])
    )
    return float(x @ y / (x @ x)) if x.any() else float("nan")


def draw(arms: Mapping[str, Sequence[pd.DataFrame]], path: Path) -> None:
    """Draw success against steps and hours of every arm, a line for each seed, with its gain per doubling of the steps.

    Args:
        arms: Rows of ``kept.csv``, one table a training seed, by label.
        path: Figure; its suffix names the format.
    """
    figure = Figure(figsize=(10.0, 3.2 + 0.16 * len(arms)), layout="constrained")
    axes = np.atleast_1d(figure.subplots(1, len(PANELS)))
    for panel, (over, column, title) in zip(axes, PANELS, strict=True):
        for (label, runs), (colour, dashes) in zip(arms.items(), styles(), strict=False):
            gain = slope(runs, column)
            told = label if np.isnan(gain) else f"{label} ({gain:+.1f} a doubling)"
            for run in runs:
                x = run["steps"] / 1e6 if over == "steps" else run[over]
                (line,) = panel.plot(x, run[column], color=colour, linestyle=dashes, marker="o", markersize=3)
            line.set_label(literal(told))
        panel.set_title(title, fontsize=9)
        _finish(panel, "million steps" if over == "steps" else "hours of training")
    axes[0].set_ylabel("success on the episodes for choices (%)")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)


def _finish(panel: Axes, over: str) -> None:
    panel.set_xscale("log", base=2)
    panel.xaxis.set_major_formatter("{x:g}")
    panel.set_xlabel(over)
    panel.grid(alpha=0.25)
    panel.legend(frameon=False, fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.14))
