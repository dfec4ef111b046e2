"""The learning curves of an ablation, as a figure and a table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from romnav.errors import NothingRecorded
from romnav.experiment.graph import records
from romnav.experiment.graph.stage import Session, Stage
from romnav.experiment.kinds.policy import policy
from romnav.experiment.spec import Experiment
from romnav.experiment.workspace import Workspace
from romnav.progress import Progress

if TYPE_CHECKING:
    from romnav.report.curves import Curves
    from romnav.report.formats import Table


def reports(work: Workspace, name: str, seeds: Sequence[int]) -> list[Stage]:
    """The learning curves of an experiment, if it draws them.

    Raises:
        RomnavError: Its arms are invalid, or there are no such published results.
    """
    declared = work.project.experiment(name).declared(name, {"curves"})
    return [
        Stage(
            kind="curves",
            name=f"curves {table}",
            folder=work.folder,
            outputs=(f"figures/{table}.png", *(f"tables/{table}.{format}" for format in ("tex", "md", "csv"))),
            record=work.folder / "figures" / f"{table}.json",
            settings=declared,
            uses=("title", "labels", "tables"),
            make=partial(_draw, work, name, table),
            reads=work.project.published_files(name),
            upstream=policies(work, name, seeds),
        )
        for table in declared.tables
    ]


def _draw(work: Workspace, name: str, table: str, stage: Stage, session: Session, progress: Progress) -> dict[str, Any]:
    """Of the arms and training seeds that are there."""
    from romnav.report import curves, formats

    runs = finished(stage.upstream)
    if not runs:
        raise NothingRecorded(f"{stage.folder}: no arm of {name} is trained; run `romnav run ablation {name}`")
    arms = read(work, work.project.experiment(name), runs)
    curves.draw(arms, stage.folder / stage.outputs[0])
    formats.write(tabulate(work, name, table, arms, runs), stage.folder / "tables")
    return {}


def policies(work: Workspace, name: str, seeds: Sequence[int]) -> tuple[Stage, ...]:
    """The training runs of an experiment."""
    arms = work.project.experiment(name).arms.items()
    return tuple(policy(work, arm, seed) for arm, spec in arms if spec.trained for seed in seeds)


def finished(runs: Sequence[Stage]) -> list[Stage]:
    """Those training runs that came to their end."""
    return [run for run in runs if (record := records.read(run)) and record.outputs]


def read(work: Workspace, experiment: Experiment, runs: Sequence[Stage]) -> dict[str, Curves]:
    """The learning curves of training runs, by arm.

    Raises:
        RomnavError: A curve is unreadable, or those of an arm differ in length.
    """
    from romnav.report import curves

    arms = {}
    for arm, label in experiment.labels.items():
        if files := [run.folder / "curve.csv" for run in runs if run.arm == arm]:
            arms[arm] = curves.read(label, work.arm_settings(arm).navigation.encoder.unfreeze_at, files)
    return arms


def tabulate(work: Workspace, name: str, table: str, arms: Mapping[str, Curves], runs: Sequence[Stage]) -> Table:
    """A declared table of the arms of finished training runs."""
    from romnav.report import curves
    from romnav.report.provenance import distinct, short

    experiment = work.project.experiment(name)
    made = distinct(short(record.provenance["commit"]) for run in runs if (record := records.read(run)))
    provenance = {"scale": work.scale, "commit": made}
    sources = {arm: tuple(_source(run) for run in runs if run.arm == arm) for arm in arms}
    caption = experiment.tables[table].caption or f"{experiment.title}."
    return curves.tabulate(table, caption, arms, provenance, sources, work.project.published(name))


def _source(run: Stage) -> dict[str, Any]:
    record = records.read(run)
    file = "/".join((run.folder / "curve.csv").parts[-4:])
    return {"file": file, "spec_hash": run.key[:16], **(record.facts | record.provenance if record else {})}
