"""Success while training: the paper's learning-curve figure and a table of where the curves end."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from numpy.typing import NDArray

from romnav.errors import RomnavError
from romnav.evaluation.paired.statistics import Estimate
from romnav.report.formats import Block, Cell, Row, Table, literal, number
from romnav.report.lines import styles
from romnav.report.spec import Published

SHARE = 0.1
"""Part of the run over which success is averaged: a trailing window in the figure, the last one in the table."""
RESAMPLES = 10_000
NEEDED = ("iteration", "steps", "cpu_seconds", "episodes", "success")


@dataclass(frozen=True)
class Curves:
    """The learning curves of an arm, one per training seed."""

    label: str
    """Name in figure and table."""
    unfreeze_at: float
    """Share of the run after which the encoder is trained as well; 1 is never."""
    seeds: tuple[pd.DataFrame, ...]
    """``curve.csv`` of each seed, equally long."""

    @property
    def iterations(self) -> int:
        """Length of the runs."""
        return len(self.seeds[0])

    def successes(self) -> tuple[NDArray, NDArray]:
        """Successful and all episodes that finished in each iteration, each (seeds, iterations)."""
        episodes = np.array([run["episodes"].to_numpy() for run in self.seeds])
        rate = np.array([run["success"].to_numpy() for run in self.seeds])
        return np.where(episodes > 0, np.nan_to_num(rate) * episodes, 0.0), episodes

    def smooth(self) -> NDArray:
        """(seeds, iterations) success rate of the trailing window, percent; NaN where no episode finished."""
        window = _window(self.iterations)
        sums = []
        for values in self.successes():
            total = np.cumsum(np.pad(values, ((0, 0), (window, 0))), axis=1)
            sums.append(total[:, window:] - total[:, :-window])
        with np.errstate(invalid="ignore", divide="ignore"):
            return 100.0 * sums[0] / sums[1]

    def final(self) -> Estimate:
        """Success rate over the last window, percent, mean over seeds, with its two-level interval."""
        window = _window(self.iterations)
        success, episodes = (values[:, -window:].sum(axis=1) for values in self.successes())
        return two_level(success, episodes)

    def iteration_time(self, unfrozen: bool) -> float:
        """Median CPU time of an iteration with a frozen or a trained encoder, s; NaN if there is none."""
        switch = round(self.unfreeze_at * self.iterations)
        part = slice(switch, None) if unfrozen else slice(0, switch)
        spent = [np.diff(run["cpu_seconds"].to_numpy(), prepend=0.0)[part] for run in self.seeds]
        return float(np.median(np.concatenate(spent))) if spent[0].size else math.nan


def _window(iterations: int) -> int:
    return max(1, round(SHARE * iterations))


def read(label: str, unfreeze_at: float, files: Sequence[Path]) -> Curves:
    """The curves of an arm.

    Raises:
        RomnavError: A file is unreadable, or the runs differ in length.
    """
    seeds: list[pd.DataFrame] = []
    for file in files:
        try:
            run = pd.read_csv(file)
            run = run[list(NEEDED)].astype(float)
        except (OSError, ValueError, KeyError) as error:
            reason = str(error).strip('"')
            raise RomnavError(f"{file}: no learning curve ({reason}); train the arm again") from error
        if seeds and len(run) != len(seeds[0]):
            raise RomnavError(f"{file}: {len(run)} iterations, but {files[0]} has {len(seeds[0])}; train the arm again")
        seeds.append(run)
    return Curves(label, unfreeze_at, tuple(seeds))


def two_level(successes: NDArray, episodes: NDArray, confidence: float = 0.95, seed: int = 0) -> Estimate:
    """Mean over training seeds of a success rate, with its two-level percentile bootstrap interval.

    Seeds are drawn with replacement, and within each drawn seed its episodes.

    Args:
        successes: (seeds,) successful episodes.
        episodes: (seeds,) episodes.
        confidence: Coverage of the interval.
        seed: Seed of the resampling.

    Returns:
        Percent; ``n`` counts the episodes. NaN if a seed has none.
    """
    if (episodes == 0).any():
        return Estimate(math.nan, math.nan, math.nan, 0)
    rng = np.random.default_rng(seed)
    rate = successes / episodes
    drawn = rng.integers(len(rate), size=(RESAMPLES, len(rate)))
    resampled = rng.binomial(episodes[drawn].astype(int), rate[drawn]) / episodes[drawn]
    tails = (50 * (1 - confidence), 50 * (1 + confidence))
    lo, hi = np.percentile(100.0 * resampled.mean(axis=1), tails)
    return Estimate(100.0 * float(rate.mean()), float(lo), float(hi), int(episodes.sum()))


def draw(arms: Mapping[str, Curves], path: Path) -> None:
    """Draw mean and min-max band over seeds of every arm's success rate; save to ``path`` (type by its suffix)."""
    figure = Figure(figsize=(6.4, 3.9), layout="constrained")
    axes = figure.add_subplot()
    for curves, (colour, dashes) in zip(arms.values(), styles(), strict=False):
        rates = curves.smooth()
        iteration = np.arange(1, curves.iterations + 1)
        shown = np.isfinite(rates).all(axis=0)
        iteration, rates = iteration[shown], rates[:, shown]
        axes.fill_between(iteration, rates.min(axis=0), rates.max(axis=0), color=colour, alpha=0.2, linewidth=0)
        axes.plot(iteration, rates.mean(axis=0), color=colour, linestyle=dashes, label=literal(curves.label))
        if 0.0 < curves.unfreeze_at < 1.0:
            axes.axvline(round(curves.unfreeze_at * curves.iterations), color=colour, linestyle=":", linewidth=1)
    axes.set(xlabel="iteration", ylabel="success while training (%)", ylim=(0, None), xlim=(0, None))
    axes.grid(alpha=0.25)
    axes.legend(frameon=False, loc="upper left")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)


