"""What the project holds."""

from __future__ import annotations

from pathlib import Path

from tests.cli.conftest import fails, romnav


def test_list_names_experiments_arms_and_what_is_evaluated(evaluated: Path) -> None:
    lines = romnav("list").stdout.splitlines()
    files = [file.stem for file in sorted((evaluated / "experiments").glob("*.toml"))]
    assert [line.split(":")[0] for line in lines if not line.startswith(" ")] == files
    assert ["rom", "RoM", "smoke:", "seed", "0"] in [line.split() for line in lines]
    assert ["uniform-nocap", "UniformNoCap"] in [line.split() for line in lines]


def test_metrics_have_names_units_and_directions(project: Path) -> None:
    lines = romnav("list", "metrics").stdout.splitlines()
    assert "t2g         T2G: mean time to goal over successful episodes (s, lower is better)" in lines
    assert fails("list", "metrcs") == "there is no list of metrcs; did you mean metrics?"
