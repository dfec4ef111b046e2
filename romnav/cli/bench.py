"""``romnav bench``: a part beside its peers."""

from __future__ import annotations

import subprocess
import sys
from typing import Annotated

import typer

from romnav.cli.app import app
from romnav.cli.options import InProject, command
from romnav.errors import RomnavError


@command(app, "bench")
def bench(
    here: InProject,
    name: Annotated[str | None, typer.Argument(help="A file under benchmarks/; default: all.")] = None,
) -> None:
    """Time a part beside its peers."""
    from romnav.experiment.spec import suggest

    files = {file.stem: file for file in sorted((here.project.root / "benchmarks").glob("[!_]*.py"))}
    if not (files or name):
        raise RomnavError(
            f"{here.project.root / 'benchmarks'}: no benchmarks; change to a copy of the romnav repository"
        )
    if name and name not in files:
        raise RomnavError(f"unknown benchmark {name}{suggest(name, files)}")
    for benchmark in [name] if name else files:
        typer.echo(f"== {benchmark}")
        if subprocess.run([sys.executable, files[benchmark]]).returncode:
            raise RomnavError(f"{files[benchmark]}: failed")
