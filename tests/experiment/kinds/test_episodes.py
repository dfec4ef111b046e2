"""Evaluated episodes, and their terrain."""

from __future__ import annotations

from typing import Any

import pytest

from romnav.experiment.graph.stage import Session
from romnav.experiment.kinds.episodes import episodes, ground
from romnav.experiment.workspace import Workspace
from tests.experiment import conftest
from tests.experiment.kinds.conftest import SCALE


def test_building_the_terrain_shows_progress(work: Workspace, capsys: pytest.CaptureFixture[str]) -> None:
    """It takes minutes in a fresh clone, which would look hung."""
    paired, world = ground(work.project.root / "experiments" / "episodes" / "dev.json", work.project.worlds)
    assert (len(paired), len(world.tiles)) == (8, 2)
    told = capsys.readouterr().err.splitlines()
    assert told[0].startswith("world   25% 1/4")
    assert told[-1].startswith("world  100% 4/4")


def test_an_evaluation_tells_of_the_terrain_that_it_builds(work: Workspace) -> None:
    here = conftest.workspace(work.project.root, SCALE.replace("[evaluation]", '[evaluation]\nepisodes = "dev"'))
    told: list[tuple[Any, ...]] = []
    stage = episodes(here, "straight", 0)
    stage.make(stage, Session(), lambda *report: told.append(report))
    assert told[:2] == [(1, 4, "tiles"), (2, 4, "tiles")]
    assert told[-1][0] == told[-1][1]
