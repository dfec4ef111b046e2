"""``romnav eval``, ``results`` and ``check``: how well arms do, and whether they still do."""

from __future__ import annotations

import itertools
import json
from collections.abc import Collection
from typing import TYPE_CHECKING, Annotated, Any

import typer

from romnav.cli.app import app
from romnav.cli.options import AtScale, DeviceJob, SeedOption, arms, command
from romnav.cli.printing import print_table
from romnav.errors import RomnavError

if TYPE_CHECKING:
    from romnav.experiment.graph.stage import Stage

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
SEEN_COLUMNS = {
    "arm": "arm",
    "terrain": "terrain",
    "tiles": "tiles",
    "sr_45_all": "SR@45",
    "sr_45_cross": "cross",
    "sr_120_all": "SR@120",
    "sr_120_cross": "cross",
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
CONTRAST_COLUMNS = {"arms": "arms", "horizon": "s", "level": "level", "diff": "diff", "interval": "95 %"}
VERBOSE_COLUMNS = {
    **{"arms": "arms", "horizon": "s", "level": "level", "by_tile": "95 %, by tile"},
    **{"only": "only one", "mid_p": "McNemar p"},
}
AllPairsOption = Annotated[
    bool, typer.Option("--all-pairs", help="Compare every two arms, not only each with the reference arm.")
]
VerboseOption = Annotated[
    bool,
    typer.Option(
        "--verbose",
        help="Of each difference: its interval over tiles, episodes that only one arm solves, McNemar's mid-p.",
    ),
]


@command(app, "eval")
def evaluate(
    job: DeviceJob,
    names: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[ARMS]...",
            help="Trained arms, the scripted ones (oracle, straight), or locomotion for its terrain test; "
            "with --paired none is every trained arm.",
            autocompletion=arms,
        ),
    ] = None,
    paired: Annotated[
        bool, typer.Option("--paired", help="Compare the arms episode by episode, each with the first one.")
    ] = False,
    all_pairs: AllPairsOption = False,
    verbose: VerboseOption = False,
    along: Annotated[
        bool, typer.Option("--kept", help="Judge what an arm's run has kept on the way, on the episodes for choices.")
    ] = False,
    generalization: Annotated[
        bool,
        typer.Option("--generalization", help="Hold the terrain that an arm was trained on against unseen terrain."),
    ] = False,
    joints: Annotated[
        bool, typer.Option("--joints", help="Keep the humanoid's joints beside its tracks, for the viewer and films.")
    ] = False,
    seed: SeedOption = None,
    navigation: Annotated[
        bool,
        typer.Option("--navigation", help="Of locomotion: driven by the oracle and rom over the dev episodes."),
    ] = False,
) -> None:
    """Evaluate arms on the episode set that all arms share, or the locomotion policy on its tests."""
    from romnav.experiment.graph.run import require
    from romnav.experiment.kinds.episodes import POSTURES

    names, paired = names or [], paired or all_pairs or verbose
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise RomnavError(f"{twice} is named twice; name each arm once")
    if not names and (along or not paired):
        raise RomnavError("name arms, or compare all that are trained by `romnav eval --paired`; see `romnav list`")
    if joints and (along or not names):
        raise RomnavError("--joints: are those of evaluated arms; name arms on the humanoid, without --kept")
    if generalization and (along or paired or joints):
        raise RomnavError("--generalization: is of each arm by itself; leave --kept, --paired and --joints out")
    if along and paired:
        raise RomnavError("--kept: is of each arm by itself; leave --paired, --all-pairs and --verbose out")
    if navigation and "locomotion" not in names:
        raise RomnavError("--navigation: a test of the locomotion policy; run `romnav eval locomotion --navigation`")
    if along:
        _judge_kept(job, names, seed)
        return
    if generalization:
        _judge_seen(job, names, seed)
        return
    tested, names = "locomotion" in names, [name for name in names if name != "locomotion"]
    if tested and not names and (joints or paired or seed is not None):
        key = "--joints" if joints else "--paired" if paired else "--seed"
        raise RomnavError(f"{key}: is of arms, and locomotion is none; leave it out, or name an arm, too")
    if paired and len(names) == 1:
        raise RomnavError(f"--paired compares arms: name one beside {names[0]}, or none for all that are trained")
    if tested:
        (_test_navigation if navigation else _test_terrain)(job)
        if not names:
            return
    stages = _of_arms(job, names, seed, joints) if names else _of_trained_arms(job, seed)
    for stage in stages:
        driver = job.project.driver(str(stage.arm))
        for policy in (above for above in stage.upstream if (above.kind, above.arm) == ("policy", driver)):
            require(policy, stage)
    job.make(stages, forced=[stage for stage in stages if joints and not (stage.folder / POSTURES).exists()])
    collected = _collect(job, [(str(stage.arm), stage.seed or 0) for stage in stages])
    chosen = names or [run["arm"] for run in collected["arms"]]
    pairs = [(names[0], other) for other in names[1:]] if names else job.project.comparisons(chosen)
    _print_results(collected, chosen, _pairs(chosen, pairs, all_pairs) if paired else [], verbose)


