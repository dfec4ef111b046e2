"""Options that many commands take."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from romnav import __version__
from romnav.evaluation.paired import rows
from tests.cli.conftest import ROOT, fails, romnav


@pytest.mark.parametrize(
    "words",
    [
        ("--scale", "cpu", "--results", "elsewhere", "results"),
        ("results", "--scale", "cpu", "--results", "elsewhere"),
        ("--scale", "cpu", "results", "--results", "elsewhere"),
        ("--scale", "smoke", "--results", "nowhere", "results", "--scale", "cpu", "--results", "elsewhere"),
        ("--results", "nowhere", "results", "--scale", "cpu", "--results", "elsewhere"),
    ],
    ids=" ".join,
)
def test_common_options_hold_before_and_behind_the_command(
    project: Path, words: tuple[str, ...], episode_rows: Callable[..., rows.EpisodeRows]
) -> None:
    for scale, skill in {"cpu": 1.0, "smoke": 0.1}.items():
        file = project / "elsewhere" / scale / "rom" / "seed-0" / "episodes.parquet"
        rows.write(file, episode_rows("rom", skill, scale=scale))
    result = romnav(*words)
    assert result.exit_code == 0, result.output
    assert "scale cpu" in result.stdout


def test_a_default_behind_the_command_holds_over_what_stands_before_it(project: Path) -> None:
    assert f"{project / 'results' / 'smoke'}: no arm" in fails("--scale", "cpu", "results", "--scale", "smoke")
    assert f"{project / 'results' / 'cpu'}: no arm" in fails("--scale", "cpu", "results")


def test_the_version_is_told() -> None:
    assert romnav("--version").stdout == f"romnav {__version__}\n"


@pytest.mark.parametrize(
    ("words", "names"),
    [
        ("romnav train policy u", {"uniform", "uniform-nocap", "unfrozen"}),
        ("romnav run ablation sp", {"spawn-goal"}),
        ("romnav results --scale c", {"cpu"}),
        ("romnav eval or", {"oracle", "oracle-hum"}),
    ],
)
def test_the_shell_completes_names(project: Path, words: str, names: set[str]) -> None:
    asked = {"_ROMNAV_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": str(len(words.split()) - 1)}
    program = "import sys; sys.argv[0] = 'romnav'; from romnav.cli import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", program],
        env={**os.environ, "PYTHONPATH": str(ROOT), **asked},
        capture_output=True,
        text=True,
        cwd=project,
    )
    assert {*done.stdout.split()} == names, done.stderr
