"""Runs stages: only those whose output is missing or out of date, each with its progress and its record."""

from __future__ import annotations

import shlex
import time
from collections.abc import Callable, Collection, Iterable
from contextlib import AbstractContextManager
from pathlib import Path

from romnav import files, ranks
from romnav.errors import RomnavError
from romnav.experiment.graph import records
from romnav.experiment.graph.lock import held
from romnav.experiment.graph.stage import Session, Stage
from romnav.progress import bar


def pending(targets: Collection[Stage], again: Collection[Stage] = ()) -> list[Stage]:
    """The stages that must run for the targets to be finished, in order.

    A stage whose output is gone runs only where another one has to read it. Stages in ``again`` run even if they are
    finished, and so do those that need them.

    Raises:
        RomnavError: A target needs a stage that is made on request alone.
    """
    asked, repeated = ({stage.name for stage in stages} for stages in (targets, again))
    runs: dict[str, bool] = {}
    ordered: list[Stage] = []

    def forced(stage: Stage) -> bool:
        return stage.name in repeated or any(map(forced, stage.upstream))

    def visit(stage: Stage) -> None:
        if stage.name in runs:
            return
        runs[stage.name] = forced(stage) or not records.finished(stage)
        if runs[stage.name]:
            for above in stage.upstream:
                if above.on_request and above.name not in asked:
                    require(above, stage)
                visit(above)
            ordered.append(stage)

    for target in targets:
        visit(target)
    return ordered


def require(stage: Stage, reader: Stage) -> None:
    """Checks that a stage that ``reader`` needs is finished.

    Raises:
        RomnavError: It is not, or was made with other settings.
    """
    if reason := missing(stage):
        command = shlex.join(("romnav", *stage.command))
        raise RomnavError(f"{stage.folder}: {stage.name} {reason}, and {reader.name} needs it; run `{command}`")


def missing(stage: Stage) -> str:
    """Why a stage is not finished, as the end of a sentence; empty if it is."""
    if records.finished(stage):
        return ""
    if changed := "; ".join(records.differences(stage)):
        return f"was made with other settings ({changed})"
    if stage.record.exists():
        return "is unfinished, or something that it was made from has changed since"
    return "is missing"


def with_all_above(stages: Iterable[Stage]) -> list[Stage]:
    """The stages and all that they need, but for those that are made on request alone."""
    found: dict[str, Stage] = {}

    def visit(stage: Stage) -> None:
        if stage.name not in found and not stage.on_request:
            found[stage.name] = stage
            for above in stage.upstream:
                visit(above)

    for stage in stages:
        visit(stage)
    return list(found.values())


def waves(stages: Iterable[Stage]) -> list[list[Stage]]:
    """Stages to run in groups: one after the other, each with what it needs in earlier ones or not at all."""
    depth: dict[str, int] = {}
    groups: list[list[Stage]] = []
    for stage in stages:  # upstream ones come first
        level = depth[stage.name] = 1 + max((depth.get(above.name, -1) for above in stage.upstream), default=-1)
        groups += [[] for _ in range(level + 1 - len(groups))]
        groups[level].append(stage)
    return groups


def prepare(stages: Iterable[Stage]) -> None:
    """Makes sure that what stages will write can be written, which is better known before the first one than after it.

    Raises:
        RomnavError: A file cannot be written.
    """
    for stage in stages:
        for path in (*(stage.folder / name for name in stage.outputs), stage.record):
            files.prepare(path)


def require_device(stages: Iterable[Stage], session: Session) -> None:
    """Checks that all stages can be made on the device, which is better known before the first one than hours later.

    Raises:
        RomnavError: Some can be made on the CPU alone, and are to be made elsewhere.
    """
    bound = list(dict.fromkeys(stage.arm or stage.name for stage in stages if stage.cpu_only))
    if bound and session.device != "cpu":
        raise RomnavError(
            f"--device {session.device}: {', '.join(bound)}: made on the CPU alone, where their physics runs; first "
            f"`romnav train policy ARM --device {session.device}` for each other arm, then these with --device cpu"
        )


def execute(stages: Iterable[Stage], session: Session, say: Callable[[str], None] = lambda line: None) -> None:
    """Runs stages one after the other; what is finished stays finished when a later one fails.

    Args:
        stages: In order.
        session: On which device, and whether interrupted ones are continued.
        say: Is told which stage begins, and which of its settings have changed since it last ran.

    Raises:
        RomnavError: A stage cannot do or write what it should, or cannot be made on the device.
    """
    stages = list(stages)
    require_device(stages, session)
    # looked up now: another commit may be checked out before a long stage ends
    if records.provenance()["commit"] == records.UNKNOWN:
        say(f"{records.ROOT}: git does not tell the commit, recorded as unknown; see what `git status` says there")
    for stage in stages:
        changed = "; ".join(records.differences(stage))
        say(f"{stage.name} (changed: {changed})" if changed else stage.name)
        try:
            with _locked(stage, say) as late:
                there = records.retrieve(stage) or late
                if there and session.resume and records.finished(stage):
                    say(f"{stage.name} is there")
                else:
                    _make(stage, session)
        except OSError as error:
            if error.errno not in files.HINTS:
                raise
            raise files.unwritable(Path(error.filename or stage.folder), error) from error


def follow(targets: Iterable[Stage], session: Session) -> None:
    """In a process that is not the first of several: makes what that one calls, with it, until it lets go."""
    known = {stage.name: stage for stage in targets}
    while (name := ranks.hear()) is not None:
        known[name].make(known[name], session, lambda done, total, metric: None)


def _make(stage: Stage, session: Session) -> None:
    started = time.monotonic()
    old, record = records.read(stage), records.begin(stage, session.resume)
    if stage.shared:
        ranks.call(stage.name)
    with bar(stage.name) as progress:
        facts = stage.make(stage, session, progress)
    records.finish(stage, record, old, facts, time.monotonic() - started)


def start_over(stages: Iterable[Stage], say: Callable[[str], None]) -> None:
    """Drops what there is of the runs of stages before they are executed elsewhere; runs with other settings stay."""
    for stage in stages:
        with _locked(stage, say):
            records.retrieve(stage)
            records.begin(stage, resume=False)


def _locked(stage: Stage, say: Callable[[str], None]) -> AbstractContextManager[bool]:
    """Holds the lock of a stage; tells whether another process held it before."""

    def tell(holder: str) -> None:
        say(f"{stage.name}: waiting for {holder}, which makes it")

    return held(stage.record.with_name(f".{stage.record.name}.lock"), tell)
