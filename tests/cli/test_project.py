"""What the project holds."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from romnav.world import build
from tests.cli.conftest import edit, fails, romnav


def test_list_names_experiments_arms_and_what_is_evaluated(evaluated: Path) -> None:
    lines = romnav("list").stdout.splitlines()
    files = [file.stem for file in sorted((evaluated / "experiments").glob("*.toml"))]
    assert [line.split(":")[0] for line in lines if not line.startswith(" ")] == files
    assert ["rom", "RoM", "smoke:", "seed", "0"] in [line.split() for line in lines]
    assert ["uniform-nocap", "UniformNoCap"] in [line.split() for line in lines]


def test_columns_of_the_list_are_as_wide_as_their_longest_name(evaluated: Path) -> None:
    arm = "an-arm-with-a-name-of-many-letters"
    edit(evaluated / "experiments" / "spawn-goal.toml", "[arms.nocap]", f"[arms.{arm}]")
    lines = [line for line in romnav("list").stdout.splitlines() if line.startswith("  ")]
    (named,) = (line for line in lines if arm in line)
    label, where = named.index("NoCap"), next(line.index("smoke:") for line in lines if "smoke:" in line)
    assert label > len(f"  {arm}")
    assert all(line[label - 1] == " " and line[label] != " " for line in lines)
    assert {line.index("smoke:") for line in lines if "smoke:" in line} == {where}


def test_metrics_have_names_units_and_directions(project: Path) -> None:
    lines = romnav("list", "metrics").stdout.splitlines()
    assert "t2g         T2G: mean time to goal over successful episodes (s, lower is better)" in lines
    assert fails("list", "metrcs") == "there is no list of metrcs; did you mean metrics?"


def test_list_shows_the_others_beside_a_broken_file(evaluated: Path) -> None:
    broken = evaluated / "experiments" / "stair-limits.toml"
    edit(broken, "title =", "titel =")
    (evaluated / "results" / "smoke" / "rom" / "seed-0.bak").mkdir()
    (evaluated / "results" / "smoke" / "rom" / "seed-0.bak" / "episodes.parquet").write_bytes(b"old")
    listed = romnav("list")
    assert listed.exit_code == 1
    assert listed.stderr.splitlines() == [f"error: {broken}: key title is missing"]
    assert ["rom", "RoM", "smoke:", "seed", "0"] in [line.split() for line in listed.stdout.splitlines()]
    assert romnav("results").exit_code == 0
    assert romnav("tables", "spawn-goal").exit_code == 0
    assert romnav("tables").stderr.splitlines()[-1] == f"error: {broken}: key title is missing"


def test_an_episode_set_that_cannot_be_written_is_refused_before_it_is_drawn(
    project: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.rmtree(project / "experiments" / "episodes")
    (project / "experiments" / "episodes").touch()
    monkeypatch.setattr(build, "build", None)
    assert "new.json: cannot be written (file exists)" in fails("episodes", "new")
