"""``romnav play``: pictures of the parts at work."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from romnav.cli.app import play
from romnav.cli.options import LARGEST_SEED, ArmArgument, AtScale, OutOption, command


@command(play, "world")
def world(
    at: AtScale,
    seed: Annotated[int, typer.Option(min=0, max=LARGEST_SEED, help="Seed of the generator.")] = 0,
    tile: Annotated[int, typer.Option(min=0, max=2**16, help="Which tile of that seed; the classes take turns.")] = 0,
    out: OutOption = None,
) -> None:
    """Draw a tile of the terrain in 3D beside its occupancy grids."""
    from romnav.report.pictures import draw_tile
    from romnav.world.tiles import generate

    spec = at.work.settings.world.model_copy(update={"seed": seed})
    path = at.picture(out, f"world-{seed}-{tile}.png")
    draw_tile(*generate(spec, tile), path)
    typer.echo(path)


@command(play, "locomotion")
def play_locomotion(at: AtScale) -> None:
    """Draw how the locomotion policy walks each terrain, and its training curve."""
    from romnav.experiment.kinds.locomotion import locomotion
    from romnav.robot.locomotion.play import curve, strip

    walked, drawn = locomotion(at.work).folder, at.picture(None, "locomotion-curve.png")
    for path in strip(walked / "policy.pt", drawn.parent):
        typer.echo(path)
    typer.echo(curve(walked / "curve.csv", drawn))


@command(play, "episodes")
def episodes(
    at: AtScale,
    arm: ArmArgument,
    failed: Annotated[bool, typer.Option("--failed", help="Only episodes that did not reach the goal.")] = False,
    where: Annotated[
        str | None,
        typer.Option(
            help='Which, e.g. \'level == "cross" and climb > 3 and how == "pressed"\'; see the columns printed.'
        ),
    ] = None,
    count: Annotated[int, typer.Option(min=1, max=100, help="How many to draw at most.")] = 6,
    seed: Annotated[int, typer.Option("--seed", min=0, max=LARGEST_SEED, help="Training seed.")] = 0,
    out: OutOption = None,
) -> None:
    """Draw maps of an arm's episodes: the way it went beside the shortest, on every layer; and count how it fails."""
    from romnav.experiment.kinds.episodes import look_at, tabulate

    table = tabulate(at.work, arm, seed)
    chosen = table.choose(failed, where)
    path = at.picture(out, f"episodes-{arm}.png")
    typer.echo(table.failures().to_string())
    if not len(chosen):
        typer.echo("no episode is like that")
        return
    typer.echo(f"{len(chosen)} episodes: {', '.join(map(str, chosen[:20]))}{', ...' if len(chosen) > 20 else ''}")
    look_at(at.work, arm, seed).draw(chosen[:count], path)
    typer.echo(path)


@command(play, "episode")
def episode(
    at: AtScale,
    arm: ArmArgument,
    number: Annotated[int, typer.Argument(metavar="EPISODE", min=0, help="Number of the episode.")],
    out: Annotated[
        Path | None, typer.Option(help="MP4 or GIF to write; default: results/<scale>/figures/<arm>-<episode>.mp4.")
    ] = None,
    speed: Annotated[float, typer.Option(min=0.1, max=100.0, help="Times as fast as it was.")] = 2.0,
    size: Annotated[int, typer.Option(min=64, max=2048, help="Height, pixels; the width is twice that.")] = 480,
    seed: Annotated[int, typer.Option("--seed", min=0, max=LARGEST_SEED, help="Training seed.")] = 0,
) -> None:
    """Film an episode of an arm, from behind and from above; the humanoid with its meshes."""
    from romnav.report.replay import opengl

    opengl.choose()
    from romnav.experiment.kinds.replays import Again

    path = out or at.work.folder / "figures" / f"{arm}-{number}.mp4"
    Again(at.work, arm, seed).film(number, path, speed, size)
    typer.echo(path)
