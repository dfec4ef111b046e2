"""Pictures of the parts at work."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from romnav.evaluation import episodes
from romnav.evaluation.paired import rows
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


@pytest.fixture
def unbuilt(project: Path, episode_rows: Callable[..., rows.EpisodeRows], monkeypatch: pytest.MonkeyPatch) -> Path:
    """A project with rows of the oracle, whose terrain must not be built."""
    of = episodes.load(project / "experiments" / "episodes" / "paired-2.json").digest
    made = episode_rows("oracle", 1.0, episode_set=of)
    rows.write(project / "results" / "smoke" / "oracle" / "seed-0" / "episodes.parquet", made)

    def terrain(*_: Any) -> None:
        raise AssertionError("the terrain was built")

    monkeypatch.setattr(episodes, "terrain", terrain)
    return project


def test_a_wrong_expression_is_refused_before_the_terrain_is_built(unbuilt: Path) -> None:
    message = fails("play", "episodes", "oracle", "--where", "climbb > 3")
    assert message.startswith("--where 'climbb > 3': name 'climbb' is not defined; columns are arm, seed, episode,")


def test_that_no_episode_is_chosen_is_told_before_the_terrain_is_built(unbuilt: Path) -> None:
    result = romnav("play", "episodes", "oracle", "--where", "climb > 1000")
    assert result.exit_code == 0, result.output
    assert result.stdout.endswith("no episode is like that\n")


def test_a_wrong_number_is_refused_before_the_terrain_is_built(unbuilt: Path) -> None:
    film = ("--out", "film.gif")
    assert fails("play", "episode", "oracle", "1024", *film) == "episode 1024: there are 0 to 1023 in paired-2"
    policy = unbuilt / "results" / "smoke" / "rom" / "seed-0" / "policy.pt"
    assert fails("play", "episode", "rom", "3", *film).startswith(f"{policy}: ")


def test_the_viewer_refuses_what_is_wrong_before_the_terrain_is_built(
    unbuilt: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    viewer = SimpleNamespace(Seen=None, Viewer=None)  # it needs an extra
    monkeypatch.setitem(sys.modules, "romnav.report.replay.viewer", viewer)
    assert fails("view", "oracle", "--episode", "64") == "no episode is like that; there are 0 to 63"
    assert fails("view", "oracle", "--where", "climbb > 3").startswith("--where 'climbb > 3': name 'climbb' is not")
