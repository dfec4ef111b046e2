"""Where the commit in a record comes from."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from romnav import __version__
from romnav.experiment.graph import records


def git(folder: Path, *words: str) -> str:
    identity = ["-c", "user.name=x", "-c", "user.email=x@x"]
    done = subprocess.run(["git", *identity, *words], cwd=folder, check=True, capture_output=True, text=True)
    return done.stdout.strip()


@pytest.fixture
def repository(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A repository with code in it, which is that of the records."""
    (tmp_path / "romnav").mkdir()
    (tmp_path / "romnav" / "code.py").write_text("x = 1\n")
    git(tmp_path, "init", "-q")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-q", "-m", "first")
    monkeypatch.setattr(records, "ROOT", tmp_path)
    return tmp_path


def test_the_commit_tells_of_changed_code(repository: Path) -> None:
    head = git(repository, "rev-parse", "HEAD")
    assert records.commit() == head
    (repository / "romnav" / "code.py").write_text("x = 2\n")
    assert records.commit() == f"{head}-dirty"


def test_code_installed_inside_another_repository_has_its_version_not_that_commit(
    repository: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    installed = repository / ".venv" / "site-packages"
    installed.mkdir(parents=True)
    monkeypatch.setattr(records, "ROOT", installed)
    assert records.commit() == f"v{__version__}"


def test_a_repository_of_another_owner_is_unknown(repository: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GIT_TEST_ASSUME_DIFFERENT_OWNER", "1")
    assert records.commit() == "unknown"
