"""Pictures of the parts at work."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.cli.conftest import edit, fails, romnav


@pytest.mark.parametrize("tile", ["-1", str(2**16 + 1), str(10**40), "1.5", "nan", "one", ""])
def test_a_tile_is_a_number_in_its_range(project: Path, tile: str) -> None:
    result = romnav("play", "world", "--tile", tile)
    assert result.exit_code == 2
    assert isinstance(result.exception, SystemExit)
    assert result.stderr.count("Invalid value for '--tile'") == 1
    assert result.stdout == ""
    assert not (project / "results").exists()


def test_the_first_picture_of_a_project_makes_its_folder(project: Path) -> None:
    edit(project / "experiments" / "scales" / "smoke.toml", "[world]", '[world]\nside = 20.0\nclasses = ["room"]')
    assert romnav("play", "world", "--tile", str(2**16)).exit_code == 0
    assert (project / "results" / "smoke" / "figures" / f"world-0-{2**16}.png").stat().st_size > 1000


@pytest.mark.parametrize("what", ["world", "locomotion"])
def test_a_picture_that_cannot_be_written_is_one_clear_error(project: Path, what: str) -> None:
    (project / "results").touch()
    assert "cannot be written" in fails("play", what)
