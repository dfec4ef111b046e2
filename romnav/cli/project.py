"""``romnav init``, ``list`` and ``episodes``: a new project, what it holds, and one thing to add to it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from romnav.cli.app import app
from romnav.cli.options import LARGEST_SEED, InProject, command
from romnav.errors import RomnavError


@app.command("init")
def init(
    folder: Annotated[Path, typer.Argument(help="Folder to make, or one without experiments/.")] = Path(),
) -> None:
    """Make a project folder: the experiments, scales and episode sets to begin with, and the small policies."""
    from romnav.experiment import template

    template.init(folder)
    typer.echo(
        f"{folder}: a project; there, run `romnav list`, or copy experiments/spawn-goal.toml, rename its tables and "
        "the arms that you change, and run it"
    )


@command(app, "list")
def list_(
    here: InProject,
    what: Annotated[
        str, typer.Argument(help="experiments, or metrics: what columns of tables can show.")
    ] = "experiments",
) -> None:
    """Show the experiments, their arms, and which training seeds are evaluated at which scale; or the metrics."""
    from romnav.experiment.spec import suggest

    lists = {"experiments": lambda: _print_experiments(here), "metrics": _print_metrics}
    if what not in lists:
        raise RomnavError(f"there is no list of {what}{suggest(what, lists)}")
    lists[what]()


def _print_experiments(here: InProject) -> None:
    typer.echo(here.project.overview())
    if faults := here.project.faults:
        for fault in faults.values():
            typer.echo(f"error: {fault}", err=True)
        raise typer.Exit(1)


def _print_metrics() -> None:
    from romnav.evaluation.paired.metrics import METRICS
    from romnav.report.paired.tables import COSTS

    metrics = METRICS | COSTS
    width = max(map(len, metrics))
    for name, metric in metrics.items():
        facts = [metric.unit, f"{metric.better} is better" if metric.better else ""]
        shown = ", ".join(filter(None, facts))
        typer.echo(f"{name:<{width}}  {metric.label}: {metric.definition}{f' ({shown})' if shown else ''}")
    typer.echo("With _same or _cross at its end, a metric of episodes is of goals on the spawn's level or on another.")


@command(app, "episodes")
def episodes(
    here: InProject,
    name: Annotated[str, typer.Argument(help="Name of the new set, a file under experiments/episodes/.")],
    seed: Annotated[int, typer.Option(help="Seed of terrain and draw.", min=0, max=LARGEST_SEED)] = 3000,
    tiles: Annotated[int, typer.Option(help="Tiles of the terrain.", min=1)] = 64,
    count: Annotated[int, typer.Option(help="Episodes.", min=1)] = 1024,
) -> None:
    """Draw a new set of paired episodes; existing ones are never replaced."""
    from romnav import config, files
    from romnav.evaluation import episodes
    from romnav.evaluation.spec import EpisodeSetSpec
    from romnav.world.build import build

    try:
        path = here.project.root / "experiments" / "episodes" / f"{config.name(name)}.json"
    except ValueError as error:
        raise RomnavError(f"episode set {error}") from error
    if path.exists():
        raise RomnavError(f"{path}: exists, and results refer to it; choose another name")
    files.prepare(path)
    paper = EpisodeSetSpec()
    world = paper.world.model_copy(update={"seed": seed, "tiles": tiles})
    spec = EpisodeSetSpec(world=world, episodes=count, cross=count * paper.cross // paper.episodes, seed=seed)
    drawn = episodes.draw(name, spec, build(spec.world))
    episodes.save(path, drawn)
    typer.echo(f"{path}: {len(drawn)} episodes, {drawn.cross.mean():.0%} across levels, hash {drawn.digest}")
