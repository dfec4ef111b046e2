"""``romnav report``: everything that is recorded at a scale, on one page to hand around."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from romnav import files
from romnav.cli.app import app
from romnav.cli.options import AtScale, arms, command


@command(app, "report")
def report(
    at: AtScale,
    names: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[ARMS]...", help="Whose episodes; default: every evaluated arm's.", autocompletion=arms
        ),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="HTML to write; default: results/<scale>/report.html.")] = None,
) -> None:
    """Write one HTML page with every table, curve and episode of a scale, replays included; it needs no network."""
    from romnav.experiment.kinds.page import write

    path = out or at.work.folder / "report.html"
    files.prepare(path)
    for note in write(at.work, names or [], path):
        typer.echo(f"note: {note}", err=True)
    typer.echo(path)
