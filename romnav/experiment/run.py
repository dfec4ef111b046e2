"""Runs stages: only those whose output is missing or out of date, each with its progress and its record."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterable, Mapping
from pathlib import Path
from typing import Any

from romnav import files
from romnav.errors import RomnavError
from romnav.experiment import store
from romnav.experiment.plan import Stage
from romnav.progress import Progress, bar

Action = Callable[[Stage, Progress], dict[str, Any]]
"""Makes the output of a stage and returns facts worth recording, e.g. its training steps."""


EVERYTHING = (
    *("encoder", "quality", "locomotion", "terrain", "gaits", "policy", "navigation"),
    *("episodes", "trials", "tables", "curves", "report"),
)
"""Kinds of stages."""


def pending(targets: Iterable[Stage], again: Collection[str] = ()) -> list[Stage]:
    """The stages that must run for the targets to be finished, in order.

    A stage whose output is gone runs only where another one has to read it. Stages of a kind in ``again`` run
    even if they are finished, and so do those that need them.
    """
    runs: dict[str, bool] = {}
    ordered: list[Stage] = []

    def forced(stage: Stage) -> bool:
        return stage.kind in again or any(map(forced, stage.upstream))

    def visit(stage: Stage) -> None:
        if stage.name in runs:
            return
        runs[stage.name] = forced(stage) or not store.finished(stage)
        if runs[stage.name]:
            for above in stage.upstream:
                visit(above)
            ordered.append(stage)

    for target in targets:
        visit(target)
    return ordered


def require_trained(evaluations: Iterable[Stage]) -> None:
    """Checks that the policies to evaluate are there and were trained with the present settings.

    Raises:
        RomnavError: One is not.
    """
    for policy in (stage for evaluation in evaluations for stage in evaluation.upstream if stage.kind == "policy"):
        if not store.finished(policy):
            changed = "; ".join(store.differences(policy))
            if changed:
                reason = f"was trained with other settings ({changed})"
            elif policy.record.exists():
                reason = "is unfinished, or its encoder has changed since"
            else:
                reason = "is not trained"
            raise RomnavError(f"{policy.folder}: {policy.name} {reason}; run `romnav train policy {policy.arm}`")


def require_walking(stages: Collection[Stage]) -> None:
    """Checks that none of the stages to run needs a locomotion policy that would have to be trained first.

    Raises:
        RomnavError: One does; that training takes hours, so nobody should begin it by accident.
    """
    missing = {stage.name: stage for stage in stages if stage.kind == "locomotion"}
    for stage in stages:
        for walked in stage.upstream:
            if stage.kind in ("policy", "episodes", "trials", "navigation") and walked.name in missing:
                changed = "; ".join(store.differences(walked))
                reason = f"was trained with other settings ({changed})" if changed else "is not trained to the end"
                raise RomnavError(
                    f"{walked.folder}: the policy that walks the robots of {stage.name} {reason}; "
                    "run `romnav train locomotion`"
                )


def execute(
    stages: Iterable[Stage],
    actions: Mapping[str, Action],
    resume: bool = True,
    say: Callable[[str], None] = lambda line: None,
) -> None:
    """Runs stages one after the other; what is finished stays finished when a later one fails.

    Args:
        stages: In order.
        actions: What makes the output, by the kind of the stage.
        resume: Continue an interrupted stage rather than start it over.
        say: Is told which stage begins, and which of its settings have changed since it last ran.

    Raises:
        RomnavError: A stage cannot do or write what it should.
    """
    store.provenance()  # looks up the commit now: another may be checked out before a long stage ends
    for stage in stages:
        changed = "; ".join(store.differences(stage))
        say(f"{stage.name} (changed: {changed})" if changed else stage.name)
        started = time.monotonic()
        try:
            record = store.begin(stage, resume)
            with bar(stage.name) as progress:
                facts = actions[stage.kind](stage, progress)
        except OSError as error:
            if error.errno not in files.HINTS:
                raise
            raise files.unwritable(Path(error.filename or stage.folder), error) from error
        store.finish(stage, record, facts, time.monotonic() - started)
