"""The command line: parses, calls, prints. Heavy imports wait until a command needs them."""

from __future__ import annotations

import itertools
import shlex
import sys
from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from romnav.errors import RomnavError

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from romnav.experiment.plan import Plan, Stage


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


class _Group(TyperGroup):
    """Turns a user's mistake into one line, and Ctrl-C into how to go on."""

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except RomnavError as error:
            typer.echo(f"error: {error}", err=True)
            raise typer.Exit(1) from None
        except KeyboardInterrupt:
            again = shlex.join(["romnav", *(word for word in sys.argv[1:] if word != "--no-resume")])
            typer.echo(f"\nstopped; what is done is kept, go on with: {again}", err=True)
            raise typer.Exit(130) from None


app = typer.Typer(
    cls=_Group,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Train, evaluate and compare mapless multi-floor navigation policies (RoM-Nav).",
    epilog="First run: romnav run ablation spawn-goal --scale smoke",
)
run = typer.Typer(no_args_is_help=True, help="Run an experiment from training to tables.")
train = typer.Typer(no_args_is_help=True, help="Train one part.")
play = typer.Typer(no_args_is_help=True, help="Draw what the parts make.")
app.add_typer(run, name="run")
app.add_typer(train, name="train")
app.add_typer(play, name="play")

ArmOption = Annotated[
    list[str] | None, typer.Option("--arm", help="Only this arm, trained or scripted; may be repeated.")
]
ScaleOption = Annotated[
    str, typer.Option("--scale", help="smoke (minutes), cpu (hours) or paper (the paper's numbers, GPU).")
]
SeedOption = Annotated[int | None, typer.Option("--seed", help="Training seed; default: those of the experiment.")]
DeviceOption = Annotated[str, typer.Option("--device", help="cpu, cuda or cuda:N.")]
ResumeOption = Annotated[bool, typer.Option("--resume/--no-resume", help="Go on from what is there, or start over.")]


@app.callback()
def _options(
    ctx: typer.Context,
    results: Annotated[Path | None, typer.Option(help="Where results lie; default: results/.")] = None,
) -> None:
    ctx.obj = results


@app.command("list")
def list_(ctx: typer.Context) -> None:
    """Show the experiments, their arms, and which training seeds are evaluated at which scale."""
    from romnav.experiment.project import Project

    typer.echo(Project.here(ctx.obj).overview())


@run.command()
def ablation(
    ctx: typer.Context,
    name: Annotated[str, typer.Argument(help="A file under experiments/, see `romnav list`.")],
    scale: ScaleOption = "smoke",
    seed: SeedOption = None,
    device: DeviceOption = "cpu",
    resume: ResumeOption = True,
) -> None:
    """Train every arm of an ablation, evaluate them if it has tables of episodes, then write and print its tables."""
    from romnav.experiment.launch import stages_side_by_side
    from romnav.experiment.run import EVERYTHING

    plan = _plan(ctx, scale)
    reports = _reports(plan, "ablation", name, seed)
    stages = _pending(reports, resume, EVERYTHING)
    if device == "cpu":
        _perform(plan, [stage for stage in stages if stage.kind == "encoder"], device, resume)
        for kind in ("policy", "episodes"):
            stages_side_by_side(plan, [stage for stage in stages if stage.kind == kind], resume)
        stages = [stage for stage in stages if stage in reports]
    _perform(plan, stages, device, resume)
    for report in reports:
        _print_tables(report)


@run.command()
def safety(
    ctx: typer.Context,
    name: Annotated[str, typer.Argument(help="A file under experiments/ of the kind safety.")] = "safety",
    arm: ArmOption = None,
    scale: ScaleOption = "smoke",
    seed: SeedOption = None,
    device: DeviceOption = "cpu",
    resume: ResumeOption = True,
) -> None:
    """Drive every arm through the three obstacle sets with the safety filter off and on; write table and figure."""
    _run_trials(ctx, "safety", name, arm, scale, seed, device, resume)


@run.command()
def deploy(
    ctx: typer.Context,
    name: Annotated[str, typer.Argument(help="A file under experiments/ of the kind deploy.")] = "deploy",
    arm: ArmOption = None,
    scale: ScaleOption = "smoke",
    seed: SeedOption = None,
    device: DeviceOption = "cpu",
    resume: ResumeOption = True,
) -> None:
    """Drive every arm through the four long deployments with the safety filter off and on; write table and figure."""
    _run_trials(ctx, "deploy", name, arm, scale, seed, device, resume)


