"""What trials tell: proportions with Wilson intervals, and paired differences between the filter on and off."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from romnav.evaluation.intervals import mcnemar_mid_p, percentile_interval, resampled_sums, wilson
from romnav.evaluation.trials.rows import TrialRows

Event = Literal["success", "collision"]


@dataclass(frozen=True)
class Summary:
    """Trials of one scene with the filter off or on."""

    n: int
    successes: int
    collided: int
    """Trials with a collision, whatever became of them."""
    time: float
    """Mean time to goal over successes, s; NaN without any."""
    time_std: float
    """Its sample standard deviation, s."""
    path: float
    """Mean length of path over successes, m."""
    brinks: int
    """Trials in which a drop-off stopped the robot."""
    falls: int
    """Trials that a fall ended."""
    blocked: int
    """Trials that ended with the filter holding the robot."""

    def interval(self, event: Event) -> tuple[float, float]:
        """Wilson interval of the share of an event, 95 %, in 0..1."""
        return wilson(self.successes if event == "success" else self.collided, self.n)


@dataclass(frozen=True)
class Difference:
    """Share of trials with an event, filter on minus off, in percentage points."""

    diff: float
    lo: float
    hi: float
    on_only: int
    """Trials with the event only when the filter was on."""
    off_only: int
    mid_p: float
    """McNemar mid-p value of the two."""


def summarise(rows: TrialRows, scene: str, filtered: bool, first: int | None = None) -> Summary:
    """The trials of a scene, or the ``first`` of them."""
    c = {name: column[:first] for name, column in rows.of(scene, filtered).items()}
    success = c["outcome"] == "success"
    time, path = c["success_time"][success], c["path_length"][success]
    return Summary(
        n=len(success),
        successes=int(success.sum()),
        collided=int((c["collisions"] > 0).sum()),
        time=float(time.mean()) if len(time) else np.nan,
        time_std=float(time.std(ddof=1)) if len(time) > 1 else np.nan,
        path=float(path.mean()) if len(path) else np.nan,
        brinks=int((c["brink_time"] > 0).sum()),
        falls=int((c["outcome"] == "fall").sum()),
        blocked=int(c["blocked"].sum()),
    )


def difference(rows: TrialRows, scene: str, event: Event, resamples: int = 10_000) -> Difference:
    """Paired difference of a scene's trials with a percentile bootstrap interval of 95 %."""
    off, on = (_happened(rows, scene, filtered, event) for filtered in (False, True))
    each = on.astype(float) - off
    draws = 100.0 * resampled_sums(each, resamples) / len(each)
    on_only, off_only = int((on & ~off).sum()), int((off & ~on).sum())
    return Difference(
        100.0 * float(each.mean()),
        *percentile_interval(draws, len(each)),
        on_only,
        off_only,
        mcnemar_mid_p(on_only, off_only),
    )


def held_trials(rows: TrialRows, scene: str) -> np.ndarray:
    """Trials that end with the filter holding the robot."""
    return np.flatnonzero(rows.of(scene, True)["blocked"])


def closed_routes(rows: TrialRows, scene: str) -> np.ndarray:
    """Trials that the filter took from the robot: held with it, solved untouched without it."""
    held, off = held_trials(rows, scene), rows.of(scene, False)
    return held[(off["outcome"][held] == "success") & (off["collisions"][held] == 0)]


def _happened(rows: TrialRows, scene: str, filtered: bool, event: Event) -> np.ndarray:
    c = rows.of(scene, filtered)
    return c["outcome"] == "success" if event == "success" else c["collisions"] > 0
