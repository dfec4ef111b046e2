from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from romnav.experiment.graph import records
from romnav.experiment.graph.run import execute
from romnav.experiment.graph.stage import Session, Stage
from romnav.experiment.kinds.curves import finished, policies, read, tabulate
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


def test_the_table_tells_of_uncommitted_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    here = workspace(tmp_path, "[navigation.ppo]\niterations = 2\n")
    here.project.file("pair").write_text(PAIR)

    def train(stage: Stage, session: Session, progress: Any) -> dict[str, Any]:
        (stage.folder / "policy.pt").write_text("weights")
        rows = ["iteration,steps,cpu_seconds,episodes,success", "1,10,2,8,0.5", "2,20,4,8,0.5"]
        (stage.folder / "curve.csv").write_text("\n".join(rows))
        return {}

    for run in policies(here, "pair", [0]):
        monkeypatch.setattr(records, "provenance", lambda arm=run.arm: {"commit": COMMITS[arm]})
        execute([replace(run, make=train)], Session())
    runs = finished(policies(here, "pair", [0]))
    table = tabulate(here, "pair", "pair", read(here, here.project.experiment("pair"), runs), runs)
    assert table.provenance["commit"] == "012345678901, 012345678901-dirty"
    assert table.caption.endswith("commit 012345678901, 012345678901-dirty.")
