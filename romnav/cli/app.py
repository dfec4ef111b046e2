"""The program: its groups of commands, and what holds for all of them."""

from __future__ import annotations

import io
import shlex
import signal
import sys
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from romnav import __version__, ranks, stopping
from romnav.cli.options import AtScale, ResultsOption, ScaleOption
from romnav.errors import RomnavError


class _Program(TyperGroup):
    """Turns a user's mistake into one line, and a signal into how to go on."""

    def invoke(self, ctx: Any) -> Any:
        stopping.end_with_parent()
        try:
            with stopping.at_once():
                return super().invoke(ctx)
        except RomnavError as error:
            typer.echo(f"error: {error}", err=True)
            raise typer.Exit(1) from None
        except KeyboardInterrupt as stopped:
            number = stopped.number if isinstance(stopped, stopping.Stopped) else signal.SIGINT
            again = shlex.join([*_program(), *(word for word in sys.argv[1:] if word != "--no-resume")])
            typer.echo(f"\nstopped; what is done is kept, go on with: {again}", err=True)
            raise typer.Exit(128 + number) from None


def _program() -> list[str]:
    """Words that start this program as it was started."""
    processes = ranks.started()
    return ["romnav"] if processes == 1 else ["torchrun", "--nproc-per-node", str(processes), "-m", "romnav.cli"]


app = typer.Typer(
    cls=_Program,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Train, evaluate and compare mapless multi-floor navigation policies (RoM-Nav).",
    epilog="First run: romnav run ablation spawn-goal --scale smoke",
)
run = typer.Typer(no_args_is_help=True, help="Run an experiment from training to tables.")
train = typer.Typer(no_args_is_help=True, help="Train one part.")
play = typer.Typer(no_args_is_help=True, help="Draw what the parts make.")
describe = typer.Typer(no_args_is_help=True, help="Tell what there is to learn.")
app.add_typer(describe, name="describe")
app.add_typer(run, name="run")
app.add_typer(train, name="train")
app.add_typer(play, name="play")


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"romnav {__version__}")
        raise typer.Exit


@app.callback()
def _before_the_command(
    ctx: typer.Context,
    results: ResultsOption = None,
    scale: ScaleOption = "smoke",
    version: Annotated[
        bool, typer.Option("--version", help="Show the version and exit.", callback=_show_version, is_eager=True)
    ] = False,
) -> None:
    ctx.obj = AtScale(results, scale)


def main() -> None:
    """Entry point of ``romnav``."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # where a terminal has no dash, it shows a question mark
    app()
