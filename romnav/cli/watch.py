"""``romnav watch``: training runs as they go."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Annotated

import typer

from romnav.cli.app import app
from romnav.cli.options import AtScale, arms, command
from romnav.errors import NothingRecorded

if TYPE_CHECKING:
    from rich.table import Table

    from romnav.experiment.watch import Run


@command(app, "watch")
def watch(
    at: AtScale,
    names: Annotated[
        list[str] | None, typer.Argument(metavar="[ARMS]...", help="Default: every arm.", autocompletion=arms)
    ] = None,
    once: Annotated[bool, typer.Option("--once", help="Show them once and end.")] = False,
    every: Annotated[float, typer.Option(min=0.5, help="Time between two looks, s.")] = 5.0,
) -> None:
    """Watch the training runs of a scale: success by level, curves, speed and time left. Ctrl-C ends it."""
    from rich.console import Console
    from rich.live import Live

    from romnav.experiment.watch import runs

    for name in names or ():
        at.project.having(name)  # refuses what is no arm to train
    found = runs(at.work, names or ())
    if not found:
        raise NothingRecorded(f"{at.work.folder}: no training run has begun; run `romnav train policy ARM`")
    console = Console()
    if once or not console.is_terminal:
        console.print(_panel(found))
        return
    with Live(_panel(found), console=console, auto_refresh=False) as live:
        while True:
            time.sleep(every)
            live.update(_panel(runs(at.work, names or ())), refresh=True)


def _panel(found: list[Run]) -> Table:
    from rich.table import Table

    from romnav.experiment.watch import sparkline
    from romnav.progress import duration

    table = Table(title="Training: success of the latest episodes in percent", padding=(0, 0))
    table.add_column("run", no_wrap=True)
    for heading in ("done", "M steps", "steps/s", "left", "all", "same", "cross"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("success", no_wrap=True)
    for run in found:
        running = run.state == "running"
        rates = (f"{100 * rate:.1f}" if rate == rate else "–" for rate in run.success)
        table.add_row(
            run.name,
            f"{run.iterations / run.total:.0%}",
            f"{run.steps / 1e6:.2f}",
            f"{run.rate:,.0f}",
            duration(run.left) if running else run.state,
            *rates,
            sparkline(run.curve, 12),
            style="bold" if running else None,
        )
    return table
