"""The learning curves of an ablation, as a figure and a table."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from romnav.errors import NothingRecorded
from romnav.experiment.graph import records
from romnav.experiment.graph.stage import Session, Stage
from romnav.experiment.kinds.policy import policy
from romnav.experiment.spec import Experiment
from romnav.experiment.workspace import Workspace
from romnav.progress import Progress


def reports(work: Workspace, name: str, seeds: Sequence[int]) -> list[Stage]:
    """The learning curves of an experiment, if it draws them."""
    experiment = work.project.experiment(name)
    if not experiment.curves:
        return []
    return [
        Stage(
            kind="curves",
            name=f"curves {name}",
            folder=work.folder,
            outputs=(f"figures/{name}.png", *(f"tables/{name}.{format}" for format in ("tex", "md", "csv"))),
            record=work.folder / "figures" / f"{name}.json",
            settings=experiment,
            uses=("title", "labels"),
            make=partial(_draw, work, experiment),
            upstream=tuple(
                policy(work, name, seed) for name, arm in experiment.arms.items() if arm.trained for seed in seeds
            ),
        )
    ]


def _draw(
    work: Workspace, experiment: Experiment, stage: Stage, session: Session, progress: Progress
) -> dict[str, Any]:
    """Of the arms and training seeds that are there."""
    from romnav.report import curves, formats

    name = Path(stage.outputs[0]).stem
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
    formats.write(curves.tabulate(name, experiment.title, arms, provenance), stage.folder / "tables")
    return {}
