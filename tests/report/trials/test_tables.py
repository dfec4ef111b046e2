from __future__ import annotations

import csv
import io
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from romnav.evaluation.trials.statistics import closed_routes, summarise
from romnav.experiment.project import Project
from romnav.report import formats
from romnav.report.spec import Published
from romnav.report.trials import tables as trial_tables
from romnav.world.scenes.deployments import deployment_scenes
from romnav.world.scenes.obstacles import obstacle_scenes

LABELS = {"rom": "RoM"}
ROOT = Path(__file__).parents[3]


@pytest.fixture(scope="module")
def paper() -> Published:
    found = Project(ROOT, ROOT / "results").published("safety")
    assert found
    return found


@pytest.fixture(scope="module")
def scenes():
    return obstacle_scenes()


def test_safety_shows_ten_trials_as_the_paper_and_all_with_intervals(trial_run, scenes, paper) -> None:
    runs = [trial_run("rom", n=64), trial_run("oracle", n=64, skill=1.0)]
    table = trial_tables.safety(runs, scenes, LABELS, paper)
    rom, oracle, published = table.blocks
    assert [len(block.rows) for block in table.blocks] == [9, 9, 6]
    row = rom.rows[1]
    few, every = (summarise(runs[0], "in-distribution", True, first) for first in (10, None))
    assert row.label == "In-Distribution, CBF"
    assert [cell.text for cell in row.cells[:2]] == [f"{few.successes}/10", f"{few.collided}/10"]
    assert row.cells[2].text == f"{few.time:.1f} ± {few.time_std:.1f}"
    lo, hi = every.interval("success")
    assert row.cells[3].text == f"{100 * every.successes / 64:.1f} [{100 * lo:.1f}, {100 * hi:.1f}]"
    assert "Oracle" in oracle.title
    assert "RoM, training seed 0" in rom.title
    assert [cell.text for cell in published.rows[3].cells[:3]] == ["10/10", "0/10", "11.0 ± 5.8"]
    assert [cell.text for cell in published.rows[4].cells[:3]] == ["10/10", "4/10", "5.5 ± 1.0"]
    held = sum(int(runs[0].of(scene.name, True)["blocked"].sum()) for scene in scenes)
    closed = sum(len(closed_routes(runs[0], scene.name)) for scene in scenes)
    assert f"RoM {held} and {closed};" in table.caption


def test_safety_counts_the_trials_that_a_fall_ended(trial_run, scenes) -> None:
    run = trial_run("rom", n=64)
    columns = {**run.columns, "outcome": np.where(run.columns["trial"] % 4 == 0, "fall", run.columns["outcome"])}
    table = trial_tables.safety([replace(run, columns=columns)], scenes, LABELS)
    fell = [row.cells[table.columns.index("fell")].text for row in table.blocks[0].rows]
    assert fell[:3] == ["25.0", "25.0", "–"]


def test_deploy_has_a_row_for_each_filter_and_the_lengths_of_the_paper(trial_run, paper) -> None:
    scenes = deployment_scenes()
    run = trial_run("rom", n=16, scenes=[scene.name for scene in scenes])
    table = trial_tables.deploy([run], scenes, LABELS, paper)
    ours, published = table.blocks
    assert [row.label for row in ours.rows[:2]] == ["Cluttered lab, no CBF", "Cluttered lab, CBF"]
    assert [row.cells[3].text for row in published.rows] == ["38", "51", "51", "100"]
    blocked = table.columns.index("blocked")
    assert ours.rows[0].cells[blocked].text == "–"  # blocked by a filter that is off: there is no such thing
    assert ours.rows[1].cells[blocked].text != "–"


def test_all_formats_hold_the_numbers(trial_run, scenes) -> None:
    runs = [trial_run("rom", n=64), trial_run("oracle", n=64)]
    both = list(csv.DictReader(io.StringIO(formats.to_csv(trial_tables.safety(runs, scenes, LABELS)))))
    assert len({(r["block"], r["row"], r["column"]) for r in both}) == len(both)
    table = trial_tables.safety(runs[:1], scenes, LABELS)
    assert {block.source for block in table.blocks} == {"ours"}
    text = formats.latex(table)
    assert r"$\pm$" in text
    assert "±" not in text
    assert all(line.count("&") == 7 for line in text.splitlines() if re.match(r"(In|Out|Adv).*\\\\$", line))
    rows = list(csv.DictReader(io.StringIO(formats.to_csv(table))))
    paired = [r for r in rows if "−" in r["row"] and r["column"] == "collision"]
    assert len(paired) == 3
    assert all(float(r["lo"]) <= float(r["value"]) <= float(r["hi"]) and r["mid_p"] for r in paired)
    assert "CBF − no CBF" in formats.markdown(table)
