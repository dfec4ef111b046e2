"""A project to run commands in, and how to run them."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from romnav.cli import app
from romnav.evaluation.paired import rows

ROOT = Path(__file__).parents[2]


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A project with this one's experiments and no results; it is the current folder."""
    shutil.copytree(ROOT / "experiments", tmp_path / "experiments")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def evaluated(project: Path, episode_rows: Callable[..., rows.EpisodeRows]) -> Path:
    """A project whose arms have episode rows."""
    for arm, skill in {"rom": 0.8, "uniform": 0.6, "nocap": 0.5, "oracle": 1.0, "straight": 0.2}.items():
        rows.write(project / "results" / "smoke" / arm / "seed-0" / "episodes.parquet", episode_rows(arm, skill))
    return project


def romnav(*words: str) -> Any:
    return CliRunner().invoke(app, words)


def fails(*words: str) -> str:
    """The one line of a user's error."""
    result = romnav(*words)
    assert result.exit_code == 1, result.output
    assert result.stdout == ""
    (line,) = result.stderr.splitlines()
    assert line.startswith("error: ")
    return line.removeprefix("error: ")


def edit(file: Path, old: str, new: str) -> None:
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))
