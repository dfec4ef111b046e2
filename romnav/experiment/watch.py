"""Training runs as they go: read from what each writes, so that it does not matter who started them, or where."""

from __future__ import annotations

import csv
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from romnav.experiment.workspace import Workspace

RECENT = 20
"""Last iterations over which speed and success are measured."""
BLOCKS = "▁▂▃▄▅▆▇█"
STOPPED = 600.0
"""A run that has not written its curve for so long does not run, s."""


@dataclass(frozen=True)
class Run:
    """One arm with one training seed."""

    name: str
    iterations: int
    total: int
    """Iterations that it is to take."""
    steps: float
    """Environment steps so far."""
    rate: float
    """Environment steps per second, lately."""
    left: float
    """Time that it still takes at this rate, s."""
    success: tuple[float, float, float]
    """Of the episodes that ended lately: all, same level, cross level, in 0..1; NaN where none ended."""
    curve: tuple[float, ...]
    """Success of every iteration, in 0..1."""
    age: float
    """Time since its curve was written, s."""

    @property
    def state(self) -> str:
        """finished, running or stopped."""
        return "finished" if self.iterations >= self.total else "running" if self.age < STOPPED else "stopped"


def runs(work: Workspace, arms: Sequence[str] = ()) -> list[Run]:
    """The training runs of a scale that have begun, of ``arms`` only if any are named."""
    curves = sorted(work.folder.glob("*/seed-*/curve.csv"))
    found = [_read(curve) for curve in curves if not arms or curve.parts[-3] in arms]
    return [run for run in found if run]


def _read(curve: Path) -> Run | None:
    """None where nothing can be said yet: files are read while they are written."""
    try:
        rows = [{k: float(v) for k, v in row.items()} for row in csv.DictReader(curve.open(encoding="utf-8"))]
        ppo = json.loads(curve.with_name("spec.json").read_text("utf-8"))["spec"]["navigation"]["ppo"]
        total, age = ppo["iterations"] * ppo.get("stages", 1), time.time() - curve.stat().st_mtime
        last, before = rows[-1], rows[max(0, len(rows) - 1 - RECENT)]
        spent = last["seconds"] - before["seconds"]
        rate = (last["steps"] - before["steps"]) / spent if spent > 0 else float("nan")
        iterations = int(last["iteration"])
        lately = rows[-RECENT:]
        return Run(
            name=f"{curve.parts[-3]}, seed {curve.parts[-2].removeprefix('seed-')}",
            iterations=iterations,
            total=total,
            steps=last["steps"],
            rate=rate,
            left=(total - iterations) * last["steps"] / iterations / rate,
            success=(_mean(lately, "success"), _mean(lately, "same"), _mean(lately, "cross")),
            curve=tuple(row["success"] for row in rows),
            age=age,
        )
    except (OSError, ValueError, TypeError, KeyError, IndexError, ZeroDivisionError):
        return None


def _mean(rows: Sequence[dict[str, float]], column: str) -> float:
    """Of the iterations in which episodes ended."""
    values = [row[column] for row in rows if row["episodes"] and row[column] == row[column]]
    return sum(values) / len(values) if values else float("nan")


def sparkline(values: Sequence[float], width: int = 30) -> str:
    """Values in 0..1 as blocks, the mean of equal parts of them each."""
    known = [value for value in values if value == value]
    parts = [known[k * len(known) // width : (k + 1) * len(known) // width] for k in range(width)]
    means = [sum(part) / len(part) for part in parts if part]
    return "".join(BLOCKS[min(int(mean * len(BLOCKS)), len(BLOCKS) - 1)] for mean in means)
