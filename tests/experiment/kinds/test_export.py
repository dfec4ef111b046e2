"""What `romnav export` tells of a policy, and when it has to do so again."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from romnav.deploy import export as exporter
from romnav.errors import RomnavError
from romnav.evaluation.paired import rows
from romnav.experiment.graph import records
from romnav.experiment.graph.run import execute, pending
from romnav.experiment.graph.stage import Session, digest
from romnav.experiment.kinds.episodes import episodes
from romnav.experiment.kinds.export import export
from romnav.experiment.kinds.policy import policy
from romnav.experiment.workspace import Workspace
from tests.experiment import conftest

SCALE = """
[world]
tiles = 1
side = 12.0
classes = ["room"]
goals_per_tile = 4
[lidar]
rows = 15
columns = 55
[navigation.env]
envs = 4
duration = 4.0
[navigation.policy]
attention = 8
heads = 2
recurrent = 8
[navigation.ppo]
iterations = 1
steps = 2
epochs = 1
minibatches = 1
"""
EXPERIMENT = """
kind = "ablation"
title = "One arm with a random encoder"
[arms.raw]
label = "Raw"
navigation.encoder.pretrained = false
"""


@pytest.fixture
def trained(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Workspace, list[Any]]:
    """A workspace with a trained policy; and what was exported."""
    (tmp_path / "experiments").mkdir()
    work = conftest.workspace(tmp_path, SCALE)
    work.project.file("raw").write_text(EXPERIMENT)
    execute(pending([policy(work, "raw", 0)]), Session())
    done: list[Any] = []

    def write(actor: Any, lidar: Any, depth: Any, card: Any, path: Path, progress: Any) -> Any:
        done.append(card)
        path.write_bytes(b"network")
        return card.model_copy(update={"error": 1e-7})

    monkeypatch.setattr(exporter, "export", write)
    return work, done


def test_the_card_is_that_of_the_training(trained: tuple[Workspace, list[Any]]) -> None:
    work, done = trained
    stage = export(work, "raw", 0)
    execute(pending([stage]), Session())
    (card,) = done
    assert (card.arm, card.seed, card.scale, card.steps) == ("raw", 0, "tiny", 8)
    assert card.checkpoint == digest(policy(work, "raw", 0).folder / "policy.pt")
    assert (card.memory, card.proprioception, card.depth) == ((2, 1, 8), 0, None)
    assert card.lidar == work.settings.lidar
    assert "depth" not in card.inputs
    assert card.measured is None
    record = records.read(stage)
    assert record is not None
    assert record.facts == {"error": 1e-7, "measured": False}
    assert not pending([export(work, "raw", 0)])


def test_an_evaluation_is_told_of(
    trained: tuple[Workspace, list[Any]], episode_rows: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    work, done = trained
    evaluated = episodes(work, "raw", 0)
    run = episode_rows("raw")
    rows.write(evaluated.folder / "episodes.parquet", run)
    (evaluated.folder / "tracks.npz").write_bytes(b"")
    records.finish(evaluated, records.begin(evaluated, True), None, {}, 0.0)
    execute(pending([export(work, "raw", 0)]), Session())
    measured = done[0].measured
    assert measured.digest == run.provenance.episode_set
    assert measured.metrics["sr_120"] == pytest.approx(100 * np.mean(run.columns["outcome"] == "success"))


def test_a_script_has_nothing_to_export(trained: tuple[Workspace, list[Any]]) -> None:
    with pytest.raises(RomnavError, match="oracle: a scripted arm has no policy"):
        export(trained[0], "oracle", 0)