@train.command()
def encoder(
    ctx: typer.Context,
    sensor: Annotated[str | None, typer.Argument(help="lidar or depth; default: both.")] = None,
    scale: ScaleOption = "smoke",
    device: DeviceOption = "cpu",
    resume: ResumeOption = True,
) -> None:
    """Pretrain the encoders, then measure and draw what they make of tiles that they have not seen."""
    from romnav.experiment.plan import PRETRAINING
    from romnav.experiment.spec import suggest

    plan = _plan(ctx, scale)
    if sensor and sensor not in PRETRAINING:
        raise RomnavError(f"unknown sensor {sensor}{suggest(sensor, PRETRAINING)}")
    _execute(plan, [plan.quality(s) for s in ([sensor] if sensor else PRETRAINING)], device, resume, {"encoder"})


@train.command()
def policy(
    ctx: typer.Context,
    arm: Annotated[str, typer.Argument(help="An arm of an experiment, see `romnav list`.")],
    scale: ScaleOption = "smoke",
    seed: SeedOption = None,
    device: DeviceOption = "cpu",
    resume: ResumeOption = True,
) -> None:
    """Train the navigation policy of an arm, and its encoder if that is missing."""
    plan = _plan(ctx, scale)
    seeds = plan.project.seeds(arm) if seed is None else (seed,)
    _execute(plan, [plan.policy(arm, s) for s in seeds], device, resume, {"policy"})


@train.command()
def locomotion(
    ctx: typer.Context,
    scale: ScaleOption = "smoke",
    device: DeviceOption = "cpu",
    resume: ResumeOption = True,
) -> None:
    """Train the policy that walks the humanoid; a larger number of iterations in the scale continues it."""
    plan = _plan(ctx, scale)
    _execute(plan, [plan.locomotion()], device, resume, {"locomotion"})


@train.command()
def gaits(
    ctx: typer.Context,
    scale: ScaleOption = "smoke",
    device: DeviceOption = "cpu",
    resume: ResumeOption = True,
) -> None:
    """Record the gait library of the locomotion policy: how it walks on stairs and ramps, to start episodes there."""
    plan = _plan(ctx, scale)
    _execute(plan, [plan.gaits()], device, resume, {"gaits"})


@app.command("eval")
def evaluate(
    ctx: typer.Context,
    arms: Annotated[
        list[str],
        typer.Argument(help="Trained arms, the scripted ones (oracle, straight), or locomotion for its terrain test."),
    ],
    paired: Annotated[bool, typer.Option("--paired", help="Compare the arms episode by episode.")] = False,
    scale: ScaleOption = "smoke",
    seed: SeedOption = None,
    device: DeviceOption = "cpu",
    resume: ResumeOption = True,
) -> None:
    """Evaluate arms on the episode set that all arms share, or the locomotion policy on its terrain test."""
    from romnav.experiment.run import require_trained

    plan = _plan(ctx, scale)
    if "locomotion" in arms:
        _evaluate_locomotion(plan, device, resume)
        arms = [arm for arm in arms if arm != "locomotion"]
        if not arms:
            return
    stages = [plan.episodes(arm, s) for arm in arms for s in (plan.project.seeds(arm) if seed is None else (seed,))]
    require_trained(stages)
    _execute(plan, stages, device, resume, {"episodes"})
    _print_results(_collect(ctx, scale), arms, paired)


@app.command()
def results(
    ctx: typer.Context,
    scale: ScaleOption = "smoke",
    json: Annotated[bool, typer.Option("--json", help="As JSON, for scripts.")] = False,
) -> None:
    """Print every evaluated arm and every paired contrast of a scale."""
    collected = _collect(ctx, scale)
    if json:
        from json import dumps

        typer.echo(dumps(collected, indent=2))
    else:
        _print_results(collected, [], contrasts=True)


@app.command()
def tables(
    ctx: typer.Context,
    name: Annotated[str | None, typer.Argument(help="Experiment; default: all.")] = None,
    scale: ScaleOption = "smoke",
) -> None:
    """Write tables and figures again from what is recorded; nothing is trained or evaluated."""
    plan = _plan(ctx, scale)
    names = [name] if name else list(plan.project.experiments)
    reports = [stage for n in names for stage in plan.reports(n, plan.project.experiment(n).seeds)]
    recorded = [r for r in reports if any((s.folder / s.outputs[-1]).exists() for s in r.upstream)]
    for stage in recorded or reports:
        _perform(plan, [stage], "cpu", True)
        _print_tables(stage)


