from __future__ import annotations

import shutil
from pathlib import Path

from tests.cli.conftest import ROOT, fails, romnav


def test_every_run_is_a_row_with_its_time_left(project: Path) -> None:
    for arm in ("rom", "uniform-nocap"):
        shutil.copytree(ROOT / "results" / "cpu" / arm, project / "results" / "cpu" / arm)
    result = romnav("watch", "--scale", "cpu", "--once")
    assert result.exit_code == 0, result.output
    assert "rom" in result.stdout
    assert "uniform-nocap" in result.stdout


def test_nothing_to_watch_is_one_line(project: Path) -> None:
    assert "no training run has begun" in fails("watch", "--once")


def test_a_name_that_is_no_arm_to_train_is_one_line(project: Path) -> None:
    assert fails("watch", "romm", "--once") == "unknown arm romm; did you mean rom?"
    assert "arm oracle is a script: there is nothing to train" in fails("watch", "rom", "oracle", "--once")
