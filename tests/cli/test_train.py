"""Training one part."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.cli.conftest import edit, romnav


@pytest.mark.slow
def test_locomotion_is_trained_continued_and_recorded(project: Path) -> None:
    edit(project / "experiments" / "scales" / "smoke.toml", "iterations = 60", "iterations = 1")
    edit(project / "experiments" / "scales" / "smoke.toml", "robots = 128", "robots = 16")
    assert romnav("train", "locomotion").exit_code == 0
    assert "nothing to do" in romnav("train", "locomotion").stderr
    record = json.loads((project / "results" / "smoke" / "locomotion" / "policy.json").read_text())
    assert record["facts"]["iterations"] == 1
    edit(project / "experiments" / "scales" / "smoke.toml", "iterations = 1 ", "iterations = 2 ")
    assert romnav("train", "locomotion").exit_code == 0
    curve = (project / "results" / "smoke" / "locomotion" / "curve.csv").read_text().splitlines()
    assert len(curve) == 3
    assert romnav("play", "locomotion").exit_code == 0
    assert (project / "results" / "smoke" / "figures" / "locomotion-stairs-low.png").stat().st_size > 1000
    edit(project / "experiments" / "scales" / "smoke.toml", "robots = 16", "robots = 32")
    refused = romnav("train", "locomotion")
    assert refused.exit_code == 1
    assert "trained by another specification; use another directory or --no-resume" in refused.stderr