@app.command()
def episodes(
    ctx: typer.Context,
    name: Annotated[str, typer.Argument(help="Name of the new set, a file under experiments/episodes/.")],
    seed: Annotated[int, typer.Option(help="Seed of terrain and draw.", min=1)] = 3000,
) -> None:
    """Draw a new set of paired episodes; existing ones are never replaced."""
    from romnav.evaluation import episodes
    from romnav.evaluation.spec import EpisodeSetSpec
    from romnav.experiment.project import Project
    from romnav.world.world import build

    path = Project.here(ctx.obj).root / "experiments" / "episodes" / f"{name}.json"
    if path.exists():
        raise RomnavError(f"{path}: exists, and results refer to it; choose another name")
    spec = EpisodeSetSpec(seed=seed)
    spec = spec.model_copy(update={"world": spec.world.model_copy(update={"seed": seed})})
    drawn = episodes.draw(name, spec, build(spec.world))
    episodes.save(path, drawn)
    typer.echo(f"{path}: {len(drawn)} episodes, {drawn.cross.mean():.0%} across levels, hash {drawn.digest}")


@app.command()
def check(ctx: typer.Context, scale: ScaleOption = "smoke") -> None:
    """Hold the results against the bands in results/<scale>/bands.json (nightly regression)."""
    from romnav.experiment.bands import check

    bands = _plan(ctx, scale).project.root / "results" / scale / "bands.json"
    typer.echo("\n".join(check(_collect(ctx, scale), bands)))


@play.command()
def world(
    ctx: typer.Context,
    seed: Annotated[int, typer.Option(help="Seed of the generator.")] = 0,
    tile: Annotated[int, typer.Option(min=0, help="Which tile of that seed; the classes take turns.")] = 0,
    scale: ScaleOption = "smoke",
    out: Annotated[Path | None, typer.Option(help="PNG to write; default: results/<scale>/figures/.")] = None,
) -> None:
    """Draw a tile of the terrain in 3D beside its occupancy grids."""
    from romnav.report.pictures import draw_tile
    from romnav.world.tiles import generate

    plan = _plan(ctx, scale)
    path = out or plan.folder / "figures" / f"world-{seed}-{tile}.png"
    draw_tile(*generate(plan.scale.settings.world.model_copy(update={"seed": seed}), tile), path)
    typer.echo(path)


@play.command("locomotion")
def play_locomotion(ctx: typer.Context, scale: ScaleOption = "smoke") -> None:
    """Draw how the locomotion policy walks each terrain, and its training curve."""
    from romnav.robot.locomotion.play import curve, strip

    plan = _plan(ctx, scale)
    walked = plan.locomotion()
    for path in strip(walked.folder / "policy.pt", plan.folder / "figures"):
        typer.echo(path)
    typer.echo(curve(walked.folder / "curve.csv", plan.folder / "figures" / "locomotion-curve.png"))


@app.command()
def bench(
    ctx: typer.Context,
    name: Annotated[str | None, typer.Argument(help="A file under benchmarks/; default: all.")] = None,
) -> None:
    """Time a part beside its peers."""
    import subprocess

    from romnav.experiment.project import Project
    from romnav.experiment.spec import suggest

    folder = Project.here(ctx.obj).root / "benchmarks"
    files = {file.stem: file for file in sorted(folder.glob("[!_]*.py"))}
    if name and name not in files:
        raise RomnavError(f"unknown benchmark {name}{suggest(name, files)}")
    for benchmark in [name] if name else files:
        typer.echo(f"== {benchmark}")
        if subprocess.run([sys.executable, files[benchmark]]).returncode:
            raise RomnavError(f"{files[benchmark]}: failed")


def main() -> None:
    """Entry point of ``romnav``."""
    app()


def _plan(ctx: typer.Context, scale: str) -> Plan:
    from romnav.experiment.plan import Plan
    from romnav.experiment.project import Project
    from romnav.experiment.scales import ScaleFile

    project = Project.here(ctx.obj)
    return Plan(project, ScaleFile(project.root / "experiments" / "scales", scale))


def _run_trials(
    ctx: typer.Context,
    kind: str,
    name: str,
    arms: list[str] | None,
    scale: str,
    seed: int | None,
    device: str,
    resume: bool,
) -> None:
    from romnav.experiment.spec import suggest

    plan = _plan(ctx, scale)
    (report,) = _reports(plan, kind, name, seed)
    known = {str(stage.arm) for stage in report.upstream}
    for arm in arms or ():
        if arm not in known:
            raise RomnavError(f"{plan.project.file(name)}: no arm {arm}{suggest(arm, known)}")
    wanted = [stage for stage in report.upstream if not arms or stage.arm in arms]
    _execute(plan, wanted, device, resume, {"trials"})
    _perform(plan, [report], device, resume)
    _print_tables(report)


