"""Every evaluated arm and contrast of a scale, as plain data for scripts."""

from __future__ import annotations

import math
from collections.abc import Collection
from itertools import permutations
from pathlib import Path
from typing import Any

from romnav.errors import NothingRecorded, RomnavError
from romnav.evaluation.paired import metrics, rows
from romnav.evaluation.paired.statistics import Bootstrap
from romnav.evaluation.spec import HORIZONS

ROWS_FILE = "episodes.parquet"
METRICS = (
    *("sr_45", "sr_120", "sr_45_same", "sr_45_cross", "sr_120_same", "sr_120_cross"),
    *("t2g", "spl", "falls", "timeouts"),
)
"""Names of the metrics of an arm."""

Run = tuple[str, int]
"""An arm and one of its training seeds."""


def load(results_dir: Path, scale: str, runs: Collection[Run] | None = None) -> list[rows.Arm]:
    """Reads the rows of ``runs``, or of all of a scale: ``<results_dir>/<scale>/<arm>/seed-<n>/episodes.parquet``.

    Raises:
        RomnavError: There are none, one is unreadable, or they cannot be compared.
    """
    folder = results_dir / scale
    files = [
        file
        for file in sorted(folder.glob(f"*/seed-*/{ROWS_FILE}"))
        if (seed := file.parts[-2].removeprefix("seed-")).isdecimal()
        and (runs is None or (file.parts[-3], int(seed)) in runs)
    ]
    if not files:
        raise NothingRecorded(
            f"{folder}: no arm has been evaluated; run `romnav run ablation spawn-goal --scale {scale}`"
        )
    return rows.pair(_read_in_place(file, scale) for file in files)


def _read_in_place(file: Path, scale: str) -> rows.EpisodeRows:
    run = rows.read(file)
    holds = (run.provenance.scale, run.arm, f"seed-{run.seed}")
    if holds != (scale, *file.parts[-3:-1]):
        raise RomnavError(f"{file}: holds the rows of {'/'.join(holds)}; move it there or evaluate again")
    return run


def collect(results_dir: Path, scale: str, runs: Collection[Run] | None = None) -> dict[str, Any]:
    """What ``romnav results --json`` prints: metrics per arm and training seed, contrasts per ordered pair.

    Of ``runs`` alone, if they are given: rows of others, be they stale, do not matter then.

    Rates and differences are in percent, times in s, training in environment steps and hours; a value that
    does not exist (time to goal without a success) is None. Contrasts pool the training seeds of an arm; their interval
    is over episodes, and over tiles (tile_lo, tile_hi), whose episodes are alike; a_only and b_only count the episodes
    that one of two runs solves, mid_p is McNemar's.
    """
    arms = load(results_dir, scale, runs)
    bootstrap, by_tile = Bootstrap(arms), Bootstrap(arms, cluster="tile")
    return {
        "scale": scale,
        "episode_set": arms[0].runs[0].provenance.episode_set,
        "arms": [_arm(run) for arm in arms for run in arm.runs],
        "contrasts": [
            _contrast(bootstrap, by_tile, a.name, b.name, horizon, level)
            for a, b in permutations(arms, 2)
            for horizon in HORIZONS
            for level in metrics.LEVELS
        ],
    }


def _arm(run: rows.EpisodeRows) -> dict[str, Any]:
    found = {level: metrics.evaluate(run.columns, level) for level in metrics.LEVELS}
    values = {name: found[level][metric] for name in METRICS for metric, level in [metrics.split(name)]}
    return {
        "arm": run.arm,
        "seed": run.seed,
        "steps": run.provenance.steps,
        "hours": run.provenance.hours,
        **{name: _or_none(value) for name, value in values.items()},
    }


def _contrast(
    bootstrap: Bootstrap, by_tile: Bootstrap, a: str, b: str, horizon: int, level: metrics.Level
) -> dict[str, Any]:
    contrast, coarse = (draws.contrast(a, b, f"sr_{horizon}", level) for draws in (bootstrap, by_tile))
    return {
        "a": a,
        "b": b,
        "horizon": horizon,
        "level": level,
        **{name: _or_none(getattr(contrast, name)) for name in ("diff", "lo", "hi")},
        "n": contrast.n,
        "tile_lo": _or_none(coarse.lo),
        "tile_hi": _or_none(coarse.hi),
        "a_only": contrast.a_only,
        "b_only": contrast.b_only,
        "mid_p": contrast.mid_p,
    }


def _or_none(value: float) -> float | None:
    return value if math.isfinite(value) else None
