"""Runs stages as tasks of a Ray cluster, whose machines share the project's folder."""

from __future__ import annotations

import contextlib
import io
import os
import sys
import threading
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

from romnav.errors import RomnavError
from romnav.experiment.graph.run import execute, require_device, start_over
from romnav.experiment.graph.stage import Session, Stage
from romnav.progress import lines

RETRIES = 10
"""Times that a stage whose machine has died goes on elsewhere."""
GRACE = 60.0
"""What stages get to end an iteration and save when they are stopped, s."""


class Queue(Protocol):
    """Where (stage, line of progress) arrive from tasks."""

    def get(self) -> tuple[str, str] | None:
        """Wait for the next; None is the last."""
        ...


def execute_on_ray(
    address: str, needs: Mapping[str, float], stages: Iterable[Stage], session: Session, say: Callable[[str], None]
) -> None:
    """Runs stages as soon as those that they need are done, as many at a time as the cluster holds.

    A stage whose worker dies goes on from its checkpoint on another one. When a stage fails, or at Ctrl-C, the others
    save and are stopped; what they have done is kept.

    Args:
        address: ``ray`` joins the cluster that ``RAY_ADDRESS`` names, or starts one here; ``ray://host:port`` joins
            that one.
        needs: What a stage takes of a machine: ``num_cpus``, ``num_gpus`` and ``memory`` in bytes.
        stages: Upstream ones first.
        session: On which device, and whether interrupted ones are continued.
        say: Is told which stages begin.

    Raises:
        RomnavError: Another engine; Ray is not installed or cannot be reached; a stage cannot do or write what it
            should, or cannot be made on the device.
    """
    if address != "ray" and not address.startswith("ray://"):
        raise RomnavError(f"--on {address}: no engine; give ray or ray://host:port")
    stages = list(stages)
    require_device(stages, session)
    try:
        import ray
        from ray.util.queue import Queue as RayQueue
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy
    except ImportError as error:
        raise RomnavError("--on ray: Ray is not installed; run `pip install 'romnav[ray]'`") from error
    if not session.resume:
        start_over(stages, say)
        session = replace(session, resume=True)  # a stage that goes on elsewhere must not start over
    try:
        ray.init(address if address != "ray" else None, log_to_driver=False, logging_level="ERROR")
    except (ConnectionError, ValueError, RuntimeError) as error:
        raise RomnavError(f"--on {address}: {str(error).splitlines()[0]}; is the cluster there?") from error
    try:
        here = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=True)
        queue = RayQueue(actor_options={"num_cpus": 0, "scheduling_strategy": here})
        task = ray.remote(**needs, max_retries=RETRIES)(_run)
        running: dict[str, Any] = {}
        for stage in stages:
            above = [running[other.name] for other in stage.upstream if other.name in running]
            running[stage.name] = task.options(name=stage.name).remote(
                stage, session, queue.actor, Path.cwd(), sys.argv, *above
            )
            say(stage.name)
        with lines(list(running)) as show:
            shown = threading.Thread(target=_show, args=(queue, show), daemon=True)
            shown.start()
            try:
                _wait(ray, list(running.values()))
            except BaseException:
                _stop(ray, list(running.values()))
                raise
            finally:
                with contextlib.suppress(Exception):  # the cluster may have gone
                    queue.put(None)
                shown.join(5.0)
    finally:
        ray.shutdown()


def _wait(ray: Any, references: list[Any]) -> None:
    while references:
        done, references = ray.wait(references)
        try:
            ray.get(done)
        except ray.exceptions.RayTaskError as error:
            raise error.cause if isinstance(error.cause, RomnavError) else error from None
        except ray.exceptions.RayError as error:
            raise RomnavError(f"--on ray: {str(error).splitlines()[0]}; run it again to go on") from error


def _stop(ray: Any, references: list[Any]) -> None:
    """Interrupts the stages, which save and end; those that do not in time, or at a second Ctrl-C, are killed."""
    late = references
    try:
        for reference in references:
            ray.cancel(reference)
        _, late = ray.wait(references, num_returns=len(references), timeout=GRACE)
    finally:
        for reference in late:
            ray.cancel(reference, force=True)


def _show(queue: Queue, show: Callable[[str, str], None]) -> None:
    with contextlib.suppress(Exception):  # the cluster may go first
        while (item := queue.get()) is not None:
            show(*item)


def _run(stage: Stage, session: Session, queue: Any, folder: Path, command: list[str], *above: None) -> None:
    """In a worker: the stage, once those ``above`` are done; ``queue`` is the queue's actor."""
    os.chdir(folder)
    sys.argv = command
    with contextlib.redirect_stderr(_Lines(stage.name, queue)):
        execute([stage], session)


class _Lines(io.TextIOBase):
    """A stream whose lines go to a queue's actor under the name of a stage.

    Nothing waits for them to arrive: while a task waits, Ray gives its core to another one.
    """

    def __init__(self, name: str, queue: Any) -> None:
        self._name, self._queue, self._rest = name, queue, ""

    def write(self, text: str) -> int:
        *whole, self._rest = (self._rest + text).split("\n")
        for line in filter(None, whole):
            with contextlib.suppress(Exception):  # that nobody is told of it stops no stage
                self._queue.put_nowait.remote((self._name, line))
        return len(text)
