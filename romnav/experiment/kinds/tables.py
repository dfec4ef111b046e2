"""The tables of an ablation, from the episodes of its arms."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Any

from romnav.errors import NothingRecorded, RomnavError
from romnav.experiment.graph.stage import Session, Stage
from romnav.experiment.kinds.episodes import episodes
from romnav.experiment.spec import SCRIPTED, Declared, suggest
from romnav.experiment.workspace import Workspace
from romnav.progress import Progress
from romnav.report.spec import PAIRED

if TYPE_CHECKING:
    from romnav.report.formats import Table


def reports(work: Workspace, name: str, seeds: Sequence[int]) -> list[Stage]:
    """The tables of an experiment, if it has any.

    Raises:
        RomnavError: There is no such experiment, metric or file of published results, or its arms are invalid.
    """
    from romnav.report.paired.tables import known_metrics

    experiment = work.project.experiment(name)
    declared = experiment.declared(name, PAIRED)
    for table, spec in declared.tables.items():
        known = known_metrics(spec.kind)
        for column in spec.columns:
            if column.metric not in known and not column.outside:
                raise RomnavError(
                    f"{work.project.file(name)}: tables.{table}.columns: unknown metric {column.metric}"
                    f"{suggest(column.metric, known)}, see `romnav list metrics`"
                )
    if not declared.tables:
        return []
    arms = [(arm, seed) for arm in experiment.arms for seed in seeds]
    return [
        Stage(
            kind="tables",
            name=f"tables {name}",
            folder=work.folder / "tables",
            outputs=tuple(f"{table}.{format}" for table in declared.tables for format in ("tex", "md", "csv")),
            record=work.folder / "tables" / f"{name}.json",
            settings=declared,
            uses=("title", "labels", "tables"),
            make=partial(_write, work, name, declared),
            reads=work.project.published_files(name),
            upstream=tuple(episodes(work, arm, seed) for arm, seed in [*arms, *((arm, 0) for arm in SCRIPTED)]),
        )
    ]


def _write(
    work: Workspace, name: str, declared: Declared, stage: Stage, session: Session, progress: Progress
) -> dict[str, Any]:
    from romnav.evaluation.paired.statistics import Bootstrap
    from romnav.report import formats
    from romnav.report.paired import results, tables

    shown = [(str(above.arm), above.seed or 0) for above in stage.upstream]
    arms, published = results.load(work.project.results, work.scale, shown), work.project.published(name)
    bootstrap = Bootstrap(arms, outside=_outside(declared))
    built = []
    for table, spec in declared.tables.items():
        built.append(tables.build(table, spec, declared.title, bootstrap, published))
        progress(len(built), len(declared.tables), table)
    for made in built:  # all or none
        formats.write(made, stage.folder)
    return {}


def _outside(declared: Declared) -> list[str]:
    """Metrics from outside in the columns of tables."""
    columns = (c for table in declared.tables.values() for c in table.columns)
    return list(dict.fromkeys(c.outside for c in columns if c.outside))


def evaluated(work: Workspace) -> list[Table]:
    """Every declared table of which at least two arms were evaluated.

    Raises:
        RomnavError: Rows are unreadable or cannot be compared.
    """
    from romnav.evaluation.paired.statistics import Bootstrap
    from romnav.report.paired import results, tables

    built = []
    for name, experiment in work.project.experiments.items():
        declared, published = experiment.declared(name, PAIRED), work.project.published(name)
        runs = [*itertools.product(experiment.arms, experiment.seeds), *((arm, 0) for arm in SCRIPTED)]
        try:
            bootstrap = Bootstrap(results.load(work.project.results, work.scale, runs), outside=_outside(declared))
        except NothingRecorded:
            continue
        for table, spec in declared.tables.items():
            if len(tables.evaluated(spec, bootstrap)) < 2:
                continue
            with suppress(NothingRecorded):  # bounds alone
                built.append(tables.build(table, spec, declared.title, bootstrap, published))
    return built
