"""Runs independent stages side by side, each in a process of its own on its share of this machine's cores."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed

from romnav import stopping
from romnav.errors import RomnavError
from romnav.experiment.graph.run import execute, waves
from romnav.experiment.graph.stage import Session, Stage
from romnav.progress import lines
from romnav.threads import cores


def execute_side_by_side(stages: Iterable[Stage], session: Session, say: Callable[[str], None]) -> None:
    """Runs stages on the CPU, those that have a command of their own as many at a time as there are cores: a thread
    each does more than sharing them.

    Raises:
        RomnavError: A stage cannot do or write what it should.
    """
    over = [] if session.resume else ["--no-resume"]
    for wave in waves(stages):
        commands = {stage.name: [*stage.command, *over] for stage in wave if stage.command}
        if commands:
            side_by_side(commands, cores())
        execute([stage for stage in wave if not stage.command], session, say)


def side_by_side(commands: Mapping[str, Sequence[str]], workers: int) -> None:
    """Run ``romnav`` command lines by the name of their stage, at most ``workers`` at a time.

    Their progress shows as one line each. When one fails, the others are stopped; what they have done is kept. They end
    with this process, however it ends.

    Raises:
        RomnavError: With the message of the first command that failed.
    """
    running: list[subprocess.Popen[str]] = []
    stop = threading.Event()

    def run(name: str, arguments: Sequence[str]) -> None:
        if stop.is_set():
            return
        command = [sys.executable, "-m", "romnav.cli", *arguments]
        environment = {**stopping.child(), "OMP_NUM_THREADS": "1"}
        with subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            env=environment,
        ) as process:
            running.append(process)
            if stop.is_set():  # since the look above
                process.terminate()
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
            for future in as_completed(futures):
                future.result()
        except BaseException:
            stop.set()
            for process in running:
                process.terminate()
            raise
