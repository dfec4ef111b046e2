"""Tables of trials in scenes: the safety filter off and on, the paper's rows beside ours."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from romnav.evaluation.trials.rows import TrialRows
from romnav.evaluation.trials.statistics import (
    Difference,
    Event,
    Summary,
    closed_routes,
    difference,
    held_trials,
    summarise,
)
from romnav.report.formats import Block, Cell, Row, Table, number
from romnav.report.provenance import source, sources, training
from romnav.report.spec import Published
from romnav.world.scenes.scene import Scene

SHARED = 10
"""Trials of the paper in each set (Sec. IV-C); of ours, the first."""
ARMS = {False: "no CBF", True: "CBF"}
SCRIPTED = {"oracle": "Oracle (knows the map)", "straight": "Straight (sees nothing)"}


def safety(
    runs: Sequence[TrialRows], scenes: Sequence[Scene], labels: Mapping[str, str], published: Published | None = None
) -> Table:
    """Successes, collisions and time to goal in the obstacle sets; ``labels`` name the trained arms."""
    blocks = []
    for run in runs:
        rows = []
        for scene in scenes:
            for filtered, arm in ARMS.items():
                few, all_ = summarise(run, scene.name, filtered, SHARED), summarise(run, scene.name, filtered)
                cells = (*_counts(few), *_rates(all_), _share(all_.falls, all_.n))
                rows.append(Row(f"{scene.label}, {arm}", cells, _rows(run, "safety")))
            differences = (*_dashes(3), *_differences(run, scene.name), *_dashes(2))
            rows.append(Row(f"{scene.label}, CBF − no CBF", differences, _rows(run, "safety")))
        blocks.append(Block("ours", _title(run, labels), tuple(rows)))
    if published and published.safety:
        rows = []
        for scene in scenes:
            for filtered, arm in ARMS.items():
                p = published.safety.get(scene.name, {}).get("on" if filtered else "off")
                if p is None:
                    continue
                cells = (_of(p.successes, SHARED), _of(p.collisions, SHARED), _time(p.time, p.time_std, 1))
                rows.append(Row(f"{scene.label}, {arm}", (*cells, *_dashes(4))))
        blocks.append(Block("paper", f"{published.title} (hardware)", tuple(rows)))
    held = "; ".join(
        f"{_name(run, labels)} "
        + " and ".join(str(sum(len(of(run, scene.name)) for scene in scenes)) for of in (held_trials, closed_routes))
        for run in runs
    )
    trials = len(runs[0].of(scenes[0].name, False)["trial"])
    caption = (
        "Poisson safety filter (CBF) off and on with three sets of obstacles. Starts and goals are shared by all rows. "
        "Collision: trials in which the body, a cylinder of 0.26 m or the humanoid's, touches a solid; fell: trials "
        "that a fall of the humanoid ended (the cylinder cannot fall). Time to goal is mean ± standard deviation over "
        f"successes. The first {SHARED} trials are shown as in the paper, and all {trials} in percent "
        "with 95% Wilson intervals; differences are paired, with 95% bootstrap intervals († excludes zero). "
        "Trials that end with the filter holding the robot, and those of them that it solves untouched without it: "
        f"{held}."
    )
    provenance, note = _provenance(runs, "trials")
    return Table(
        name="safety",
        caption=f"{caption} {note}",
        spans=((f"{SHARED} trials", 3), (f"{trials} trials", 4)),
        header=(
            "Obstacles, filter",
            *("Success", "Collision", "Time (s)"),
            *("Success (%)", "Collision (%)", "Time (s)", "Fell (%)"),
        ),
        columns=("success_10", "collision_10", "time_10", "success", "collision", "time", "fell"),
        blocks=tuple(blocks),
        provenance=provenance,
    )


def deploy(
    runs: Sequence[TrialRows], scenes: Sequence[Scene], labels: Mapping[str, str], published: Published | None = None
) -> Table:
    """Successes, collisions, time and path in the deployments."""
    blocks = []
    for run in runs:
        rows = []
        for scene in scenes:
            for filtered, arm in ARMS.items():
                s = summarise(run, scene.name, filtered)
                last = (
                    number(s.path, 1, n=s.successes),
                    _share(s.brinks, s.n),
                    _share(s.falls, s.n),
                    _share(s.blocked, s.n) if filtered else number(math.nan, 1),
                )
                rows.append(Row(f"{scene.label}, {arm}", (*_rates(s), *last), _rows(run, "deploy")))
        blocks.append(Block("ours", _title(run, labels), tuple(rows)))
    if published and published.deploy:
        lengths = ((scene.label, published.deploy[scene.name]) for scene in scenes if scene.name in published.deploy)
        rows = [
            Row(label, (_of(1, 1), _of(0, 1), number(math.nan, 1), number(length, 0), *_dashes(3)))
            for label, length in lengths
        ]
        blocks.append(Block("paper", f"{published.title} (hardware, one trial each)", tuple(rows)))
    trials = len(runs[0].of(scenes[0].name, False)["trial"])
    caption = (
        f"The four long deployments, {trials} starts each, safety filter (CBF) off and on. Time to goal and path are "
        "over successes; collision: trials in which the body, a cylinder of 0.26 m or the humanoid's, touches a solid; "
        "brink: trials in which a drop-off stopped the cylinder, which cannot fall; fell: trials that a fall of the "
        "humanoid ended; blocked: trials that ended with the filter holding the robot. 95% Wilson intervals."
    )
    provenance, note = _provenance(runs, "trials")
    return Table(
        name="deploy",
        caption=f"{caption} {note}",
        spans=(),
        header=(
            "Deployment",
            "Success (%)",
            "Collision (%)",
            "Time (s)",
            "Path (m)",
            "Brink (%)",
            "Fell (%)",
            "Blocked (%)",
        ),
        columns=("success", "collision", "time", "path", "brink", "fell", "blocked"),
        blocks=tuple(blocks),
        provenance=provenance,
    )


def _rows(run: TrialRows, kind: str) -> tuple[Mapping[str, Any], ...]:
    return (source(f"{run.provenance.scale}/{run.arm}/seed-{run.seed}/{kind}.parquet", run.provenance),)


def _counts(s: Summary) -> tuple[Cell, ...]:
    return _of(s.successes, s.n), _of(s.collided, s.n), _time(s.time, s.time_std, s.successes)


def _rates(s: Summary) -> tuple[Cell, ...]:
    return (
        _share(s.successes, s.n, s.interval("success")),
        _share(s.collided, s.n, s.interval("collision")),
        _time(s.time, s.time_std, s.successes),
    )


def _differences(run: TrialRows, scene: str) -> tuple[Cell, ...]:
    events: tuple[Event, ...] = ("success", "collision")
    return tuple(_difference(difference(run, scene, event)) for event in events)


def _difference(d: Difference) -> Cell:
    cell = number(
        d.diff, 1, sign=True, dagger=d.lo > 0 or d.hi < 0,
        lo=d.lo, hi=d.hi, on_only=d.on_only, off_only=d.off_only, mid_p=d.mid_p,
    )  # fmt: skip
    interval = f" [{d.lo:+.1f}, {d.hi:+.1f}]" if math.isfinite(d.lo) else ""
    return Cell(cell.value, f"{cell.text}{interval}", cell.facts, dagger=cell.dagger)


def _of(count: float, n: int) -> Cell:
    return Cell(count, f"{count:.0f}/{n}", {"n": n})


def _share(count: int, n: int, interval: tuple[float, float] | None = None) -> Cell:
    percent = 100.0 * count / n
    if interval is None:
        return number(percent, 1, n=n)
    lo, hi = (100.0 * x for x in interval)
    return Cell(percent, f"{percent:.1f} [{lo:.1f}, {hi:.1f}]", {"lo": lo, "hi": hi, "n": n})


def _time(mean: float, std: float, n: int) -> Cell:
    if not math.isfinite(mean):
        return number(math.nan, 1)
    spread = f" ± {std:.1f}" if math.isfinite(std) else ""
    return Cell(mean, f"{mean:.1f}{spread}", {"std": std, "n": n})


def _dashes(count: int) -> tuple[Cell, ...]:
    return (number(math.nan, 1),) * count


def _name(run: TrialRows, labels: Mapping[str, str]) -> str:
    return labels.get(run.arm, SCRIPTED.get(run.arm, run.arm))


def _title(run: TrialRows, labels: Mapping[str, str]) -> str:
    seed = "" if run.arm in SCRIPTED else f", training seed {run.seed}"
    return f"This work, {run.provenance.scale} scale: {_name(run, labels)}{seed}"


def _provenance(runs: Sequence[TrialRows], what: str) -> tuple[dict[str, str], str]:
    """Provenance of the runs, and the end of the caption that states it."""
    files = [run.provenance for run in runs]
    facts, steps = sources(files), training(files)
    trained = f"training of {steps} steps; " if steps else ""
    return (
        facts,
        f"This work: {facts['scale']} scale, {trained}{what} {facts['episode_set']}; commit {facts['commit']}.",
    )
