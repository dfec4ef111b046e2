"""Progress along a run: success of the policies kept on the way, one row each."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from romnav.errors import RomnavError
from romnav.evaluation.episodes import EpisodeSet
from romnav.evaluation.paired.failures import classify
from romnav.evaluation.paired.metrics import LEVELS, evaluate
from romnav.evaluation.paired.run import run
from romnav.evaluation.rollout import Driver
from romnav.evaluation.rowfile import check_record
from romnav.evaluation.spec import EvaluationSpec
from romnav.evaluation.tracks import Recorder
from romnav.navigation.spec import EnvSpec
from romnav.progress import Progress
from romnav.robot.dynamics import Body
from romnav.world.world import STOREY, World

COLUMNS = (
    *("policy", "conditions", "iteration", "steps", "hours"),
    *(f"sr_{horizon}_{level}" for horizon in (45, 120) for level in (*LEVELS, "storey")),
    *("spl", "t2g"),
)
"""Digests of the policy and of what it was judged by, place in the run, success rates in percent by level and over
climbs of a storey or more, SPL, and time to goal in s."""


def judge(
    driver: Driver,
    world: World,
    episodes: EpisodeSet,
    env: EnvSpec,
    spec: EvaluationSpec,
    progress: Progress,
    body: Body,
) -> dict[str, float]:
    """The `row` of a driver, which walks all ``episodes`` as `romnav.evaluation.paired.run` has it."""
    recorder = Recorder()
    measured = run(driver, world, episodes, env, spec, progress, body, recorder)
    walked = {**episodes.columns, "level": np.where(episodes.cross, "cross", "same"), **measured}
    where, how = classify(recorder.tracks(len(episodes)), walked, world, env.period)
    return row({**walked, "where": where, "how": how})


def row(columns: Mapping[str, NDArray]) -> dict[str, float]:
    """What the episode rows of a kept policy say, from ``sr_45_all`` on."""
    climbs = np.abs(columns["goal_z"] - columns["spawn_z"]) >= STOREY
    by_level: dict[str, dict[str, float]] = {level: evaluate(columns, level) for level in LEVELS}
    by_level["storey"] = evaluate({name: values[climbs] for name, values in columns.items()})
    rates = {f"sr_{h}_{level}": values[f"sr_{h}"] for level, values in by_level.items() for h in (45, 120)}
    return rates | {name: by_level["all"][name] for name in ("spl", "t2g")}


def read(path: Path) -> list[dict[str, str]]:
    """Rows of an earlier judgement, at least one, by `COLUMNS`: whole numbers, numbers or NaN but for the digests.

    Raises:
        RomnavError: The file cannot be read, is damaged, or is not what the record beside it tells of.
    """
    again = "judge the kept policies again"
    check_record(path, again)
    try:
        text = path.read_text("utf-8")
        reader = csv.DictReader(io.StringIO(text))
        rows = list(reader)
        if tuple(reader.fieldnames or ()) != COLUMNS:
            raise ValueError("the first line does not name its columns")
        if not rows or not text.endswith("\n"):
            raise ValueError("truncated")
        for number, row in enumerate(rows, 1):
            _check(row, number)
    except (OSError, ValueError, csv.Error) as error:
        raise RomnavError(f"{path}: damaged ({error}); restore it, or delete it and {again}") from error
    return rows


def _check(row: Mapping[str | None, str | None], number: int) -> None:
    if None in row:
        raise ValueError(f"row {number} has more values than columns")
    for column in COLUMNS:
        value = row[column]
        if not value:
            raise ValueError(f"row {number} has no {column}")
        try:
            if column not in ("policy", "conditions"):
                (int if column == "iteration" else float)(value)
        except ValueError:
            raise ValueError(f"row {number}: {column} is {value}, no number") from None
