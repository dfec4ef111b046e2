"""What TensorBoard and W&B are told is what the curve says."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rsl_rl.utils import wandb_log_writer
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from romnav.errors import RomnavError
from romnav.journal import EVENTS, Journal


def told(folder: Path) -> dict[str, list[tuple[int, float]]]:
    events = EventAccumulator(str(folder))
    events.Reload()
    return {tag: [(e.step, e.value) for e in events.Scalars(tag)] for tag in events.Tags()["scalars"]}


def row(steps: int, **more: float) -> dict[str, float]:
    return {
        "iteration": steps // 10,
        "steps": steps,
        "success": 0.5,
        "reward_position": 0.25,
        "loss_value": 2.0,
        **more,
    }


def test_a_resumed_run_is_told_once(tmp_path: Path) -> None:
    """What was written beyond the checkpoint is passed over, what came before it stays."""
    first = Journal(tmp_path, 0)
    for steps in (10, 20, 30):
        first.add(steps, row(steps))
    first.close()
    second = Journal(tmp_path, 10)
    for steps in (20, 30, 40):
        second.add(steps, row(steps, success=0.75))
    second.close()
    assert told(tmp_path)["success/all"] == [(10, 0.5), (20, 0.75), (30, 0.75), (40, 0.75)]


def test_a_run_that_starts_over_tells_nothing_of_the_old_one(tmp_path: Path) -> None:
    for value in (0.5, 0.75):
        journal = Journal(tmp_path, 0)
        journal.add(10, row(10, success=value))
        journal.close()
    assert len(list(tmp_path.glob(EVENTS))) == 1
    assert told(tmp_path)["success/all"] == [(10, 0.75)]


def test_what_is_no_number_is_left_out(tmp_path: Path) -> None:
    journal = Journal(tmp_path, 0)
    journal.add(10, row(10, success=math.nan))
    journal.close()
    seen = told(tmp_path)
    assert "success/all" not in seen
    assert seen["loss/value"] == [(10, 2.0)]


class FakeWandb:
    """Remembers what it is told."""

    def __init__(self) -> None:
        self.run = SimpleNamespace(name="")
        self.logged: list[tuple[int, dict[str, float]]] = []
        self.finished = False

    def init(self, project: str, **settings: Any) -> None:
        self.project = project

    def log(self, values: dict[str, float], step: int) -> None:
        self.logged.append((step, values))

    def finish(self) -> None:
        self.finished = True


def test_weights_and_biases_are_told_where_their_project_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fake = FakeWandb()
    monkeypatch.setattr(wandb_log_writer, "wandb", fake)
    monkeypatch.setenv("WANDB_PROJECT", "stairs")
    folder = tmp_path / "cpu" / "rom" / "seed-0"
    journal = Journal(folder, 0)
    journal.add(10, row(10))
    journal.close()
    assert (fake.project, fake.run.name, fake.finished) == ("stairs", "cpu/rom/seed-0", True)
    assert (10, {"reward/position": 0.25}) in fake.logged
    assert told(folder)["reward/position"] == [(10, 0.25)]


def test_without_wandb_it_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wandb_log_writer, "wandb", None)
    monkeypatch.setenv("WANDB_PROJECT", "stairs")
    with pytest.raises(RomnavError, match=r"WANDB_PROJECT is set, but wandb is not installed; `pip install"):
        Journal(tmp_path, 0)
