"""The page of a report: tables in HTML, everything else as data that its script draws."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from markupsafe import Markup

from romnav import __version__, files
from romnav.report.curves import Curves
from romnav.report.formats import Cell, Row, Table
from romnav.report.page import episodes
from romnav.report.paired.gallery import EpisodeGallery

POINTS = 150
"""Points of a learning curve."""
SCRIPTS = ("figures.js", "episodes.js", "replay.js")


@dataclass(frozen=True)
class Report:
    """What is recorded at a scale."""

    scale: str
    tables: Sequence[Table]
    curves: Mapping[str, Sequence[Curves]]
    """Arms by the title of their experiment."""
    galleries: Mapping[str, EpisodeGallery]
    """Evaluated runs with their tracks by name, all on the same episodes."""
    notes: Sequence[str] = ()
    """What is missing, and how to make it."""


def write(report: Report, path: Path) -> None:
    """Writes the report as one HTML file that needs no other.

    Raises:
        RomnavError: The file cannot be written.
    """
    origins: list[Mapping[str, Any]] = []

    def origin(row: Row) -> str:
        """Places of a row's sources in the page's list of them."""
        for source in row.sources:
            if source not in origins:
                origins.append(source)
        return " ".join(str(origins.index(source)) for source in row.sources)

    page = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    for row in (row for table in report.tables for block in table.blocks for row in block.rows):
        origin(row)
    data = {
        "sources": origins,
        "intervals": [column for table in report.tables for column in _intervals(table)],
        "curves": [_curves(title, arms) for title, arms in report.curves.items()],
        "bins": [],
        **(episodes.content(report.galleries) if report.galleries else {}),
    }
    text = page.from_string(_asset("page.html.j2")).render(
        scale=report.scale,
        version=__version__,
        tables=report.tables,
        notes=report.notes,
        has_curves=bool(report.curves),
        has_episodes=bool(report.galleries),
        origin=origin,
        facts=_facts,
        style=Markup(_asset("page.css")),
        data=Markup(_inline(data)),
        script=Markup("\n".join(map(_asset, SCRIPTS))),
    )
    files.write(path, text)


def _asset(name: str) -> str:
    return resources.files("romnav.report.page").joinpath(name).read_text("utf-8")


def _inline(data: Any) -> str:
    """JSON that may stand in a script element."""
    return json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")


def _facts(cell: Cell) -> str:
    known = {"value": cell.value, **cell.facts}
    return json.dumps({name: x for name, x in known.items() if x is not None and math.isfinite(x)})


def _intervals(table: Table) -> list[dict[str, Any]]:
    """The columns of a table that have intervals, each a figure."""
    spans = [f"{text}, " for text, width in table.spans for _ in range(width)] or [""] * len(table.columns)
    out = []
    for k in range(len(table.columns)):
        rows = [
            _interval(row, row.cells[k], block.source == "paper")
            for block in table.blocks
            for row in block.rows
            if math.isfinite(row.cells[k].value)
        ]
        if any(row["lo"] is not None for row in rows):
            out.append({"table": table.name, "title": spans[k] + table.header[k + 1], "rows": rows})
    return out


def _interval(row: Row, cell: Cell, paper: bool) -> dict[str, Any]:
    """A row of a figure; a column that shows intervals themselves has none around its values."""
    lo, hi = (x if (x := cell.facts.get(end)) is not None and math.isfinite(x) else None for end in ("lo", "hi"))
    if lo is None or hi is None or not lo <= cell.value <= hi:
        lo = hi = None
    return {"label": row.label, "paper": paper, "value": cell.value, "lo": lo, "hi": hi}


def _curves(title: str, arms: Sequence[Curves]) -> dict[str, Any]:
    return {
        "title": title,
        "arms": [{"label": arm.label, "seeds": [_thin(arm, k) for k in range(len(arm.seeds))]} for arm in arms],
    }


def _thin(arm: Curves, seed: int) -> dict[str, list]:
    shown = np.unique(np.linspace(0, arm.iterations - 1, POINTS).round().astype(int))
    success = arm.smooth()[seed, shown]
    return {
        "steps": (arm.seeds[seed]["steps"].to_numpy()[shown] / 1e6).round(4).tolist(),
        "success": [None if math.isnan(rate) else round(float(rate), 2) for rate in success],
    }
