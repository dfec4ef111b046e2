from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from romnav.evaluation.trials.statistics import closed_routes, difference, held_trials, summarise


def test_summary_counts_the_rows(trial_run) -> None:
    run = trial_run("rom", n=50, skill=1.0)
    for first in (None, 20):
        s = summarise(run, "adversarial", True, first)
        c = {name: column[:first] for name, column in run.of("adversarial", True).items()}
        won = c["outcome"] == "success"
        assert (s.n, s.successes, s.collided) == (first or 50, won.sum(), (c["collisions"] > 0).sum())
        assert s.time == pytest.approx(np.nanmean(c["success_time"]))
        assert s.time_std == pytest.approx(stats.tstd(c["success_time"][won]))
        interval = stats.binomtest(s.collided, s.n).proportion_ci(method="wilson")
        assert s.interval("collision") == pytest.approx(tuple(interval))


def test_difference_is_paired(trial_run) -> None:
    run = trial_run("rom", n=200)
    d = difference(run, "adversarial", "collision")
    off, on = (run.of("adversarial", f)["collisions"] > 0 for f in (False, True))
    assert d.diff == pytest.approx(100 * (on.mean() - off.mean()))
    assert (d.on_only, d.off_only) == ((on & ~off).sum(), (off & ~on).sum())
    # a percentile interval of so many trials is nearly the normal one
    half = 1.96 * 100 * np.std(on.astype(float) - off) / np.sqrt(200)
    assert (d.hi - d.lo) / 2 == pytest.approx(half, rel=0.1)
    assert d.lo < d.diff < d.hi
    assert d.mid_p < 0.05


def test_closed_routes_are_those_solved_untouched_without_the_filter(trial_run) -> None:
    run = trial_run("rom", n=60)
    off, on = run.of("in-distribution", False), run.of("in-distribution", True)
    expected = [
        k for k in range(60) if on["blocked"][k] and off["outcome"][k] == "success" and off["collisions"][k] == 0
    ]
    assert 0 < len(expected) < on["blocked"].sum()
    assert closed_routes(run, "in-distribution").tolist() == expected
    assert held_trials(run, "in-distribution").tolist() == np.flatnonzero(on["blocked"]).tolist()


def test_nothing_to_average_is_nan(trial_run) -> None:
    s = summarise(trial_run("straight", skill=0.0), "adversarial", False)
    assert s.successes == 0
    assert np.isnan(s.time)
    assert np.isnan(s.time_std)
