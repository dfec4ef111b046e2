"""Policies kept along a run are judged once each, on the episodes for choices."""

from __future__ import annotations

from typing import Any

import pandas as pd
import pytest

from romnav import files
from romnav.errors import RomnavError
from romnav.evaluation.paired.progress import COLUMNS, read
from romnav.experiment.graph import records
from romnav.experiment.graph.stage import Session
from romnav.experiment.kinds import kept as module
from romnav.experiment.kinds import policy as policies
from romnav.experiment.kinds.kept import elsewhere, kept, reports
from romnav.experiment.workspace import Workspace
from romnav.report.paired import progress
from tests.experiment import conftest
from tests.experiment.kinds.conftest import SCALE, policy
from tests.navigation.conftest import FakePerception


def test_each_policy_is_walked_once(work: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
    assert not reports(work, "spawn-goal", [0])
    with pytest.raises(RomnavError, match=r"kept: no policies along the run; train with navigation\.ppo\.keep"):
        kept(work, "rom", 0)
    walked: list[int] = []

    def perception(*_: Any, **__: Any) -> FakePerception:
        return FakePerception()

    def progress(done: int, total: int, text: str) -> None:
        if text.startswith("reached"):  # a step, no tile of the terrain
            walked.append(done)

    monkeypatch.setattr(module, "perception", perception)
    folder = work.folder / "rom" / "seed-0"
    policy(folder / "kept" / "000002.pt", work, 1)
    first = kept(work, "rom", 0)
    first.record.write_text('{"outputs": {"kept.csv": "that of fewer policies"}}')
    first.make(first, Session(), progress)
    once = len(walked)
    (row,) = read(folder / "kept.csv")
    assert (row["iteration"], row["steps"]) == ("2", "100")
    assert once > 0
    (folder / "kept" / "000002.pt").unlink()
    policy(folder / "kept" / "000004.pt", work, 2)
    second = kept(work, "rom", 0)
    assert second.key != first.key
    run = policies.policy(work, "rom", 0)
    assert not elsewhere(run)
    second.make(second, Session(), progress)
    assert len(walked) == 2 * once
    assert [row["iteration"] for row in read(folder / "kept.csv")] == ["2", "4"]
    second.make(second, Session(), progress)
    assert len(walked) == 2 * once
    policy(folder / "kept" / "000004.pt", work, 3)  # as a run makes it that was killed and went on
    third = kept(work, "rom", 0)
    third.make(third, Session(), progress)
    assert len(walked) == 3 * once
    policy(folder / "kept" / "000004.pt", work, 2)
    second.make(second, Session(), progress)
    assert len(walked) == 4 * once
    second.make(second, Session(resume=False), progress)
    assert len(walked) == 5 * once
    assert [row["iteration"] for row in read(folder / "kept.csv")] == ["4"]
    farther = kept(conftest.workspace(work.project.root, SCALE + "reach = 0.6\n"), "rom", 0)
    farther.make(farther, Session(), progress)
    assert len(walked) == 6 * once
    (figure,) = reports(work, "spawn-goal", [0])
    assert not reports(work, "deploy", [0])  # it drives the same arm, but trains none
    assert [path.parts[-3:-1] for path in figure.reads] == [("rom", "seed-0")]
    figure.make(figure, Session(), progress)
    assert (work.folder / "figures" / "spawn-goal-progress.png").stat().st_size > 10_000
    (folder / "kept" / "000004.pt").unlink()
    assert elsewhere(run)
    rows = read(folder / "kept.csv")
    assert [(row["iteration"], row["steps"]) for row in rows] == [("4", "200")]
    for row in rows:
        for level in ("all", "same", "cross", "storey"):
            assert 0.0 <= float(row[f"sr_45_{level}"]) <= float(row[f"sr_120_{level}"]) <= 100.0
        whole = (float(row["sr_120_same"]) + float(row["sr_120_cross"])) / 2
        assert float(row["sr_120_all"]) == pytest.approx(whole)


ON = """
kind = "ablation"
title = "trained on"
[arms.rom]
label = "RoM"
[arms.more]
label = "on"
begin = "rom"
[arms.most]
label = "on and on"
begin = "more"
"""


def kept_rows(*places: tuple[float, float]) -> str:
    """Text of ``kept.csv`` with a policy after each number of steps and hours."""
    rows = [
        dict.fromkeys(COLUMNS, 50.0)
        | {"policy": "f00d", "conditions": "feed", "iteration": k, "steps": steps, "hours": hours}
        for k, (steps, hours) in enumerate(places, 1)
    ]
    return files.csv_text(rows, COLUMNS)


def test_what_a_run_begins_with_is_counted(work: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
    work.project.file("on").write_text(ON)
    monkeypatch.setattr(progress, "draw", lambda arms, path: drawn.update(arms))
    drawn: dict[str, list[pd.DataFrame]] = {}
    for arm, steps in (("rom", 500), ("more", 300), ("most", 100)):
        stage = policies.policy(work, arm, 0)
        record = records.begin(stage, True)
        (stage.folder / "kept.csv").write_text(kept_rows((steps / 2, 0.5), (steps, 1.0)))
        for name in stage.outputs:
            (stage.folder / name).write_text("made")
        records.finish(stage, record, None, {"steps": steps, "hours": 1.0}, 0.0)
    (work.folder / "rom" / "seed-3").mkdir()
    (work.folder / "rom" / "seed-3" / "kept.csv").write_text(kept_rows((100, 0.1)))
    (figure,) = reports(work, "on", [0])
    figure.make(figure, Session(), lambda done, total, text: None)
    assert {label: [list(rows["steps"]) for rows in runs] for label, runs in drawn.items()} == {
        "RoM": [[250.0, 500.0], [100.0]],
        "on": [[650.0, 800.0]],
        "on and on": [[850.0, 900.0]],
    }
    assert list(drawn["on and on"][0]["hours"]) == [2.5, 3.0]
