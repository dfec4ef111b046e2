"""Navigation metrics as ratios of sums over episodes.

Every metric is ``scale * sum(numerator) / sum(denominator)``: a mean over the episodes (success rate, SPL),
over the successes (time to goal) or over the metres walked (collisions). That makes one resample of the sums
a resample of every metric.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from romnav.evaluation import spec as specs
from romnav.evaluation.paired.rows import HOW, SUCCESS_RADIUS, WHERE
from romnav.evaluation.spec import HORIZONS

Level = Literal["all", "same", "cross"]
LEVELS: tuple[Level, ...] = ("all", "same", "cross")
Direction = Literal["higher", "lower"]
_PLACES = dict(zip(("no_stair", "on_stair", "on_level"), WHERE[1:], strict=True))


@dataclass(frozen=True)
class Metric:
    """A metric: ``scale * sum(numerator) / sum(denominator)``, both named quantities of an episode."""

    label: str
    """What tables call it."""
    definition: str
    """What it is, in a few words."""
    numerator: str
    denominator: str = "episodes"
    scale: float = 1.0
    unit: str = ""
    """Empty where it has none."""
    better: Direction = "higher"
    """Which values are the good ones."""
    decimals: int = 1
    """As many as tables show."""

    @property
    def is_rate(self) -> bool:
        """Whether it counts episodes, each of which has it or not."""
        return self.denominator == "episodes" and self.unit == "%"


class Measure(Protocol):
    """A metric from outside, with the attributes of a `Metric`."""

    label: str
    definition: str
    scale: float
    unit: str
    better: Direction
    decimals: int

    def numerator(self, columns: Mapping[str, NDArray]) -> NDArray:
        """What each episode adds to the sum above, of the shape of the columns."""
        ...

    def denominator(self, columns: Mapping[str, NDArray]) -> NDArray:
        """What each episode adds to the sum below."""
        ...


def _rate(label: str, definition: str, numerator: str, better: Direction = "higher") -> Metric:
    return Metric(label, definition, numerator, scale=100.0, unit="%", better=better)


METRICS: dict[str, Metric] = {
    **{f"sr_{h}": _rate(f"SR@{h}", f"success within {h} s", f"reached_{h}") for h in HORIZONS},
    "t2g": Metric(
        "T2G", "mean time to goal over successful episodes", "time_to_goal", "reached_120", unit="s", better="lower"
    ),
    "spl": Metric(
        "SPL", "success weighted by path length against the geodesic route (Anderson et al. 2018)", "spl", decimals=3
    ),
    "soft_spl": Metric(
        "SoftSPL", "progress weighted by path length against the geodesic route (Datta et al. 2020)", "soft_spl",
        decimals=3,
    ),
    "rmt": Metric(
        "RMT", f"mean time to goal, failures at {HORIZONS[-1]} s", "restricted_time", unit="s", better="lower"
    ),
    "falls": _rate("Falls", "episodes in which the robot fell", "falls", "lower"),
    "timeouts": _rate("Timeouts", "episodes whose time ran out", "timeouts", "lower"),
    "pressed": _rate("Pressed", "failures that touched something for half of the last 20 s", "pressed", "lower"),
    "stood": _rate("Stood", "failures that stayed within 1 m in the last 20 s", "stood", "lower"),
    "circled": _rate("Circled", "failures that walked round and round in the last 20 s", "circled", "lower"),
    "roamed": _rate("Roamed", "failures that walked elsewhere in the last 20 s", "roamed", "lower"),
    "no_stair": _rate("No stair", "failures across levels that never set foot on a stair", "no_stair", "lower"),
    "on_stair": _rate("On stair", "failures across levels that got onto a stair", "on_stair", "lower"),
    "on_level": _rate("On level", "failures across levels that got onto the goal's", "on_level", "lower"),
    "collisions": Metric(
        "Contact", "steps with contact per 100 m walked", "collisions", "path", 100.0, "per 100 m", "lower"
    ),
}  # fmt: skip
"""Every metric of paired episodes by name."""


def find(name: str) -> Metric:
    """The metric of a name, be it one of ``METRICS`` or from outside."""
    if name in METRICS:
        return METRICS[name]
    part = _load(name)
    sums = f"{name} numerator", f"{name} denominator"
    return Metric(part.label, part.definition, *sums, part.scale, part.unit, part.better, part.decimals)


@cache
def _load(name: str) -> Measure:
    part: Measure = specs.METRICS.load(name)
    return part


def split(name: str) -> tuple[str, Level]:
    """Metric and level of a name: "sr_120" is of all episodes, "sr_120_cross" of those across levels."""
    metric, _, level = name.rpartition("_")
    return (metric, level) if level in ("same", "cross") else (name, "all")  # type: ignore[return-value]


def quantities(columns: Mapping[str, NDArray], outside: Iterable[str] = ()) -> dict[str, NDArray]:
    """What each episode adds to the sums of the metrics.

    Args:
        columns: Columns of episode rows, of one common shape.
        outside: Names of metrics from outside.

    Returns:
        Name to array of that shape.
    """
    time = columns["success_time"]
    reached = {horizon: (time <= horizon).astype(float) for horizon in HORIZONS}
    geodesic, path = columns["geodesic"], columns["path_length"]
    longest = np.maximum(geodesic, path)
    efficiency = np.divide(geodesic, longest, out=np.ones_like(longest), where=longest > 0)
    # A goal inside the success radius leaves no progress to divide by.
    progress = np.clip(1 - columns["final_distance"] / np.maximum(geodesic, SUCCESS_RADIUS), 0, None)
    return {
        "episodes": np.ones_like(time),
        **{f"reached_{horizon}": hit for horizon, hit in reached.items()},
        "time_to_goal": np.nan_to_num(time, nan=0.0),
        "restricted_time": np.nan_to_num(time, nan=HORIZONS[-1]),
        "spl": reached[HORIZONS[-1]] * efficiency,
        "soft_spl": progress * efficiency,
        "falls": (columns["outcome"] == "fall").astype(float),
        "timeouts": (columns["outcome"] == "timeout").astype(float),
        **{how: (columns["how"] == how).astype(float) for how in HOW[1:]},
        **{name: (columns["where"] == where).astype(float) for name, where in _PLACES.items()},
        "collisions": columns["collisions"].astype(float),
        "path": path,
        **{f"{name} numerator": np.asarray(_load(name).numerator(columns), float) for name in outside},
        **{f"{name} denominator": np.asarray(_load(name).denominator(columns), float) for name in outside},
    }


def in_level(columns: Mapping[str, NDArray], level: Level) -> NDArray:
    """Mask of the episodes whose goal lies on the spawn's level, on another, or of all."""
    return np.ones(columns["level"].shape, bool) if level == "all" else columns["level"] == level


def evaluate(columns: Mapping[str, NDArray], level: Level = "all") -> dict[str, float]:
    """Every metric of ``METRICS`` over the episodes of a level; NaN where there is nothing to average."""
    mask = in_level(columns, level)
    sums = {name: float(values[mask].sum()) for name, values in quantities(columns).items()}
    return {name: ratio(metric, sums) for name, metric in METRICS.items()}


def ratio(metric: Metric, sums: Mapping[str, float]) -> float:
    """A metric from the sums of the quantities; NaN where the denominator is zero."""
    denominator = sums[metric.denominator]
    return metric.scale * sums[metric.numerator] / denominator if denominator else float("nan")
