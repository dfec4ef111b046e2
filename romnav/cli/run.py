"""``romnav run`` and ``romnav tables``: experiments from training to tables, and tables from what is recorded."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from romnav.cli.app import app, run
from romnav.cli.options import ExperimentArgument, Job, RunJob, SeedOption, command, experiments
from romnav.errors import NothingRecorded, RomnavError

if TYPE_CHECKING:
    from romnav.experiment.graph.stage import Stage
    from romnav.experiment.workspace import Workspace


@command(run, "ablation")
def ablation(job: RunJob, name: ExperimentArgument, seed: SeedOption = None) -> None:
    """Train every arm of an ablation, evaluate them if it has tables of episodes, then write and print its tables."""
    from romnav.experiment.graph.run import with_all_above

    reports = _reports(job.work, "ablation", name, seed)
    if job.listed:
        job.tell(reports, with_all_above(reports), "run", "ablation", name, *_seed(seed))
        return
    job.make(reports, with_all_above(reports), side_by_side=True)
    for report in reports:
        _print_tables(report)


def _register_trials(kind: str, purpose: str) -> None:
    """The command of an experiment that consists of trials."""

    @command(run, kind, help=f"{purpose} with the safety filter off and on; write table and figure.")
    def trials(
        job: RunJob,
        name: ExperimentArgument = kind,
        arm: Annotated[
            list[str] | None, typer.Option("--arm", help="Only this arm, trained or scripted; may be repeated.")
        ] = None,
        seed: SeedOption = None,
    ) -> None:
        from romnav.experiment.spec import suggest

        reports = [report for report in _reports(job.work, kind, name, seed) if report.kind == "report"]
        known = {str(stage.arm) for stage in reports[0].upstream}
        for one in arm or ():
            if one not in known:
                raise RomnavError(f"{job.project.file(name)}: no arm {one}{suggest(one, known)}")
        driven = [stage for stage in reports[0].upstream if not arm or stage.arm in arm]
        if job.listed:
            words = (word for one in arm or () for word in ("--arm", one))
            job.tell(driven, driven, "run", kind, name, *words, *_seed(seed))
            return
        job.make(driven)
        job.draw(reports)
        for report in reports:
            _print_tables(report)


_register_trials("safety", "Drive every arm through the three obstacle sets")
_register_trials("deploy", "Drive every arm through the four long deployments")


@command(app, "tables")
def tables(
    job: Job,
    name: Annotated[str | None, typer.Argument(help="Experiment; default: all.", autocompletion=experiments)] = None,
) -> None:
    """Write tables and figures again from what is recorded; nothing is trained or evaluated."""
    from romnav.experiment.kinds import reports

    names = [name] if name else job.project.experiments
    missing: list[NothingRecorded] = []
    drawn = []
    for stage in (s for n in names for s in reports(job.work, n, job.project.experiment(n).seeds)):
        try:
            job.draw([stage])
        except NothingRecorded as error:
            missing.append(error)
        else:
            drawn.append(stage)
            _print_tables(stage)
    for fault in job.project.faults.values() if name is None else ():
        raise fault
    if missing and not drawn:
        raise missing[0]


def _reports(work: Workspace, kind: str, name: str, seed: int | None) -> list[Stage]:
    """The reports of an experiment, which has to be of a kind; over all of its training seeds or one."""
    from romnav.experiment.kinds import reports

    experiment = work.project.experiment(name)
    if experiment.kind != kind:
        raise RomnavError(
            f"{work.project.file(name)}: key kind is {experiment.kind}, not {kind}; "
            f"run `romnav run {experiment.kind} {name}`"
        )
    return reports(work, name, experiment.seeds if seed is None else (seed,))


def _seed(seed: int | None) -> tuple[str, ...]:
    return () if seed is None else ("--seed", str(seed))


def _print_tables(stage: Stage) -> None:
    for name in stage.outputs:
        if name.endswith(".md"):
            typer.echo((stage.folder / name).read_text("utf-8"))
    typer.echo(f"{stage.kind}: {stage.folder}", err=True)
