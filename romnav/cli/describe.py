"""``romnav describe``: what there is to learn, before anything is trained."""

from __future__ import annotations

import json
from typing import Annotated, Any

import typer

from romnav.cli.app import describe
from romnav.cli.options import AtScale, OutOption, command, experiments, scales
from romnav.cli.printing import print_table

SAMPLER_COLUMNS = {
    "arm": "arm",
    "mean_geodesic": "path/m",
    "cross_share": "cross",
    "storey_share": "of them a storey",
    "two_storey_share": "two",
    "beyond_30": "beyond 30 m",
    "beyond_45": "45 m",
    "on_connector": "starts at stairs",
}


@command(describe, "world")
def world(
    at: AtScale,
    experiment: Annotated[
        str, typer.Option(help="Experiment whose samplers draw the goals.", autocompletion=experiments)
    ] = "spawn-goal",
    as_json: Annotated[bool, typer.Option("--json", help="As JSON, for scripts.")] = False,
    out: OutOption = None,
) -> None:
    """Tell how far and how high the goals of the training terrain lie, and draw it; the terrain is built if need be."""
    from romnav.experiment.describe import describe_world
    from romnav.progress import bar
    from romnav.report.difficulty_figure import draw_difficulty

    at.project.experiment(experiment)  # its name is that of a file
    path = at.picture(out, f"describe-{experiment}.png")
    with bar("world") as progress:
        described = describe_world(at.work, experiment, progress)
    told = described.plain()
    draw_difficulty(described.difficulty.goals, path)
    if as_json:
        typer.echo(json.dumps(told, indent=2))
    else:
        rows = [{"arm": arm, **shares} for arm, shares in told["samplers"].items()]
        print_table("Goals drawn from uniform starts; shares of 1", rows, SAMPLER_COLUMNS)
        typer.echo("\n".join(_lines(told)))
    typer.echo(path, err=True)


@command(describe, "scale")
def scale(
    at: AtScale,
    name: Annotated[str, typer.Argument(help="Scale, see experiments/scales/.", autocompletion=scales)],
    as_json: Annotated[bool, typer.Option("--json", help="As JSON, for scripts.")] = False,
) -> None:
    """Tell what a training run on the reduced-order model takes of memory at a scale, before it starts."""
    from romnav.experiment.memory import footprint
    from romnav.experiment.workspace import Workspace

    settings = Workspace(at.project, name).settings
    parts = footprint(settings)
    if as_json:
        typer.echo(json.dumps(parts, indent=2))
        return
    spec = settings.navigation
    rows = [{"part": part, "mb": f"{size:,.1f}"} for part, size in parts.items()]
    print_table(f"Memory of {name}", rows, {"part": "part", "mb": "MB"})
    typer.echo(f"{spec.env.envs:,} robots x {spec.ppo.steps} steps, {settings.ground.tiles} tiles")
    typer.echo("activations of an update are not counted")


def _lines(told: dict[str, Any]) -> list[str]:
    tiles = ", ".join(f"{count} {kind}" for kind, count in told["tiles"].items())
    t2g, straight = told["oracle_t2g"], told["straight_sr_120_same"]
    return [
        f"tiles: {tiles}; {told['draws_per_tile']:.2f} draws each, built in {told['build_s']:.0f} s",
        f"holds {told['solids']:,} solids, {told['nodes']:,} free cells, {told['goals']:,} goals; "
        f"{told['memory_mb']:.0f} MB",
        f"oracle: {'reaches none' if t2g is None else f'{t2g:.1f} s to the goal'}",
        f"straight: {'no goals' if straight is None else f'reaches {straight:.1f} % of goals'} on one level",
    ]
