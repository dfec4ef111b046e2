"""The report of a scale: everything that is recorded, on one page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from romnav.errors import NothingRecorded, RomnavError
from romnav.experiment.kinds import curves, tables, trials
from romnav.experiment.kinds.episodes import look_at
from romnav.experiment.spec import SCRIPTED
from romnav.experiment.workspace import Workspace

if TYPE_CHECKING:
    from romnav.report.curves import Curves
    from romnav.report.formats import Table
    from romnav.report.paired.gallery import EpisodeGallery


def write(work: Workspace, arms: Sequence[str], path: Path) -> list[str]:
    """Writes the page; its episodes are those of ``arms``, or of every arm that has tracks.

    Returns:
        What is missing on it, and how to make it.

    Raises:
        RomnavError: Nothing is recorded at the scale; an arm of ``arms`` has no episodes.
    """
    from romnav.report.page.render import Report, write

    notes: list[str] = []
    shown = [*_paired(work, notes), *_trials(work)]
    learnt = _curves(work, notes)
    shown += [table for experiment in learnt.values() for table in experiment[1]]
    galleries = _galleries(work, arms, notes)
    drawn = {title: runs for title, (runs, _) in learnt.items()}
    if not (shown or galleries or drawn):
        raise NothingRecorded(
            f"{work.folder}: nothing is recorded; run `romnav run ablation spawn-goal --scale {work.scale}`"
        )
    notes = [note.replace(f"{work.project.root}/", "") for note in notes]
    write(Report(work.scale, shown, drawn, galleries, notes), path)
    return notes


def _paired(work: Workspace, notes: list[str]) -> list[Table]:
    try:
        if found := tables.evaluated(work):
            return found
        notes.append("no tables of episodes: no two arms of an experiment have been evaluated; see `romnav list`")
    except RomnavError as error:
        notes.append(f"no tables of episodes: {error}")
    return []


def _trials(work: Workspace) -> list[Table]:
    experiments = work.project.experiments.items()
    reports = [(name, stage) for name, e in experiments for stage in trials.reports(work, name, e.seeds)]
    return [
        trials.tabulate(work, name, Path(stage.outputs[0]).stem, runs)
        for name, stage in reports
        if (runs := trials.recorded(stage))
    ]


def _curves(work: Workspace, notes: list[str]) -> dict[str, tuple[list[Curves], list[Table]]]:
    """Curves and their tables by the title of an experiment; one whose arms have all been shown is left out."""
    begun = {}
    for name, experiment in work.project.experiments.items():
        if experiment.kind == "ablation":
            policies = curves.policies(work, name, experiment.seeds)
            begun[name] = [run for run in policies if (run.folder / "curve.csv").exists()]
    found, shown = {}, set[str]()
    for name, runs in sorted(begun.items(), key=lambda item: -len(item[1])):
        experiment = work.project.experiments[name]
        if {run.name for run in runs} <= shown:
            continue
        done = curves.finished(runs)
        try:
            ended = curves.read(work, experiment, done)
            drawn = experiment.declared(name, {"curves"}).tables if done else ()
            made = [curves.tabulate(work, name, table, ended, done) for table in drawn]
            # the seeds of an arm make one curve, for which those that still train are too short: one may stand alone
            alone = {run.arm: run for run in reversed(runs) if run.arm not in ended}
            curved = [run for run in runs if run in done or run is alone.get(run.arm)]
            arms = curves.read(work, experiment, curved)
        except RomnavError as error:
            notes.append(f"no learning curves of {name}: {error}")
            continue
        notes += [f"no learning curve of {run.name}: its run has not ended" for run in runs if run not in curved]
        shown |= {run.name for run in runs}
        found[experiment.title] = (list(arms.values()), made)
    return found


def _galleries(work: Workspace, arms: Sequence[str], notes: list[str]) -> dict[str, EpisodeGallery]:
    """Episodes by arm, and by training seed where an arm has several."""
    places = []
    for file in sorted(work.folder.glob("*/seed-*/episodes.parquet")):
        arm, number = file.parts[-3], file.parts[-2].removeprefix("seed-")
        if number.isdecimal() and arm in work.project.arms:
            places.append((arm, int(number)))
        else:
            notes.append(f"no episodes of {file.parent}: no arm and training seed of an experiment")
    places.sort(key=lambda place: work.project.driver(place[0]) in SCRIPTED)
    for arm in arms:
        if arm not in {name for name, _ in places}:
            look_at(work, arm, 0)  # its error tells what to run
    found = {}
    for arm, seed in places:
        if arms and arm not in arms:
            continue
        several = sum(name == arm for name, _ in places) > 1
        try:
            found[f"{arm}, seed {seed}" if several else arm] = look_at(work, arm, seed)
        except RomnavError as error:
            notes.append(f"no episodes of {arm}: {error}")
    return found
