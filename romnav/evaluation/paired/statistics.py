"""Paired statistics of arms evaluated on the same episodes.

One resample of the episodes is shared by every arm, metric and contrast, so that what makes an episode hard
cancels in a difference. The resample is a matrix of counts, and the resampled sums of all quantities are its
product with the episodes' values: one matrix multiplication for every interval.
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from romnav.errors import RomnavError
from romnav.evaluation.intervals import mcnemar_mid_p, percentile_interval, resampled_sums
from romnav.evaluation.paired.metrics import LEVELS, Level, Metric, find, in_level, quantities
from romnav.evaluation.paired.rows import Arm
from romnav.evaluation.spec import HORIZONS

Cluster = Literal["episode", "tile"]
_DISJOINT: tuple[Level, ...] = ("same", "cross")


@dataclass(frozen=True)
class Estimate:
    """A metric with its percentile bootstrap interval, over n episodes; of very few there is none (NaN)."""

    value: float
    lo: float
    hi: float
    n: int


@dataclass(frozen=True)
class Contrast:
    """A metric of arm a minus that of arm b on the same episodes; rates in percentage points.

    Attributes:
        metric: Name of the metric.
        a_only: Episodes that only a counts in a rate, e.g. that only a solved; None where an arm has several training
            seeds, and of other metrics.
        b_only: Episodes that only b counts; None likewise.
        mid_p: McNemar mid-p value of the two; None likewise.
    """

    a: str
    b: str
    metric: str
    level: Level
    diff: float
    lo: float
    hi: float
    n: int
    a_only: int | None
    b_only: int | None
    mid_p: float | None

    @property
    def significant(self) -> bool:
        """Whether zero lies outside the interval (the dagger of the paper's tables)."""
        return self.lo > 0 or self.hi < 0


class Bootstrap:
    """Percentile bootstrap of arms over one shared resample of their episodes.

    Where an arm has several training seeds, its seeds are resampled too, independently of the episodes and of
    the other arms' seeds (crossed two-level bootstrap, Owen 2007). Draws depend only on ``seed`` and the arm.

    Args:
        arms: Arms on the same episodes, as ``rows.pair`` returns them.
        resamples: Number of resamples.
        seed: Seed of the resampling.
        cluster: Unit that is resampled. By episode compares with the paper; by tile allows for episodes of
            one tile being alike.
        confidence: Coverage of the intervals.
        outside: Names of metrics from outside that will be asked for.
    """

    def __init__(
        self,
        arms: Sequence[Arm],
        *,
        resamples: int = 10_000,
        seed: int = 0,
        cluster: Cluster = "episode",
        confidence: float = 0.95,
        outside: Collection[str] = (),
    ) -> None:
        if not arms:
            raise RomnavError("no arms to compare; evaluate at least one")
        self.arms = {arm.name: arm for arm in arms}
        self._confidence = confidence
        columns = arms[0].runs[0].columns
        self._masks: dict[Level, NDArray] = {level: in_level(columns, level) for level in LEVELS}
        self._units = {level: len(np.unique(columns[cluster][mask])) for level, mask in self._masks.items()}
        self._runs = [(arm.name, quantities(run.columns, outside)) for arm in arms for run in arm.runs]
        parts = [self._masks[level] for level in _DISJOINT]
        values = np.array([[[v * part for part in parts] for v in q.values()] for _, q in self._runs])
        order = np.argsort(columns[cluster], kind="stable")
        _, starts = np.unique(columns[cluster][order], return_index=True)
        per_unit = np.add.reduceat(values[..., order], starts, axis=-1)
        self._totals = per_unit.sum(axis=-1)  # (runs, quantities, disjoint levels)
        self._sums = resampled_sums(per_unit, resamples, seed)  # the same, resamples
        self._seed_weights = {arm.name: _seed_weights(arm, resamples, seed) for arm in arms}

    def metric(self, arm: str, metric: str, level: Level = "all") -> Estimate:
        """A metric by name for one arm, pooled over its training seeds."""
        value, draws = self._ratio(arm, find(metric), level)
        return Estimate(value, *self._interval(draws, level), n=int(self._masks[level].sum()))

    def contrast(self, a: str, b: str, metric: str = f"sr_{HORIZONS[-1]}", level: Level = "all") -> Contrast:
        """Difference of two arms in a metric."""
        m = find(metric)
        (value_a, draws_a), (value_b, draws_b) = self._ratio(a, m, level), self._ratio(b, m, level)
        interval, mask = self._interval(draws_a - draws_b, level), self._masks[level]
        a_only = b_only = mid_p = None
        if m.is_rate and len(self.arms[a].runs) == len(self.arms[b].runs) == 1:
            quantity = dict(self._runs)  # one run each
            counts_a, counts_b = (quantity[arm][m.numerator][mask] > 0 for arm in (a, b))
            a_only, b_only = int((counts_a & ~counts_b).sum()), int((counts_b & ~counts_a).sum())
            mid_p = mcnemar_mid_p(a_only, b_only)
        return Contrast(a, b, metric, level, value_a - value_b, *interval, int(mask.sum()), a_only, b_only, mid_p)

    def _ratio(self, arm: str, metric: Metric, level: Level) -> tuple[float, NDArray]:
        """The metric's value, and its value in every resample, shape (resamples,)."""
        runs = [k for k, (name, _) in enumerate(self._runs) if name == arm]
        levels = slice(None) if level == "all" else slice(k := _DISJOINT.index(level), k + 1)
        names = list(self._runs[0][1])
        value, draws = [], []
        for quantity in (names.index(metric.numerator), names.index(metric.denominator)):
            value.append(self._totals[runs, quantity, levels].sum())
            draws.append((self._sums[runs, quantity, levels].sum(axis=1) * self._seed_weights[arm]).sum(axis=0))
        with np.errstate(invalid="ignore", divide="ignore"):
            return float(metric.scale * value[0] / value[1]), metric.scale * draws[0] / draws[1]

    def _interval(self, draws: NDArray, level: Level) -> tuple[float, float]:
        return percentile_interval(draws, self._units[level], self._confidence)


def _seed_weights(arm: Arm, resamples: int, seed: int) -> NDArray:
    """How often each resample drew each training seed of an arm, shape (seeds, resamples)."""
    name = int.from_bytes(hashlib.sha256(arm.name.encode()).digest()[:4])
    stream = np.random.default_rng([seed, name])
    seeds = len(arm.runs)
    return stream.multinomial(seeds, np.full(seeds, 1 / seeds), size=resamples).T