def tabulate(
    name: str,
    caption: str,
    arms: Mapping[str, Curves],
    provenance: dict[str, str],
    sources: Mapping[str, tuple[Mapping[str, Any], ...]],
    published: Published | None = None,
) -> Table:
    """Final success and iteration time of every arm, with what their runs come from; times are relative to the first
    arm's frozen iterations."""
    reference = next(iter(arms.values())).iteration_time(unfrozen=False)
    ours = tuple(Row(curves.label, _cells(curves, reference), sources[arm]) for arm, curves in arms.items())
    dash = number(math.nan, 1)
    known = {} if published is None else {arm: published.arms.get(arm, {}).get("iteration_time") for arm in arms}
    theirs = tuple(
        Row(arms[arm].label, (dash, dash, number(factor, 2))) for arm, factor in known.items() if factor is not None
    )
    first = next(iter(arms.values()))
    seeds = ", ".join(sorted({str(len(curves.seeds)) for curves in arms.values()}))
    steps = first.seeds[0]["steps"].iloc[-1] / 1e6
    caption = (
        f"{caption} Success rate while training over the last {SHARE:.0%} of the run, mean over training seeds, with "
        "its two-level 95% bootstrap interval (seeds, and episodes within a seed); median CPU time of an iteration "
        "while PPO trains the encoder, relative to one with a frozen encoder. "
        f"This work: {provenance['scale']} scale, {steps:.3g} M steps, training seeds per arm: {seeds}; "
        f"commit {provenance['commit']}."
    )
    blocks = [Block("ours", f"This work, {provenance['scale']} scale", ours)]
    if published and theirs:
        caption += f" {published.title}: as published, wall-clock time on a GPU."
        blocks.append(Block("paper", published.title, theirs))
    return Table(
        name,
        caption,
        (),
        ("Arm", "Success (%)", "95% interval", "Iteration time"),
        ("success", "interval", "iteration_time"),
        tuple(blocks),
        provenance,
    )


def _cells(curves: Curves, reference: float) -> tuple[Cell, ...]:
    final = curves.final()
    factor = curves.iteration_time(unfrozen=curves.unfreeze_at < 1.0) / reference
    shown = f"{final.lo:.1f} to {final.hi:.1f}" if math.isfinite(final.value) else "–"
    facts = {"lo": final.lo, "hi": final.hi, "n": final.n}
    return (
        Cell(final.value, number(final.value, 1).text, facts),
        Cell(final.hi - final.lo, shown, facts),
        number(factor, 2),
    )
