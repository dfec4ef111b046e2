"""A table as data, and its LaTeX (booktabs), Markdown and CSV."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from romnav import files


@dataclass(frozen=True)
class Cell:
    """A number in a table and as it is shown (NaN is a dash); facts behind it go to the CSV alone."""

    value: float
    text: str
    facts: Mapping[str, float | None] = field(default_factory=dict)
    bold: bool = False
    dagger: bool = False


def number(value: float, decimals: int, *, sign: bool = False, dagger: bool = False, **facts: float | None) -> Cell:
    """A cell that shows a value rounded to some decimals, without negative zero."""
    shown = round(value, decimals) + 0.0
    text = f"{shown:{'+' if sign else ''}.{decimals}f}" if math.isfinite(value) else "–"
    return Cell(value, text, facts, dagger=dagger)


def literal(text: str) -> str:
    """Text that matplotlib shows as it is: a dollar is no formula."""
    return text.replace("$", r"\$")


@dataclass(frozen=True)
class Row:
    """A labelled row of numbers, and the files that they are made of with their provenance, for the report."""

    label: str
    cells: tuple[Cell, ...]
    sources: tuple[Mapping[str, Any], ...] = ()


@dataclass(frozen=True)
class Block:
    """Rows of one source ("ours" or "paper"), set apart from those before; a title opens a group."""

    source: str
    title: str
    rows: tuple[Row, ...]


@dataclass(frozen=True)
class Table:
    """A table, its text in plain Unicode.

    Attributes:
        spans: Headers over several columns as (text, number of columns); empty for none.
        header: Headers of the label column and of every other column.
        columns: Unique keys of the columns but the first, for CSV.
        provenance: Scale, commit and episode set of our rows.
    """

    name: str
    caption: str
    spans: tuple[tuple[str, int], ...]
    header: tuple[str, ...]
    columns: tuple[str, ...]
    blocks: tuple[Block, ...]
    provenance: dict[str, str]


_TEX = {
    "\\": r"\textbackslash{}",
    **{character: f"\\{character}" for character in "&%$#_{}"},
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "†": r"$\dagger$",
    "‡": r"$\ddagger$",
    "−": "$-$",
    "–": "--",
    "±": r"$\pm$",
}


def latex(table: Table) -> str:
    """A LaTeX ``table`` environment in the paper's style; needs the package booktabs."""
    if table.spans:
        columns = r"@{\hspace{1.1em}}".join("c" * width for _, width in table.spans)
        over = "".join(rf" & \multicolumn{{{width}}}{{c}}{{{_tex(text)}}}" for text, width in table.spans)
        ends = [1 + sum(width for _, width in table.spans[: k + 1]) for k in range(len(table.spans))]
        rules = "".join(
            rf"\cmidrule(lr){{{end - width + 1}-{end}}}" for end, (_, width) in zip(ends, table.spans, strict=True)
        )
        spans = [over.lstrip() + r" \\", rules]
    else:
        columns, spans = "r" * len(table.columns), []
    body = []
    for k, block in enumerate(table.blocks):
        if k:
            body.append(r"\addlinespace")
        if block.title:
            title = rf"\emph{{{_tex(block.title)}}}"
            body.append(rf"\multicolumn{{{len(table.header)}}}{{@{{}}l}}{{{title}}} \\")
        body += [" & ".join([_tex(row.label), *map(_tex_cell, row.cells)]) + r" \\" for row in block.rows]
    return "\n".join(
        [
            *(f"% {key}: {value}" for key, value in table.provenance.items()),
            r"\begin{table}[t]",
            r"\centering",
            rf"\caption{{{_tex(table.caption)}}}",
            rf"\label{{tab:{table.name}}}",
            r"\footnotesize",
            r"\setlength{\tabcolsep}{4pt}",
            rf"\begin{{tabular}}{{@{{}}l{columns}@{{}}}}",
            r"\toprule",
            *spans,
            " & ".join(map(_tex, table.header)) + r" \\",
            r"\midrule",
            *body,
            r"\bottomrule",
            r"\end{tabular}",
            r"\end{table}",
            "",
        ]
    )


def _tex(text: str) -> str:
    escaped = "".join(_TEX.get(character, character) for character in text)
    return re.sub(r"(?<=\d) (?=[sM]\b)", r"\\,", escaped)  # a thin space before a unit


def _tex_cell(cell: Cell) -> str:
    text = f"${cell.text}$" if cell.text[0] in "+-" else _tex(cell.text)
    text = rf"\textbf{{{text}}}" if cell.bold else text
    return text + (r"\rlap{\textsuperscript{$\dagger$}}" if cell.dagger else "")


def markdown(table: Table) -> str:
    """A Markdown table under its caption."""
    spans = [f"{text} " for text, width in table.spans for _ in range(width)] or [""] * len(table.columns)
    header = [table.header[0], *(a + b for a, b in zip(spans, table.header[1:], strict=True))]
    body = []
    for block in table.blocks:
        if block.title:
            body.append([f"*{_md(block.title)}*", *[""] * len(table.columns)])
        body += [[_md(row.label), *map(_md_cell, row.cells)] for row in block.rows]
    widths = [max(map(len, column)) for column in zip(header, *body, strict=True)]
    rule = ["-" * widths[0], *("-" * (width - 1) + ":" for width in widths[1:])]
    lines = [_md_line(row, widths) for row in (header, rule, *body)]
    return "\n".join([f"**{table.name}.** {_md(table.caption)}", "", *lines, ""])


def _md(text: str) -> str:
    return text.replace("*", r"\*").replace("|", r"\|")


def _md_cell(cell: Cell) -> str:
    text = cell.text.replace("-", "−")
    return (f"**{text}**" if cell.bold else text) + ("†" if cell.dagger else "")


def _md_line(row: Sequence[str], widths: Sequence[int]) -> str:
    numbers = (text.rjust(width) for text, width in zip(row[1:], widths[1:], strict=True))
    return f"| {' | '.join([row[0].ljust(widths[0]), *numbers])} |"


def to_csv(table: Table) -> str:
    """One line per number, unrounded, with its facts and provenance; empty where there are none."""
    text = io.StringIO()
    facts = dict.fromkeys(f for block in table.blocks for row in block.rows for c in row.cells for f in c.facts)
    head = ["table", "source", "block", "row", "column", "value", *facts, "bold", "dagger", *table.provenance]
    out = csv.DictWriter(text, head, lineterminator="\n")
    out.writeheader()
    for block in table.blocks:
        origin = {"table": table.name, "source": block.source, "block": block.title}
        if block.source == "ours":
            origin |= table.provenance
        for row in block.rows:
            for column, cell in zip(table.columns, row.cells, strict=True):
                known = {"value": cell.value, **cell.facts}
                line = {name: x for name, x in known.items() if x is not None and math.isfinite(x)}
                marks = {"bold": int(cell.bold), "dagger": int(cell.dagger)}
                out.writerow({**origin, "row": row.label, "column": column, **line, **marks})
    return text.getvalue()


def write(table: Table, folder: Path) -> None:
    """Writes a table as ``<folder>/<name>.tex``, ``.md`` and ``.csv``.

    Raises:
        RomnavError: The folder cannot be written or the disk is full.
    """
    for suffix, render in ((".tex", latex), (".md", markdown), (".csv", to_csv)):
        files.write(folder / f"{table.name}{suffix}", render(table))
