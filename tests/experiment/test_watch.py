from __future__ import annotations

import json
import math
import os
from pathlib import Path

import pytest

from romnav.experiment import watch
from romnav.experiment.project import Project
from romnav.experiment.workspace import Workspace

ROOT = Path(__file__).parents[2]


@pytest.fixture
def work(tmp_path: Path) -> Workspace:
    return Workspace(Project(ROOT, tmp_path), "smoke")


def begin(work: Workspace, arm: str, iterations: int, age: float = 0.0) -> Path:
    """A run of 40 iterations, 100 steps and 2 s each, in which success grows by a percent an iteration."""
    folder = work.folder / arm / "seed-0"
    folder.mkdir(parents=True)
    (folder / "spec.json").write_text(json.dumps({"spec": {"navigation": {"ppo": {"iterations": 40}}}}))
    lines = ["iteration,steps,seconds,episodes,success,same,cross"]
    lines += [f"{k},{100 * k},{2 * k},10,{k / 100},{k / 50},nan" for k in range(1, iterations + 1)]
    curve = folder / "curve.csv"
    curve.write_text("\n".join(lines) + "\n")
    os.utime(curve, (curve.stat().st_mtime - age,) * 2)
    return curve


def test_speed_time_left_and_success_are_those_of_the_latest_iterations(work: Workspace) -> None:
    begin(work, "rom", 30)
    (run,) = watch.runs(work)
    assert (run.name, run.iterations, run.total, run.steps, run.state) == ("rom, seed 0", 30, 40, 3000, "running")
    assert run.rate == pytest.approx(50.0)
    assert run.left == pytest.approx(10 * 2.0)
    assert run.success[0] == pytest.approx(sum(range(11, 31)) / 20 / 100)
    assert run.success[1] == pytest.approx(2 * run.success[0])
    assert math.isnan(run.success[2])


def test_runs_end_and_stop_and_are_chosen_by_arm(work: Workspace) -> None:
    begin(work, "rom", 40, age=9e9)
    begin(work, "nocap", 10, age=watch.STOPPED + 60)
    assert {run.name: run.state for run in watch.runs(work)} == {"rom, seed 0": "finished", "nocap, seed 0": "stopped"}
    assert [run.name for run in watch.runs(work, ["nocap"])] == ["nocap, seed 0"]


def test_files_that_are_being_written_are_passed_over(work: Workspace) -> None:
    curve = begin(work, "rom", 3)
    for text in ("", "iteration,steps\n", "iteration,steps,seconds,episodes,success,same,cross\n1,100"):
        curve.write_text(text)
        assert watch.runs(work) == []


def test_sparkline_rises_with_its_values() -> None:
    assert watch.sparkline([k / 29 for k in range(30)], 8) == watch.BLOCKS
    assert watch.sparkline([0.0, math.nan, 1.0], 2) == "▁█"
    assert watch.sparkline([]) == ""
