from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.stats

from romnav.evaluation.paired import metrics, rows
from romnav.evaluation.paired.statistics import Bootstrap


@pytest.fixture(scope="module")
def arms(episode_rows) -> list[rows.Arm]:
    skills = {"rom": 0.9, "uniform": 0.6, "nocap": 0.85}
    return rows.pair(episode_rows(arm, skill, n=512) for arm, skill in skills.items())


@pytest.fixture(scope="module")
def bootstrap(arms) -> Bootstrap:
    return Bootstrap(arms)


def scipy_interval(values: np.ndarray, statistic, seed: int) -> tuple[float, float]:
    """SciPy's percentile interval of a statistic of resampled episodes, values of shape (columns, n)."""
    result = scipy.stats.bootstrap(
        tuple(values),
        statistic,
        paired=True,
        vectorized=True,
        n_resamples=10_000,
        method="percentile",
        rng=np.random.default_rng(seed),
    )
    return result.confidence_interval.low, result.confidence_interval.high


@pytest.mark.parametrize("metric", ["sr_45", "t2g", "spl", "collisions"])
def test_metric_intervals_agree_with_scipy(bootstrap, arms, metric: str) -> None:
    m, q = metrics.METRICS[metric], metrics.quantities(arms[0].runs[0].columns)
    values = np.stack([q[m.numerator], q[m.denominator]])

    def statistic(num, den, axis):
        return m.scale * num.sum(axis) / den.sum(axis)

    theirs = np.array([scipy_interval(values, statistic, seed) for seed in range(3)])
    ours = bootstrap.metric("rom", metric)
    assert ours.value == pytest.approx(metrics.evaluate(arms[0].runs[0].columns)[metric], rel=1e-12)
    # Ten thousand resamples place a 2.5 % quantile within 0.7 % of the interval (one sigma).
    np.testing.assert_allclose([ours.lo, ours.hi], theirs.mean(axis=0), atol=0.04 * (ours.hi - ours.lo))


@pytest.mark.parametrize("level", ["all", "cross"])
def test_contrast_intervals_agree_with_scipy(bootstrap, arms, level) -> None:
    a, b = (arm.runs[0].columns for arm in arms[:2])
    mask = metrics.in_level(a, level)
    diff = 100 * ((a["success_time"] <= 120).astype(float) - (b["success_time"] <= 120))[mask]
    theirs = np.array([scipy_interval(diff[None], lambda x, axis: x.mean(axis), seed) for seed in range(3)])
    ours = bootstrap.contrast("rom", "uniform", "sr_120", level)
    assert (ours.diff, ours.n) == (pytest.approx(diff.mean()), mask.sum())
    np.testing.assert_allclose([ours.lo, ours.hi], theirs.mean(axis=0), atol=0.04 * (ours.hi - ours.lo))
    assert ours.significant == bool(theirs[0, 0] > 0)


def test_an_arm_does_not_differ_from_itself(bootstrap) -> None:
    c = bootstrap.contrast("rom", "rom", "sr_45")
    assert (c.diff, c.lo, c.hi, c.significant, c.mid_p) == (0, 0, 0, False, 1)


@pytest.mark.parametrize("level", ["all", "same", "cross"])
def test_contrasts_are_antisymmetric(bootstrap, level) -> None:
    ab, ba = bootstrap.contrast("rom", "nocap", "sr_120", level), bootstrap.contrast("nocap", "rom", "sr_120", level)
    assert (ab.diff, ab.lo, ab.hi) == pytest.approx((-ba.diff, -ba.hi, -ba.lo))
    assert (ab.a_only, ab.b_only, ab.mid_p, ab.n) == (ba.b_only, ba.a_only, ba.mid_p, ba.n)


def test_neither_the_order_of_rows_nor_of_arms_matters(bootstrap, arms) -> None:
    order = np.random.default_rng(1).permutation(512)
    shuffled = [
        rows.make({name: c[order] for name, c in run.columns.items()}, run.provenance)
        for arm in reversed(arms)
        for run in arm.runs
    ]
    again = Bootstrap(rows.pair(shuffled))
    assert again.metric("nocap", "spl") == bootstrap.metric("nocap", "spl")
    assert again.contrast("rom", "nocap") == bootstrap.contrast("rom", "nocap")


