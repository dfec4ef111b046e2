"""A project with one scale."""

from __future__ import annotations

from pathlib import Path

from romnav.experiment.project import Project
from romnav.experiment.workspace import Workspace


def workspace(root: Path, scale: str) -> Workspace:
    """A new project in ``root`` at a scale with this text."""
    folder = root / "experiments" / "scales"
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "tiny.toml").write_text(scale)
    return Workspace(Project(root, root / "results"), "tiny")