def _reports(plan: Plan, kind: str, name: str, seed: int | None) -> list[Stage]:
    """The reports of an experiment, which has to be of a kind; over all of its training seeds or one."""
    experiment = plan.project.experiment(name)
    if experiment.kind != kind:
        raise RomnavError(
            f"{plan.project.file(name)}: key kind is {experiment.kind}, not {kind}; "
            f"run `romnav run {experiment.kind} {name}`"
        )
    return plan.reports(name, experiment.seeds if seed is None else (seed,))


def _execute(plan: Plan, targets: list[Stage], device: str, resume: bool, kinds: Collection[str]) -> None:
    """Runs what the targets need; without ``resume``, stages of the given ``kinds`` start over."""
    _perform(plan, _pending(targets, resume, kinds), device, resume)


def _pending(targets: list[Stage], resume: bool, kinds: Collection[str]) -> list[Stage]:
    from romnav.experiment.run import pending, require_walking

    stages = pending(targets, () if resume else kinds)
    require_walking(stages)
    if not stages:
        typer.echo("nothing to do: everything is finished and up to date", err=True)
    return stages


def _perform(plan: Plan, stages: list[Stage], device: str, resume: bool) -> None:
    from romnav.experiment.run import execute
    from romnav.experiment.stages import Stages, require_device

    require_device(device)
    execute(stages, Stages(plan, device, resume).actions, resume, lambda line: typer.echo(line, err=True))


def _evaluate_locomotion(plan: Plan, device: str, resume: bool) -> None:
    from json import loads

    from rich.console import Console
    from rich.table import Table

    from romnav.experiment import store

    terrain, walked = plan.terrain(), plan.locomotion()
    if not (walked.folder / "policy.pt").exists():
        command = f"romnav train locomotion --scale {plan.scale.name}"
        raise RomnavError(f"{walked.folder}: no locomotion policy; train one with `{command}`")
    _execute(plan, [terrain], device, resume, {"terrain"})
    record = store.read(terrain)
    turning = record.facts["yaw_error"] if record else {}
    rows = loads((terrain.folder / terrain.outputs[0]).read_text("utf-8"))
    rows = [row | {"yaw_error": turning.get(row["terrain"])} for row in rows]
    _print_table(Console(), Table(title="Locomotion, shares of trials"), rows, TERRAIN_COLUMNS)


def _print_tables(stage: Stage) -> None:
    for name in stage.outputs:
        if name.endswith(".md"):
            typer.echo((stage.folder / name).read_text("utf-8"))
    typer.echo(f"{stage.kind}: {stage.folder}", err=True)


def _collect(ctx: typer.Context, scale: str) -> dict[str, Any]:
    from romnav.report.results import collect

    return collect(_plan(ctx, scale).project.results, scale)


def _print_results(collected: dict[str, Any], arms: list[str], contrasts: bool) -> None:
    """Prints metrics (percent, s) and contrasts (percentage points), of ``arms`` only unless empty."""
    from rich.console import Console
    from rich.table import Table

    chosen = [run for run in collected["arms"] if not arms or run["arm"] in arms]
    _print_table(Console(), Table(title="Success rates in percent"), chosen, RESULT_COLUMNS)
    if contrasts:
        order = list(dict.fromkeys(run["arm"] for run in chosen))
        pairs = list(itertools.combinations(order, 2))
        rows = [c for pair in pairs for c in collected["contrasts"] if (c["a"], c["b"]) == pair]
        title = "Paired differences a - b in percentage points, 95 % intervals"
        _print_table(Console(), Table(title=title), rows, CONTRAST_COLUMNS)
    typer.echo(f"scale {collected['scale']}, episode set {collected['episode_set']}")


def _print_table(console: Console, table: Table, rows: list[dict[str, Any]], columns: dict[str, str]) -> None:
    for heading in columns.values():
        table.add_column(heading, justify="left" if heading in ("arm", "a", "b", "level") else "right")
    for row in rows:
        values = (row[key] for key in columns)
        table.add_row(*("–" if v is None else f"{v:.3g}" if isinstance(v, float) else str(v) for v in values))
    if rows:
        console.print(table)


if __name__ == "__main__":
    main()
