"""The tables of an ablation are of the training seeds that it declares."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from romnav.evaluation.paired import rows
from romnav.experiment.graph.stage import Session
from romnav.experiment.kinds import reports
from romnav.experiment.kinds.tables import evaluated
from romnav.experiment.workspace import Workspace
from tests.experiment import conftest

PAIR = """
kind = "ablation"
title = "Two arms"
seeds = {seeds}
[arms.one]
label = "One"
[arms.two]
label = "Two"
"""


def project(root: Path, seeds: list[int]) -> Workspace:
    (root / "experiments").mkdir(exist_ok=True)
    (root / "experiments" / "pair.toml").write_text(PAIR.format(seeds=seeds))
    return conftest.workspace(root, "")


@pytest.mark.parametrize("seeds", [[0], [0, 1], [1]])
def test_seeds_that_are_not_declared_are_not_in_the_tables(tmp_path: Path, episode_rows: Any, seeds: list[int]) -> None:
    work, skills = project(tmp_path, seeds), {0: 0.9, 1: 0.3, 2: 0.1}
    for seed, skill in skills.items():
        for arm in ("one", "two"):
            made = episode_rows(arm, skill, seed=seed, scale=work.scale)
            rows.write(work.folder / arm / f"seed-{seed}" / "episodes.parquet", made)
    told = f"training seeds per arm: {len(seeds)};"
    assert all(told in table.caption for table in evaluated(work))
    (stage,) = reports(work, "pair", seeds)
    stage.make(stage, Session(), lambda *_: None)
    assert told in (work.folder / "tables" / "pair.md").read_text()
