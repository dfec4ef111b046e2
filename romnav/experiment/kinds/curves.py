"""The learning curves of an ablation, as a figure and a table."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

from romnav.errors import NothingRecorded
from romnav.experiment.graph import records
from romnav.experiment.graph.stage import Session, Stage
from romnav.experiment.kinds.policy import policy
from romnav.experiment.workspace import Workspace
from romnav.progress import Progress


def reports(work: Workspace, name: str, seeds: Sequence[int]) -> list[Stage]:
    """The learning curves of an experiment, if it draws them.

    Raises:
        RomnavError: Its arms are invalid, or there are no such published results.
    """
    experiment = work.project.experiment(name)
    published = work.project.published(name)
    return [
        Stage(
            kind="curves",
            name=f"curves {table}",
            folder=work.folder,
            outputs=(f"figures/{table}.png", *(f"tables/{table}.{format}" for format in ("tex", "md", "csv"))),
            record=work.folder / "figures" / f"{table}.json",
            settings=experiment.declared(name, {"curves"}),
            uses=("title", "labels", "tables"),
            make=partial(_draw, work, name, table),
            reads=(published[0],) if published else (),
            upstream=tuple(
                policy(work, name, seed) for name, arm in experiment.arms.items() if not arm.policy for seed in seeds
            ),
        )
        for table in experiment.declared(name, {"curves"}).tables
    ]


def _draw(work: Workspace, name: str, table: str, stage: Stage, session: Session, progress: Progress) -> dict[str, Any]:
    """Of the arms and training seeds that are there."""
    from romnav.report import curves, formats

    experiment, published = work.project.experiment(name), work.project.published(name)
    arms, commits = {}, set()
    recorded = {run.name: records.read(run) for run in stage.upstream}
    finished = [run for run in stage.upstream if (record := recorded[run.name]) and record.outputs]
    for arm, label in experiment.labels.items():
        runs = [run for run in finished if run.arm == arm]
        if runs:
            unfreeze_at = work.arm_settings(arm).navigation.encoder.unfreeze_at
            arms[arm] = curves.read(label, unfreeze_at, [run.folder / "curve.csv" for run in runs])
        commits |= {record.provenance["commit"][:12] for run in runs if (record := recorded[run.name])}
    if not arms:
        raise NothingRecorded(f"{stage.folder}: no arm of {name} is trained; run `romnav run ablation {name}`")
    provenance = {"scale": work.scale, "commit": ", ".join(sorted(commits))}
    curves.draw(arms, stage.folder / stage.outputs[0])
    caption = experiment.tables[table].caption or f"{experiment.title}."
    made = curves.tabulate(table, caption, arms, provenance, published[1] if published else None)
    formats.write(made, stage.folder / "tables")
    return {}
