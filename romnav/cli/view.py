"""``romnav view``: episodes in 3D, in the browser."""

from __future__ import annotations

from typing import Annotated

import typer

from romnav.cli.app import app
from romnav.cli.options import LARGEST_SEED, AtScale, arms, command
from romnav.errors import RomnavError


@command(app, "view")
def view(
    at: AtScale,
    names: Annotated[
        list[str], typer.Argument(metavar="ARMS...", help="Evaluated arms, side by side.", autocompletion=arms)
    ],
    episode: Annotated[int | None, typer.Option(min=0, help="Only this episode.")] = None,
    failed: Annotated[bool, typer.Option("--failed", help="Only episodes that the first arm did not solve.")] = False,
    where: Annotated[
        str | None, typer.Option(help="Which, of the first arm, e.g. 'level == \"cross\" and climb > 3'.")
    ] = None,
    guarded: Annotated[
        bool, typer.Option("--filter", help="Let the safety filter look on, and show its h and command.")
    ] = False,
    seed: Annotated[int, typer.Option("--seed", min=0, max=LARGEST_SEED, help="Training seed.")] = 0,
    host: Annotated[
        str, typer.Option(help="Address to listen on; the default is for this machine only.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port to listen on.")] = 8080,
) -> None:
    """Replay episodes in 3D in the browser: the tile, the ways, and what an arm saw and decided. Ctrl-C ends it."""
    import threading

    from romnav.experiment.kinds.episodes import look_at, tabulate
    from romnav.experiment.kinds.replays import Again

    try:
        from romnav.report.replay.viewer import Seen, Viewer
    except ModuleNotFoundError as error:
        raise RomnavError(f"romnav view needs {error.name}; run `pip install 'romnav[view]'`") from error

    first = tabulate(at.work, names[0], seed)
    chosen = first.choose(failed, where) if episode is None else [episode]
    if not chosen or max(chosen) >= len(first.table):
        raise RomnavError(f"no episode is like that; there are 0 to {len(first.table) - 1}")
    galleries = {name: look_at(at.work, name, seed) for name in dict.fromkeys(names)}
    runs = {name: Again(at.work, name, seed) for name in galleries}

    def drive(name: str, index: int) -> Seen:
        replay = runs[name].drive(index, guarded=guarded)
        return Seen(replay, runs[name].segment(replay.sight))

    viewer = Viewer(galleries, chosen, drive, at.work.settings.locomotion.robot, host, port)
    typer.echo(f"http://{host}:{port} shows {len(chosen)} episodes; Ctrl-C ends it")
    try:
        threading.Event().wait()
    finally:
        viewer.stop()
