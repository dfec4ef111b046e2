"""Options that many commands take: each declared once, in a class that also is what they stand for."""

from __future__ import annotations

import dataclasses
import functools
import inspect
import re
import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, get_type_hints

import typer

from romnav import files, ranks
from romnav.errors import RomnavError

if TYPE_CHECKING:
    from romnav.experiment.graph.stage import Session, Stage
    from romnav.experiment.project import Project
    from romnav.experiment.workspace import Workspace

Function = TypeVar("Function", bound=Callable[..., None])


def _say(line: str) -> None:
    typer.echo(line, err=True)


def scales() -> list[str]:
    """Names of the project's scales, for completion in the shell."""
    return [file.stem for root in (Path.cwd(), *Path.cwd().parents) for file in root.glob("experiments/scales/*.toml")]


def experiments() -> list[str]:
    """Names of its experiments."""
    from romnav.experiment.project import Project

    return list(Project.here().experiments)


def arms() -> list[str]:
    """Names of its arms."""
    from romnav.experiment.project import Project

    return sorted(Project.here().arms)


ResultsOption = Annotated[Path | None, typer.Option("--results", help="Where results lie; default: results/.")]
ScaleOption = Annotated[
    str,
    typer.Option(
        "--scale", help="smoke (minutes), cpu (hours) or paper (the paper's numbers, GPU).", autocompletion=scales
    ),
]
LARGEST_SEED = 2**32 - 1
SeedOption = Annotated[
    int | None,
    typer.Option("--seed", min=0, max=LARGEST_SEED, help="Training seed; default: those of the experiment."),
]
ExperimentArgument = Annotated[
    str, typer.Argument(help="A file under experiments/, see `romnav list`.", autocompletion=experiments)
]
PICTURES = (".png", ".pdf", ".svg")


def _picture(path: Path | None) -> Path | None:
    if path and path.suffix.lower() not in PICTURES:
        raise RomnavError(f"{path}: key --out names no picture; end it with {', '.join(PICTURES)}")
    if path and path.is_dir():
        raise RomnavError(f"{path}: key --out is a folder; name a file in it")
    return path


OutOption = Annotated[
    Path | None,
    typer.Option("--out", callback=_picture, help="Picture to write; default: in results/<scale>/figures/."),
]
ArmArgument = Annotated[str, typer.Argument(help="An arm of an experiment, see `romnav list`.", autocompletion=arms)]


@dataclass(frozen=True)
class InProject:
    """The project of the current folder."""

    results: ResultsOption = None

    @cached_property
    def project(self) -> Project:
        """Its experiments and results."""
        from romnav.experiment.project import Project

        return Project.here(self.results)


@dataclass(frozen=True)
class AtScale(InProject):
    """The project at one scale."""

    scale: ScaleOption = "smoke"

    @cached_property
    def work(self) -> Workspace:
        """Where the stages of the scale lie, and with which settings."""
        from romnav.experiment.workspace import Workspace

        return Workspace(self.project, self.scale)

    def picture(self, out: Path | None, name: str) -> Path:
        """The file of a picture, by default among the figures of the scale; its folder is made.

        Raises:
            RomnavError: It cannot be written.
        """
        path = out or self.work.folder / "figures" / name
        files.prepare(path)
        return path


@dataclass(frozen=True)
class Job(AtScale):
    """Stages to make."""

    resume: Annotated[bool, typer.Option("--resume/--no-resume", help="Go on from what is there, or start over.")] = (
        True
    )

    @property
    def device(self) -> str:
        """Where their numbers are computed."""
        return "cpu"

    def make(
        self,
        targets: Sequence[Stage],
        again: Sequence[Stage] | None = None,
        *,
        forced: Sequence[Stage] = (),
        side_by_side: bool = False,
    ) -> None:
        """Runs what the targets need, and what is ``forced``; without ``resume``, those in ``again`` start over
        (default: the targets).

        On the CPU, stages that have a command of their own can run ``side_by_side``.
        """
        from romnav.experiment.graph import launch, run

        if ranks.started() > 1 and not all(stage.shared for stage in targets):
            raise RomnavError("several processes (WORLD_SIZE) train a policy alone; start this without torchrun")
        with ranks.joined(self.device) as device:
            session = replace(self._session(), device=device)
            if ranks.rank() > 0:
                run.follow(targets, session)
                return
            repeated = forced if self.resume else targets if again is None else again
            stages = run.pending(targets, repeated)
            if not stages:
                _say("nothing to do: everything is finished and up to date")
            run.prepare(stages)
            execute = self._engine()
            if not execute:
                execute = launch.execute_side_by_side if side_by_side and self.device == "cpu" else run.execute
            execute(stages, session, _say)

    def _engine(self) -> Callable[[Iterable[Stage], Session, Callable[[str], None]], None] | None:
        """What runs stages elsewhere, if it is not this machine."""
        return None

    def draw(self, reports: Sequence[Stage]) -> None:
        """Writes the reports that are out of date, or all without ``resume``, from what is recorded."""
        from romnav.experiment.graph import records, run

        run.execute([r for r in reports if not self.resume or not records.drawn(r)], self._session(), _say)

    def _session(self) -> Session:
        from romnav.experiment.graph.stage import Session

        return Session(self.device, self.resume)


