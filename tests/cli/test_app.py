"""What holds for all commands."""

from __future__ import annotations

import resource
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from romnav.experiment.graph import run
from tests.cli.conftest import ROOT, edit, fails, romnav

HEAVY = {"torch", "warp", "mujoco", "pandas", "pyarrow", "scipy", "matplotlib", "pydantic"}


def test_help_is_quick_and_imports_nothing_heavy() -> None:
    code = f"import sys, romnav.cli; print(*({HEAVY!r} & {{*sys.modules}}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""
    times = []
    for _ in range(3):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([sys.executable, ROOT / "cli.py", "--help"], capture_output=True, check=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        times.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    assert min(times) < 0.4  # s of processor time: the same on a busy machine


@pytest.mark.parametrize(
    "words",
    [
        [],
        ["run"],
        ["run", "ablation"],
        ["run", "safety"],
        ["train"],
        ["train", "locomotion"],
        ["train", "gaits"],
        ["eval"],
        ["play", "world"],
        ["play", "locomotion"],
    ],
)
def test_every_command_explains_itself(words: list[str]) -> None:
    result = romnav(*words, "--help")
    assert result.exit_code == 0
    assert "Usage" in result.stdout


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["run", "ablation", "spawn-gaol"], "unknown experiment spawn-gaol; did you mean spawn-goal?"),
        (["run", "ablation", "spawn-goal", "--scale", "smok"], "unknown scale smok; did you mean smoke?"),
        (["run", "safety", "safty"], "unknown experiment safty; did you mean safety?"),
        (["train", "policy", "unifrom"], "unknown arm unifrom; did you mean uniform?"),
        (["train", "encoder", "--device", "cdua"], "device cdua: "),
        (["train", "encoder", "lidra"], "unknown sensor lidra; did you mean lidar?"),
        (["bench", "nothing-like-it"], "unknown benchmark nothing-like-it; there are"),
    ],
)
def test_a_typo_names_the_nearest(project: Path, words: list[str], message: str) -> None:
    (project / "benchmarks").mkdir()
    (project / "benchmarks" / "lidar.py").touch()
    assert fails(*words).startswith(message)
    assert not (project / "results").exists()


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("scales/smoke.toml", "rows =", "rosw =", "unknown key lidar.rosw; did you mean rows?"),
        ("scales/smoke.toml", "rows = 15", 'rows = "15"', "key lidar.rows: input should be a valid integer"),
        ("scales/smoke.toml", "[lidar]", "[lidra]", "unknown key lidra; did you mean lidar?"),
        ("spawn-goal.toml", ".cap =", ".capp =", "unknown key arms.nocap.navigation.env.sampler.capp; did"),
        ("spawn-goal.toml", "title =", "titel =", "key title is missing"),
    ],
)
def test_a_wrong_specification_names_file_and_key(project: Path, file: str, old: str, new: str, message: str) -> None:
    edit(project / "experiments" / file, old, new)
    assert fails("run", "ablation", "spawn-goal").startswith(f"{project / 'experiments' / file}: {message}")
    assert not (project / "results").exists()


def test_outside_of_a_project_there_is_one_clear_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert "no experiments/ here or above" in fails("list")


def test_control_c_says_how_to_go_on(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*arguments: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(run, "execute", interrupted)
    monkeypatch.setattr(sys, "argv", ["romnav", "train", "encoder", "--no-resume"])
    result = romnav("train", "encoder", "--no-resume")
    assert result.exit_code == 130
    assert result.stderr.splitlines()[-1] == "stopped; what is done is kept, go on with: romnav train encoder"


def test_an_export_is_onnx_be_it_asked_for_or_not(project: Path) -> None:
    told = romnav("export", "--help").stdout
    assert ("ONNX" in told, "--onnx" in told) == (True, False)
    assert "policy rom, seed 0 is missing" in (message := fails("export", "rom"))
    assert fails("export", "rom", "--onnx") == message
