from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from romnav.experiment.graph import records
from romnav.experiment.graph.run import execute
from romnav.experiment.graph.stage import Session, Stage
from romnav.experiment.kinds.curves import finished, policies, read, tabulate
from romnav.experiment.kinds.page import _curves
from tests.experiment.conftest import workspace

PAIR = """
kind = "ablation"
title = "t"
[tables.pair]
kind = "curves"
[arms.clean]
label = "Clean"
[arms.edited]
label = "Edited"
"""
COMMITS = {"clean": f"{'0123456789' * 4}", "edited": f"{'0123456789' * 4}-dirty"}


def train(stage: Stage, session: Session, progress: Any) -> dict[str, Any]:
    (stage.folder / "policy.pt").write_text("weights")
    rows = ["iteration,steps,cpu_seconds,episodes,success", "1,10,2,8,0.5", "2,20,4,8,0.5"]
    (stage.folder / "curve.csv").write_text("\n".join(rows))
    return {}


def test_the_page_shows_finished_curves_while_other_seeds_train(tmp_path: Path) -> None:
    here = workspace(tmp_path, "[navigation.ppo]\niterations = 2\n")
    here.project.file("pair").write_text(PAIR.replace('title = "t"', 'title = "t"\nseeds = [0, 1]'))
    clean, other, edited, behind = policies(here, "pair", [0, 1])
    execute([replace(clean, make=train)], Session())
    for run, rows in ((other, 1), (edited, 1), (behind, 2)):
        train(replace(run, folder=clean.folder), Session(), None)
        text = (clean.folder / "curve.csv").read_text().splitlines()
        run.folder.mkdir(parents=True)
        (run.folder / "curve.csv").write_text("\n".join(text[: 1 + rows]))
    notes: list[str] = []
    ((drawn, tables),) = _curves(here, notes).values()
    assert [(curves.label, len(curves.seeds)) for curves in drawn] == [("Clean", 1), ("Edited", 1)]
    assert len(tables) == 1
    assert len(notes) == 2
    assert all("its run has not ended" in note for note in notes)


def test_the_table_tells_of_uncommitted_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    here = workspace(tmp_path, "[navigation.ppo]\niterations = 2\n")
    here.project.file("pair").write_text(PAIR)

    for run in policies(here, "pair", [0]):
        monkeypatch.setattr(records, "provenance", lambda arm=run.arm: {"commit": COMMITS[arm]})
        execute([replace(run, make=train)], Session())
    runs = finished(policies(here, "pair", [0]))
    table = tabulate(here, "pair", "pair", read(here, here.project.experiment("pair"), runs), runs)
    assert table.provenance["commit"] == "012345678901, 012345678901-dirty"
    assert table.caption.endswith("commit 012345678901, 012345678901-dirty.")
