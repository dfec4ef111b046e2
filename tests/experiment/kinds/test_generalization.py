"""An arm on the terrain that it was trained on, and on terrain that it never saw."""

from __future__ import annotations

import json
from typing import Any

import pytest

from romnav.errors import RomnavError
from romnav.evaluation.episodes import EpisodeSet
from romnav.evaluation.paired import progress as along
from romnav.experiment.graph.stage import Session
from romnav.experiment.kinds import _driven
from romnav.experiment.kinds.generalization import generalization
from romnav.experiment.workspace import Workspace
from tests.experiment import conftest
from tests.experiment.kinds.conftest import SCALE, policy
from tests.navigation.conftest import FakePerception


def test_it_walks_the_tiles_of_training_and_those_of_dev(work: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
    here = conftest.workspace(work.project.root, SCALE + "[navigation]\ntiles = 5\n")
    monkeypatch.setattr(_driven, "perception", lambda *_, **__: FakePerception())
    walked: list[EpisodeSet] = []
    judge = along.judge

    def spied(driver: Any, world: Any, episodes: EpisodeSet, *rest: Any) -> dict[str, float]:
        walked.append(episodes)
        return judge(driver, world, episodes, *rest)

    monkeypatch.setattr(along, "judge", spied)
    stage = generalization(here, "rom", 0)
    policy(stage.folder / "policy.pt", here, 1)
    stage.make(stage, Session(), lambda *_: None)
    seen, unseen = walked
    assert (seen.world.seed, seen.world.tiles, unseen.name) == (0, 5, "dev")
    assert (len(seen), seen.cross.sum()) == (len(unseen), unseen.cross.sum()) == (8, 4)
    rows = json.loads((stage.folder / "generalization.json").read_text())
    assert [(row["terrain"], row["tiles"]) for row in rows] == [("seen", 5), ("unseen", 2)]
    assert all(0.0 <= row["sr_45_all"] <= row["sr_120_all"] <= 100.0 for row in rows)
    fewer = conftest.workspace(work.project.root, SCALE)
    assert generalization(fewer, "rom", 0).key != stage.key


def test_a_script_has_seen_no_terrain(work: Workspace) -> None:
    with pytest.raises(RomnavError, match="oracle drives by a script"):
        generalization(work, "oracle", 0)