@dataclass(frozen=True)
class DeviceJob(Job):
    """Stages to make on a device."""

    device: Annotated[str, typer.Option("--device", help="cpu, cuda or cuda:N.")] = "cpu"


@dataclass(frozen=True)
class RunJob(DeviceJob):
    """Stages to make, or to be told of."""

    listed: Annotated[
        bool, typer.Option("--print", help="Print what would run as shell commands with their order, and run nothing.")
    ] = False

    on: Annotated[
        str | None, typer.Option("--on", help="Run the stages on a Ray cluster: ray, or ray://host:port.")
    ] = None

    def _engine(self) -> Callable[[Iterable[Stage], Session, Callable[[str], None]], None] | None:
        if self.on is None:
            return None
        from romnav.experiment.graph.cluster import execute_on_ray

        share = self.work.settings.resources
        needs = {"num_cpus": share.cores, "num_gpus": share.gpus, "memory": share.memory_gb * 1e9}
        return functools.partial(execute_on_ray, self.on, needs)

    def tell(self, targets: Sequence[Stage], again: Sequence[Stage], *words: str) -> None:
        """Prints the commands of what `make` would run, then that with these ``words``, for a cluster's queue."""
        from romnav.experiment.graph import plan, run

        stages = run.pending(targets, () if self.resume else again)
        device = () if self.device == "cpu" else ("--device", self.device)
        over = () if self.resume else ("--no-resume",)
        for line in plan.shell(stages, self.work.command(*words, *device), (*device, *over)):
            typer.echo(line)


def _completed(message: str, given: Mapping[str, Any]) -> str:
    """A message whose commands, in backquotes, are those of the present scale, results and seed.

    Whoever raised it may know of none of them.
    """

    def complete(hint: re.Match[str]) -> str:
        words = hint[1]
        for option in ("scale", "results", "seed"):
            value, known = given.get(option), words.split()
            of_seeds = known[1:3] == ["train", "policy"] or known[1] in ("run", "eval")
            if value not in (None, "smoke") and f"--{option}" not in known and (option != "seed" or of_seeds):
                words += f" --{option} {shlex.quote(str(value))}"
        return f"`{words}`"

    return re.sub(r"`(romnav (?:run|train|eval|tables|play|results) [^`]*)`", complete, message)


def command(group: typer.Typer, name: str, **settings: Any) -> Callable[[Function], Function]:
    """Registers a function as a command of a group.

    Its first parameter is one of the classes above: its fields become options of the command, and those that the
    program takes before the command's name, too, hold unless they are given again behind it. ``settings`` are typer's.
    """

    def register(function: Function) -> Function:
        first, *own = inspect.signature(function, eval_str=True).parameters.values()
        options = first.annotation
        hints = get_type_hints(options, include_extras=True)
        shared = [
            inspect.Parameter(
                field.name, inspect.Parameter.KEYWORD_ONLY, default=field.default, annotation=hints[field.name]
            )
            for field in dataclasses.fields(options)
        ]

        @functools.wraps(function)
        def call(ctx: typer.Context, **values: Any) -> None:
            given = {parameter.name: values.pop(parameter.name) for parameter in shared}
            for option in given:
                if (source := ctx.get_parameter_source(option)) and source.name == "DEFAULT":
                    given[option] = getattr(ctx.obj, option, given[option])
            try:
                function(options(**given), **values)
            except RomnavError as error:
                told = {**given, "seed": values.get("seed")}
                raise type(error)(_completed(str(error), told)) from error

        context = inspect.Parameter("ctx", inspect.Parameter.KEYWORD_ONLY, annotation=typer.Context)
        own = [parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY) for parameter in own]
        parameters = [context, *own, *shared]
        call.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        call.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
        group.command(name, **settings)(call)
        return function

    return register
