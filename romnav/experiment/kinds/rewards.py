"""The table of reward weights of a scale."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

from romnav.experiment.graph.stage import Session, Stage
from romnav.experiment.workspace import Workspace
from romnav.progress import Progress


def reports(work: Workspace, name: str, seeds: Sequence[int]) -> list[Stage]:
    """The tables of rewards that an experiment declares.

    Raises:
        RomnavError: There is no such experiment.
    """
    return [
        Stage(
            kind="rewards",
            name=f"table {table}",
            folder=work.folder / "tables",
            outputs=tuple(f"{table}.{format}" for format in ("tex", "md", "csv")),
            record=work.folder / "tables" / f"{table}.json",
            settings=work.settings,
            uses=("navigation.env.reward",),
            make=partial(_write, work, table),
        )
        for table in work.project.experiment(name).declared(name, {"rewards"}).tables
    ]


def _write(work: Workspace, table: str, stage: Stage, session: Session, progress: Progress) -> dict[str, Any]:
    from romnav.report import formats
    from romnav.report.rewards import tabulate

    formats.write(tabulate(table, work.scale, work.settings.navigation.env.reward), stage.folder)
    return {}
