"""``romnav eval``, ``results`` and ``check``: how well arms do, and whether they still do."""

from __future__ import annotations

import itertools
import json
from typing import Annotated, Any

import typer

from romnav.cli.app import app
from romnav.cli.options import AtScale, DeviceJob, SeedOption, arms, command
from romnav.cli.printing import print_table
from romnav.errors import RomnavError

KEPT_COLUMNS = {
    "arm": "arm",
    "M steps": "M steps",
    "sr_45_all": "SR@45",
    "sr_45_same": "same",
    "sr_45_cross": "cross",
    "sr_120_all": "SR@120",
    "sr_120_same": "same",
    "sr_120_cross": "cross",
    "sr_120_storey": "storeys",
    "spl": "SPL",
}
RESULT_COLUMNS = {
    "arm": "arm",
    "seed": "seed",
    "sr_45": "SR@45",
    "sr_45_same": "same",
    "sr_45_cross": "cross",
    "sr_120": "SR@120",
    "t2g": "T2G/s",
    "spl": "SPL",
    "falls": "falls",
}
TERRAIN_COLUMNS = {
    "terrain": "terrain",
    "command": "command",
    "trials": "trials",
    "crossed": "crossed",
    "target": "to reach",
    "fell": "fell",
    "velocity_error": "error m/s",
    "yaw_error": "error rad/s",
}
NAVIGATION_COLUMNS = {
    "driver": "driver",
    "place": "place",
    "episodes": "episodes",
    "fell": "fell",
    "falls_per_100m": "falls/100 m",
    "sr_45": "SR@45",
    "sr_120": "SR@120",
}
CONTRAST_COLUMNS = {
    "a": "a",
    "b": "b",
    "horizon": "s",
    "level": "level",
    "diff": "diff",
    "lo": "lo",
    "hi": "hi",
    "n": "n",
}


@command(app, "eval")
def evaluate(
    job: DeviceJob,
    names: Annotated[
        list[str],
        typer.Argument(
            metavar="ARMS...",
            help="Trained arms, the scripted ones (oracle, straight), or locomotion for its terrain test.",
            autocompletion=arms,
        ),
    ],
    paired: Annotated[bool, typer.Option("--paired", help="Compare the arms episode by episode.")] = False,
    along: Annotated[
        bool, typer.Option("--kept", help="Judge what an arm's run has kept on the way, on the episodes for choices.")
    ] = False,
    seed: SeedOption = None,
    navigation: Annotated[
        bool,
        typer.Option("--navigation", help="Of locomotion: driven by the oracle and rom over the dev episodes."),
    ] = False,
) -> None:
    """Evaluate arms on the episode set that all arms share, or the locomotion policy on its tests."""
    from romnav.experiment.graph.run import require
    from romnav.experiment.kinds.episodes import episodes

    if along:
        _judge_kept(job, names, seed)
        return
    if navigation and "locomotion" not in names:
        raise RomnavError("--navigation: a test of the locomotion policy; run `romnav eval locomotion --navigation`")
    if "locomotion" in names:
        (_test_navigation if navigation else _test_terrain)(job)
        names = [name for name in names if name != "locomotion"]
        if not names:
            return
    stages = [episodes(job.work, n, s) for n in names for s in (job.project.seeds(n) if seed is None else (seed,))]
    for stage in stages:
        driver = job.project.driver(str(stage.arm))
        for policy in (above for above in stage.upstream if (above.kind, above.arm) == ("policy", driver)):
            require(policy, stage)
    job.make(stages)
    _print_results(_collect(job), names, paired)


@command(app, "results")
def results(
    at: AtScale, as_json: Annotated[bool, typer.Option("--json", help="As JSON, for scripts.")] = False
) -> None:
    """Print every evaluated arm and every paired contrast of a scale."""
    collected = _collect(at)
    if as_json:
        typer.echo(json.dumps(collected, indent=2))
    else:
        _print_results(collected, [], contrasts=True)


@command(app, "check")
def check(at: AtScale) -> None:
    """Hold the results against the bands in results/<scale>/bands.json (nightly regression)."""
    from romnav.experiment.bands import check

    # bands belong to the project: --results is where the results of today lie
    bands = at.project.root / "results" / at.work.scale / "bands.json"
    typer.echo("\n".join(check(_collect(at), bands)))


def _judge_kept(job: DeviceJob, names: list[str], seed: int | None) -> None:
    from romnav.evaluation.paired.progress import read
    from romnav.experiment.kinds.kept import kept

    stages = [kept(job.work, n, s) for n in names for s in (job.project.seeds(n) if seed is None else (seed,))]
    job.make(stages)
    rows = [
        {
            "arm": stage.arm,
            "M steps": float(row["steps"]) / 1e6,
            **{key: float(row[key]) for key in KEPT_COLUMNS if key in row},
        }
        for stage in stages
        for row in read(stage.folder / stage.outputs[0])
    ]
    print_table("Success of kept policies in percent", rows, KEPT_COLUMNS)


def _test_terrain(job: DeviceJob) -> None:
    from romnav.experiment.graph import records
    from romnav.experiment.kinds.locomotion import terrain

    test = terrain(job.work)
    job.make([test])
    record = records.read(test)
    turning = record.facts["yaw_error"] if record else {}
    rows = json.loads((test.folder / test.outputs[0]).read_text("utf-8"))
    rows = [row | {"yaw_error": turning.get(row["terrain"])} for row in rows]
    print_table("Locomotion, shares of trials", rows, TERRAIN_COLUMNS)


def _test_navigation(job: DeviceJob) -> None:
    from romnav.experiment.graph.run import require
    from romnav.experiment.kinds.navigation import navigation

    test = navigation(job.work)
    require(test.upstream[-1], test)
    job.make([test])
    rows = json.loads((test.folder / test.outputs[0]).read_text("utf-8"))
    print_table("Locomotion under navigation, shares of episodes", rows, NAVIGATION_COLUMNS)


def _collect(at: AtScale) -> dict[str, Any]:
    from romnav.report.paired.results import collect

    return collect(at.project.results, at.work.scale)


def _print_results(collected: dict[str, Any], arms: list[str], contrasts: bool) -> None:
    """Prints metrics (percent, s) and contrasts (percentage points), of ``arms`` only unless empty."""
    chosen = [run for run in collected["arms"] if not arms or run["arm"] in arms]
    print_table("Success rates in percent", chosen, RESULT_COLUMNS)
    if contrasts:
        order = list(dict.fromkeys(run["arm"] for run in chosen))
        pairs = list(itertools.combinations(order, 2))
        rows = [c for pair in pairs for c in collected["contrasts"] if (c["a"], c["b"]) == pair]
        print_table("Paired differences a - b in percentage points, 95 % intervals", rows, CONTRAST_COLUMNS)
    typer.echo(f"scale {collected['scale']}, episode set {collected['episode_set']}")
