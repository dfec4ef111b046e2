"""``romnav list`` and ``episodes``: what the project holds, and one thing to add to it."""

from __future__ import annotations

from typing import Annotated

import typer

from romnav.cli.app import app
from romnav.cli.options import LARGEST_SEED, InProject, command
from romnav.errors import RomnavError


@command(app, "list")
def list_(here: InProject) -> None:
    """Show the experiments, their arms, and which training seeds are evaluated at which scale."""
    typer.echo(here.project.overview())
    if faults := here.project.faults:
        for fault in faults.values():
            typer.echo(f"error: {fault}", err=True)
        raise typer.Exit(1)


@command(app, "episodes")
def episodes(
    here: InProject,
    name: Annotated[str, typer.Argument(help="Name of the new set, a file under experiments/episodes/.")],
    seed: Annotated[int, typer.Option(help="Seed of terrain and draw.", min=0, max=LARGEST_SEED)] = 3000,
) -> None:
    """Draw a new set of paired episodes; existing ones are never replaced."""
    from romnav import config
    from romnav.evaluation import episodes
    from romnav.evaluation.spec import EpisodeSetSpec
    from romnav.world.build import build

    try:
        path = here.project.root / "experiments" / "episodes" / f"{config.name(name)}.json"
    except ValueError as error:
        raise RomnavError(f"episode set {error}") from error
    if path.exists():
        raise RomnavError(f"{path}: exists, and results refer to it; choose another name")
    spec = EpisodeSetSpec(seed=seed)
    spec = spec.model_copy(update={"world": spec.world.model_copy(update={"seed": seed})})
    drawn = episodes.draw(name, spec, build(spec.world))
    episodes.save(path, drawn)
    typer.echo(f"{path}: {len(drawn)} episodes, {drawn.cross.mean():.0%} across levels, hash {drawn.digest}")
