"""Where the rows of a driven arm come from."""

from __future__ import annotations

from dataclasses import replace

from romnav.experiment.graph.run import execute
from romnav.experiment.graph.stage import Session, Stage
from romnav.experiment.kinds._driven import Driven
from romnav.experiment.kinds.episodes import episodes
from romnav.experiment.workspace import Workspace
from romnav.progress import Progress


def train(stage: Stage, session: Session, progress: Progress) -> dict[str, object]:
    for name in stage.outputs:
        (stage.folder / name).write_text("made")
    return {"steps": 300, "hours": 0.5, "processes": 2}


def test_rows_tell_of_a_training_by_several_processes(work: Workspace) -> None:
    driven = Driven.by(work, "rom", 0)
    assert driven.policy is not None
    execute([replace(driven.policy, make=train)], Session())
    told = driven.provenance(episodes(work, "rom", 0), "feed", work.settings.evaluation)
    assert (told.steps, told.hours, told.episode_set) == (300, 0.5, "feed")
