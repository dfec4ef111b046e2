from __future__ import annotations

import csv
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest

from romnav.errors import RomnavError
from romnav.experiment.graph.launch import side_by_side
from tests.experiment.conftest import workspace
from tests.test_stopping import ends

ROOT = Path(__file__).parents[3]
ENDLESS = """
[world]
tiles = 1
side = 20.0
classes = ["building"]
goals_per_tile = 2
[lidar]
rows = 8
columns = 16
[pretrain.encoder]
widths = [8, 8]
strides = [[2, 4], [2, 2]]
latent = 8
[navigation.encoder]
pretrained = false
[navigation.env]
envs = 4
[navigation.policy]
attention = 8
heads = 2
recurrent = 16
hidden = 16
critic = [16]
[navigation.ppo]
iterations = 1000000
keep = 1
steps = 4
epochs = 1
minibatches = 2
"""
PAIR = """
kind = "ablation"
title = "t"
[tables.pair]
kind = "curves"
[arms.one]
label = "One"
[arms.other]
label = "Other"
navigation.ppo.gamma = 0.9
"""


def test_commands_run_in_processes_of_their_own(capfd: pytest.CaptureFixture[str]) -> None:
    side_by_side({"one": ["list"], "two": ["--help"]}, 2)
    assert capfd.readouterr().out == ""


def test_the_first_failure_names_its_reason() -> None:
    with pytest.raises(RomnavError, match="nosuch"):
        side_by_side({"good": ["list"], "bad": ["train", "policy", "nosuch"]}, 1)


def test_a_failure_stops_what_began_before_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))
    (tmp_path / "python").write_text(
        '#!/bin/sh\n[ "$3" = endless ] && exec sleep 300\necho "error: cannot" >&2; exit 1\n'
    )
    (tmp_path / "python").chmod(0o755)
    started = time.monotonic()
    with pytest.raises(RomnavError, match="cannot"):
        side_by_side({"endless": ["endless"], "bad": ["bad"]}, 2)
    assert time.monotonic() - started < 60.0


def wait_for(condition: Callable[[], bool], process: subprocess.Popen[bytes]) -> None:
    """Waits for what happens while a process runs."""
    deadline = time.monotonic() + 300.0
    while not condition():
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.mark.slow
def test_a_killed_ablation_leaves_no_training_and_a_restart_waits_for_what_still_saves(tmp_path: Path) -> None:
    """Trainings that never end by themselves; stopped, they stand for ones that save slowly."""
    here = workspace(tmp_path, ENDLESS)
    here.project.file("pair").write_text(PAIR)
    log = tmp_path / "log"

    def start() -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "romnav.cli", "run", "ablation", "pair", "--scale", "tiny"]
        with log.open("wb") as file:
            environment = {**os.environ, "PYTHONPATH": str(ROOT)}
            return subprocess.Popen(command, cwd=tmp_path, env=environment, stdout=file, stderr=file)

    def trained() -> dict[Path, int]:
        """Iterations of each arm that has begun."""
        return {kept.parent: len([*kept.glob("*.pt")]) for kept in here.folder.glob("*/seed-0/kept")}

    def holders() -> set[int]:
        """Processes that make a stage."""
        return {int(lock.read_text().split()[1]) for lock in here.folder.glob("*/seed-0/.*.lock")}

    first = start()
    wait_for(lambda: len(holders()) == len(trained()) > 0 and min(trained().values()) > 1, first)
    children = holders()
    for child in children:
        os.kill(child, signal.SIGSTOP)
    before = trained()
    begun = {folder: (folder / "kept" / "000001.pt").stat().st_mtime_ns for folder in before}
    first.kill()
    first.wait()
    again = start()
    try:
        wait_for(lambda: all(f"waiting for process {child} on" in log.read_text() for child in children), again)
        assert trained() == before
        for child in children:
            os.kill(child, signal.SIGCONT)
        assert all(ends(child, 60.0) for child in children)
        saved = trained()
        wait_for(lambda: all(trained()[folder] > count + 1 for folder, count in saved.items()), again)
        assert holders().isdisjoint(children)
    finally:
        again.terminate()
        for child in children:
            with suppress(ProcessLookupError):
                os.kill(child, signal.SIGKILL)
        status = again.wait()
    assert status == 128 + signal.SIGTERM
    assert not holders()
    for folder, written in begun.items():
        assert (folder / "kept" / "000001.pt").stat().st_mtime_ns == written  # gone on from there
        with (folder / "curve.csv").open() as file:
            iterations = [int(row["iteration"]) for row in csv.DictReader(file)]
        assert iterations == [*range(1, len(iterations) + 1)]
        assert len(iterations) > saved[folder]
