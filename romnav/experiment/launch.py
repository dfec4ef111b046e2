"""Runs independent stages side by side, each in a process of its own on its share of this machine's cores."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

from romnav.errors import RomnavError
from romnav.experiment.plan import Plan, Stage
from romnav.progress import lines

COMMANDS = {"policy": ("train", "policy"), "episodes": ("eval",)}
"""Command that makes the output of a kind of stage, given the arm."""


def stages_side_by_side(plan: Plan, stages: Sequence[Stage], resume: bool) -> None:
    """Train or evaluate arms, as many at a time as there are cores: a thread each does more than sharing them.

    Raises:
        RomnavError: One of them failed.
    """
    options = ["--scale", plan.scale.name, *([] if resume else ["--no-resume"])]
    elsewhere = plan.project.results != plan.project.root / "results"
    where = ["--results", str(plan.project.results)] if elsewhere else []
    for wave in waves(stages):
        commands = {s.name: [*where, *COMMANDS[s.kind], str(s.arm), "--seed", str(s.seed), *options] for s in wave}
        side_by_side(commands, os.cpu_count() or 1)


def waves(stages: Sequence[Stage]) -> list[list[Stage]]:
    """Stages in the order of their waves: each needs none of its own wave or of a later one."""
    left, done = list(stages), list[list[Stage]]()
    while left:
        names = {stage.name for stage in left}
        ready = [stage for stage in left if not names & {above.name for above in stage.upstream}]
        done.append(ready)
        left = [stage for stage in left if stage not in ready]
    return done


def side_by_side(commands: Mapping[str, Sequence[str]], workers: int) -> None:
    """Run ``romnav`` command lines by the name of their stage, at most ``workers`` at a time.

    Their progress shows as one line each. When one fails, the others are stopped; what they have done is kept.

    Raises:
        RomnavError: With the message of the first command that failed.
    """
    running: list[subprocess.Popen[str]] = []
    stop = threading.Event()

    def run(name: str, arguments: Sequence[str]) -> None:
        if stop.is_set():
            return
        command = [sys.executable, "-m", "romnav.cli", *arguments]
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        with subprocess.Popen(
            command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, env=environment
        ) as process:
            running.append(process)
            last = ""
            assert process.stderr is not None
            for line in process.stderr:
                last = line.strip() or last
                show(name, last)
        if process.returncode and not stop.is_set():
            stop.set()
            raise RomnavError(last.removeprefix("error: ") or f"{name}: ended with status {process.returncode}")

    with lines(list(commands)) as show, ThreadPoolExecutor(workers) as pool:
        futures = [pool.submit(run, name, arguments) for name, arguments in commands.items()]
        try:
            for future in futures:
                future.result()
        except BaseException:
            stop.set()
            for process in running:
                process.terminate()
            raise
