"""Evaluated episodes, and their terrain."""

from __future__ import annotations

from typing import Any

import pytest

from romnav.experiment.graph import records
from romnav.experiment.graph.stage import Session
from romnav.experiment.kinds.episodes import episodes, ground, look_at, of_trained_arms
from romnav.experiment.kinds.policy import policy
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


def test_ways_are_looked_at_with_the_period_that_they_were_walked_with(work: Workspace) -> None:
    period = "[navigation.env]\nperiod = 0.4\n"
    scale = SCALE.replace("[evaluation]", f'{period}[evaluation]\nepisodes = "dev"')
    here = conftest.workspace(work.project.root, scale)
    stage = episodes(here, "straight", 0)
    stage.make(stage, Session(), lambda *_: None)
    assert look_at(here, "straight", 0).period == 0.4


def test_policies_that_are_not_finished_are_left_out_in_one_line(work: Workspace) -> None:
    """A clone has records of policies that are not committed themselves."""
    (work.project.root / "experiments" / "deploy.toml").unlink()
    other = conftest.workspace(work.project.root, SCALE + "[navigation.ppo]\ngamma = 0.9\n")
    records.begin(policy(other, "nocap", 0), resume=False)
    here = conftest.workspace(work.project.root, SCALE)
    for arm in ("uniform", "rom"):
        records.begin(policy(here, arm, 0), resume=False)
    stages, left_out = of_trained_arms(here)
    assert stages == []
    assert left_out == [
        "policy nocap, seed 0 was made with other settings (navigation.ppo.gamma: 0.9 -> 0.997)",
        "2 policies that are not finished here (rom, uniform); train with `romnav train policy ARM --scale tiny`",
    ]
