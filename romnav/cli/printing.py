"""Tables on the terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

TEXT = ("arm", "arms", "level")
"""Headings of columns that are flush left."""


def print_table(title: str, rows: Sequence[Mapping[str, Any]], columns: Mapping[str, str]) -> None:
    """Prints rows, if there are any: ``columns`` maps their keys to headings; what a row does not have is a dash."""
    from rich.console import Console
    from rich.table import Table

    table = Table(title=title)
    for heading in columns.values():
        table.add_column(heading, justify="left" if heading in TEXT else "right")
    for row in rows:
        values = map(row.get, columns)
        table.add_row(*("–" if v is None else f"{v:.3g}" if isinstance(v, float) else str(v) for v in values))
    if rows:
        Console().print(table)
