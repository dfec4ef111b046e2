"""The tables of an ablation, from the episodes of its arms."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

from romnav.errors import RomnavError
from romnav.experiment.graph.stage import Session, Stage
from romnav.experiment.kinds.episodes import episodes
from romnav.experiment.spec import SCRIPTED, suggest
from romnav.experiment.workspace import Workspace
from romnav.progress import Progress


def reports(work: Workspace, name: str, seeds: Sequence[int]) -> list[Stage]:
    """The tables of an experiment, if it has any.

    Raises:
        RomnavError: There is no such experiment or table, or its arms are invalid.
    """
    from romnav.report.paired.tables import SPECS

    experiment = work.project.experiment(name)
    known = {spec.name for spec in SPECS}
    for table in experiment.tables:
        if table not in known:
            raise RomnavError(f"{work.project.file(name)}: tables: unknown table {table}{suggest(table, known)}")
    if not experiment.tables:
        return []
    arms = [(arm, seed) for arm in experiment.arms for seed in seeds]
    return [
        Stage(
            kind="tables",
            name=f"tables {name}",
            folder=work.folder / "tables",
            outputs=tuple(f"{table}.{format}" for table in experiment.tables for format in ("tex", "md", "csv")),
            record=work.folder / "tables" / f"{name}.json",
            settings=experiment,
            uses=("tables",),
            make=partial(_write, work, experiment.tables),
            upstream=tuple(episodes(work, arm, seed) for arm, seed in [*arms, *((arm, 0) for arm in SCRIPTED)]),
        )
    ]


def _write(work: Workspace, names: Sequence[str], stage: Stage, session: Session, progress: Progress) -> dict[str, Any]:
    from romnav.evaluation.paired.statistics import Bootstrap
    from romnav.report import formats
    from romnav.report.paired import results, tables

    bootstrap = Bootstrap(results.load(work.project.results, work.scale))
    specs = {spec.name: spec for spec in tables.SPECS}
    built = []
    for name in names:
        built.append(tables.build(specs[name], bootstrap))
        progress(len(built), len(names), name)
    for table in built:  # all or none
        formats.write(table, stage.folder)
    return {}