def test_discordant_episodes_are_counted(bootstrap, arms) -> None:
    a, b = (set(np.flatnonzero(arm.runs[0].columns["success_time"] <= 45)) for arm in arms[:2])
    c = bootstrap.contrast("rom", "uniform", "sr_45")
    assert (c.a_only, c.b_only) == (len(a - b), len(b - a))


def test_an_arm_without_success_has_no_time_to_goal(episode_rows) -> None:
    b = Bootstrap(rows.pair([episode_rows("never", 0.0), episode_rows("rom")]), resamples=100)
    t2g = b.metric("never", "t2g")
    assert all(math.isnan(x) for x in (t2g.value, t2g.lo, t2g.hi))
    assert b.metric("never", "sr_120").hi == 0


def test_tiles_as_units_widen_the_interval_of_alike_episodes(episode_rows) -> None:
    a, b = episode_rows("a", 1.0, n=512), episode_rows("b", 1.0, n=512)
    lost = a.columns["tile"] % 2 == 0  # the second arm loses whole tiles
    columns = {
        **b.columns,
        "success_time": np.where(lost, np.nan, a.columns["success_time"]),
        "outcome": np.where(lost, "fall", a.columns["outcome"]),
        "where": np.where(lost, rows.WHERE[0], a.columns["where"]),
        "how": np.where(lost, rows.HOW[0], a.columns["how"]),
    }
    pair = rows.pair([a, rows.make(columns, b.provenance)])
    by_episode, by_tile = (Bootstrap(pair, cluster=c).contrast("a", "b") for c in ("episode", "tile"))
    assert by_tile.diff == by_episode.diff
    # Eight wholly alike episodes a tile: the standard error grows by sqrt(8), less what differs within tiles.
    assert 1.5 < (by_tile.hi - by_tile.lo) / (by_episode.hi - by_episode.lo) < math.sqrt(8) * 1.05


def test_tile_interval_is_that_of_tile_sums(arms) -> None:
    c = arms[0].runs[0].columns
    hit = (c["success_time"] <= 120).astype(float)
    tiles = np.unique(c["tile"])
    sums = np.stack([[hit[c["tile"] == t].sum() for t in tiles], [(c["tile"] == t).sum() for t in tiles]])
    theirs = scipy_interval(sums, lambda s, n, axis: 100 * s.sum(axis) / n.sum(axis), 0)
    ours = Bootstrap(arms, cluster="tile").metric("rom", "sr_120")
    np.testing.assert_allclose([ours.lo, ours.hi], theirs, atol=0.06 * (theirs[1] - theirs[0]))


def test_training_seeds_are_resampled(episode_rows) -> None:
    skills = (0.95, 0.5, 0.2, 0.8)
    runs = [episode_rows("a", skill, seed=k, n=512) for k, skill in enumerate(skills)]
    b = Bootstrap(rows.pair([*runs, episode_rows("b", 0.6, n=512)]))
    rates = np.array([metrics.evaluate(run.columns)["sr_120"] for run in runs])
    a, c = b.metric("a", "sr_120"), b.contrast("a", "b")
    assert a.value == pytest.approx(rates.mean())
    # The spread between seeds dominates: the interval is close to that of the mean of four seeds.
    theirs = scipy_interval(rates[None], lambda x, axis: x.mean(axis), 0)
    np.testing.assert_allclose([a.lo, a.hi], theirs, atol=0.1 * (theirs[1] - theirs[0]))
    assert (c.a_only, c.b_only, c.mid_p) == (None, None, None)
    assert b.contrast("a", "a").hi == 0


@pytest.mark.parametrize(("episodes", "sure"), [(1, False), (5, False), (6, True), (64, True)])
def test_too_few_episodes_prove_nothing(episode_rows, episodes: int, sure: bool) -> None:
    """Five that agree have a chance of one in sixteen."""
    arms = rows.pair([episode_rows("a", 2.0, n=episodes), episode_rows("b", 0.0, n=episodes)])
    contrast = Bootstrap(arms).contrast("a", "b")
    assert contrast.diff == 100.0
    assert contrast.significant == sure
    assert np.isfinite(contrast.lo) == sure