def _of_arms(job: DeviceJob, names: list[str], seed: int | None, joints: bool) -> list[Stage]:
    from romnav.experiment.kinds.episodes import episodes

    seeds = {name: job.project.seeds(name) if seed is None else (seed,) for name in names}
    return [episodes(job.work, name, s, joints=joints) for name in names for s in seeds[name]]


def _of_trained_arms(job: DeviceJob, seed: int | None) -> list[Stage]:
    from romnav.experiment.kinds.episodes import of_trained_arms

    found, left_out = of_trained_arms(job.work)
    for reason in left_out:
        typer.echo(f"left out: {reason}", err=True)
    stages = [stage for stage in found if seed is None or stage.seed == seed]
    if not stages:
        scale = job.work.scale
        raise RomnavError(f"{job.work.folder}: no arm is trained; run `romnav run ablation spawn-goal --scale {scale}`")
    return stages


@command(app, "results")
def results(
    at: AtScale,
    as_json: Annotated[bool, typer.Option("--json", help="As JSON, for scripts; every two arms, both ways.")] = False,
    all_pairs: AllPairsOption = False,
    verbose: VerboseOption = False,
) -> None:
    """Print every evaluated arm of a scale, and its paired difference to its experiment's reference arm."""
    collected = _collect(at)
    if as_json:
        typer.echo(json.dumps(collected, indent=2))
        return
    arms = list(dict.fromkeys(run["arm"] for run in collected["arms"]))
    _print_results(collected, arms, _pairs(arms, at.project.comparisons(arms), all_pairs), verbose)


@command(app, "check")
def check(at: AtScale) -> None:
    """Hold the results against the bands in results/<scale>/bands.json (nightly regression)."""
    from romnav.experiment.bands import check, read

    # bands belong to the project: --results is where the results of today lie
    file = at.project.root / "results" / at.work.scale / "bands.json"
    bands = read(file, at.project)
    typer.echo("\n".join(check(_collect(at), bands, file)))


def _judge_kept(job: DeviceJob, names: list[str], seed: int | None) -> None:
    from romnav.evaluation.paired.progress import read
    from romnav.experiment.kinds.kept import elsewhere, kept
    from romnav.experiment.kinds.policy import policy

    runs = [policy(job.work, n, s) for n in names for s in (job.project.seeds(n) if seed is None else (seed,))]
    job.make([kept(job.work, str(run.arm), int(run.seed or 0)) for run in runs if not elsewhere(run)])
    rows = [
        {
            "arm": run.arm,
            "M steps": float(row["steps"]) / 1e6,
            **{key: float(row[key]) for key in KEPT_COLUMNS if key in row},
        }
        for run in runs
        for row in read(run.folder / "kept.csv")
    ]
    print_table("Success of kept policies in percent", rows, KEPT_COLUMNS)


def _judge_seen(job: DeviceJob, names: list[str], seed: int | None) -> None:
    from romnav.experiment.graph.run import require
    from romnav.experiment.kinds.generalization import generalization

    stages = [
        generalization(job.work, n, s) for n in names for s in (job.project.seeds(n) if seed is None else (seed,))
    ]
    for stage in stages:
        require(stage.upstream[-1], stage)
    job.make(stages)
    read = ((stage, json.loads((stage.folder / stage.outputs[0]).read_text("utf-8"))) for stage in stages)
    rows = [{"arm": stage.arm} | row for stage, found in read for row in found]
    print_table("Success in percent, on the terrain of training and on unseen terrain", rows, SEEN_COLUMNS)


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


def _collect(at: AtScale, runs: Collection[tuple[str, int]] | None = None) -> dict[str, Any]:
    from romnav.report.paired.results import collect

    return collect(at.project.results, at.work.scale, runs)


def _pairs(arms: list[str], compared: list[tuple[str, str]], all_pairs: bool) -> list[tuple[str, str]]:
    return list(itertools.combinations(dict.fromkeys(arms), 2)) if all_pairs else compared


def _print_results(collected: dict[str, Any], arms: list[str], pairs: list[tuple[str, str]], verbose: bool) -> None:
    """Prints metrics (percent, s) of arms and contrasts (percentage points) of pairs of them."""
    print_table("Success rates in percent", [run for run in collected["arms"] if run["arm"] in arms], RESULT_COLUMNS)
    rows = [_words(c) for pair in pairs for c in collected["contrasts"] if (c["a"], c["b"]) == pair]
    print_table("Paired differences in percentage points", rows, CONTRAST_COLUMNS)
    if verbose:
        print_table("How sure they are, and how many episodes only one arm solves", rows, VERBOSE_COLUMNS)
    typer.echo(f"scale {collected['scale']}, episode set {collected['episode_set']}")


def _words(contrast: dict[str, Any]) -> dict[str, Any]:
    def interval(lo: float | None, hi: float | None) -> str | None:
        return None if lo is None or hi is None else f"{lo:+.1f} to {hi:+.1f}"

    only = None if contrast["a_only"] is None else f"{contrast['a_only']} : {contrast['b_only']}"
    return contrast | {
        "arms": f"{contrast['a']} - {contrast['b']}",
        "diff": None if contrast["diff"] is None else f"{contrast['diff']:+.1f}",
        "interval": interval(contrast["lo"], contrast["hi"]),
        "by_tile": interval(contrast["tile_lo"], contrast["tile_hi"]),
        "only": only,
    }
