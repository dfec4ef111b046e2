"""Options that many commands take: each declared once, in a class that also is what they stand for."""

from __future__ import annotations

import dataclasses
import functools
import inspect
from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, get_type_hints

import typer

if TYPE_CHECKING:
    from romnav.experiment.plan import Plan, Stage
    from romnav.experiment.project import Project

Function = TypeVar("Function", bound=Callable[..., None])


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
SeedOption = Annotated[int | None, typer.Option("--seed", help="Training seed; default: those of the experiment.")]
ExperimentArgument = Annotated[
    str, typer.Argument(help="A file under experiments/, see `romnav list`.", autocompletion=experiments)
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
    def plan(self) -> Plan:
        """The stages of the scale."""
        from romnav.experiment.plan import Plan
        from romnav.experiment.scales import ScaleFile

        return Plan(self.project, ScaleFile(self.project.root / "experiments" / "scales", self.scale))


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

    def make(self, targets: list[Stage], kinds: Collection[str]) -> None:
        """Runs what the targets need; without ``resume``, stages of the given ``kinds`` start over."""
        self.perform(self.pending(targets, kinds))

    def pending(self, targets: list[Stage], kinds: Collection[str]) -> list[Stage]:
        """What `make` would run, in order."""
        from romnav.experiment.run import pending, require_walking

        stages = pending(targets, () if self.resume else kinds)
        require_walking(stages)
        if not stages:
            typer.echo("nothing to do: everything is finished and up to date", err=True)
        return stages

    def perform(self, stages: list[Stage]) -> None:
        """Runs stages, one after the other."""
        from romnav.experiment.run import execute
        from romnav.experiment.stages import Stages, require_device

        require_device(self.device)
        actions = Stages(self.plan, self.device, self.resume).actions
        execute(stages, actions, self.resume, lambda line: typer.echo(line, err=True))


@dataclass(frozen=True)
class DeviceJob(Job):
    """Stages to make on a device."""

    device: Annotated[str, typer.Option("--device", help="cpu, cuda or cuda:N.")] = "cpu"


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
            function(options(**given), **values)

        context = inspect.Parameter("ctx", inspect.Parameter.KEYWORD_ONLY, annotation=typer.Context)
        own = [parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY) for parameter in own]
        parameters = [context, *own, *shared]
        call.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        call.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
        group.command(name, **settings)(call)
        return function

    return register
