from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from romnav.errors import RomnavError
from romnav.evaluation.paired import metrics, rows
from romnav.report.paired import results


@pytest.fixture
def folder(episode_rows, tmp_path: Path) -> Path:
    for arm, skill, seed in (("rom", 0.9, 0), ("rom", 0.8, 1), ("uniform", 0.5, 0)):
        made = episode_rows(arm, skill, seed=seed)
        rows.write(tmp_path / "smoke" / arm / f"seed-{seed}" / "episodes.parquet", made)
    return tmp_path


def test_every_run_and_every_ordered_pair(folder: Path) -> None:
    found = results.collect(folder, "smoke")
    assert list(found) == ["scale", "episode_set", "arms", "contrasts"]
    assert (found["scale"], found["episode_set"]) == ("smoke", "feedc0ffee123456")
    assert [(arm["arm"], arm["seed"]) for arm in found["arms"]] == [("rom", 0), ("rom", 1), ("uniform", 0)]
    rates = [f"sr_{horizon}{level}" for level in ("", "_same", "_cross") for horizon in (45, 120)]
    keys = {"arm", "seed", "steps", "hours", *rates, "t2g", "spl", "falls", "timeouts"}
    assert all(set(arm) == keys for arm in found["arms"])
    named, tests = {"a", "b", "horizon", "level", "diff", "lo", "hi", "n"}, {"a_only", "b_only", "mid_p"}
    assert all(set(c) == named | tests | {"tile_lo", "tile_hi"} for c in found["contrasts"])
    assert all(c[name] is None for c in found["contrasts"] for name in tests)  # of two runs, not of several seeds
    assert {(c["a"], c["b"]) for c in found["contrasts"]} == {("rom", "uniform"), ("uniform", "rom")}
    assert {(c["horizon"], c["level"]) for c in found["contrasts"]} == {
        (horizon, level) for horizon in (45, 120) for level in ("all", "same", "cross")
    }
    assert json.loads(json.dumps(found, allow_nan=False)) == found


def test_values_are_those_of_the_rows(folder: Path) -> None:
    found = results.collect(folder, "smoke")
    run = rows.read(folder / "smoke" / "rom" / "seed-1" / "episodes.parquet")
    total, cross = metrics.evaluate(run.columns), metrics.evaluate(run.columns, "cross")
    arm = found["arms"][1]
    assert (arm["steps"], arm["hours"]) == (1_500_000, 0.2)
    assert (arm["sr_45"], arm["spl"], arm["t2g"]) == (total["sr_45"], total["spl"], total["t2g"])
    assert arm["sr_120_cross"] == cross["sr_120"]
    assert arm["sr_120"] + arm["falls"] + arm["timeouts"] == pytest.approx(100)
    rom = sum(arm["sr_120"] for arm in found["arms"][:2]) / 2
    for c in found["contrasts"]:
        if (c["a"], c["horizon"], c["level"]) == ("rom", 120, "all"):
            assert c["diff"] == pytest.approx(rom - found["arms"][2]["sr_120"])
            assert c["lo"] < c["diff"] < c["hi"]
            assert c["n"] == 64


def test_runs_that_were_not_asked_for_are_not_read(folder: Path) -> None:
    (folder / "smoke" / "rom" / "seed-0" / "episodes.parquet").write_text("torn")
    found = results.collect(folder, "smoke", [("rom", 1), ("uniform", 0)])
    assert [(arm["arm"], arm["seed"]) for arm in found["arms"]] == [("rom", 1), ("uniform", 0)]
    assert found["contrasts"][0]["a_only"] is not None


def test_what_does_not_exist_is_none(folder: Path, episode_rows) -> None:
    rows.write(folder / "smoke" / "never" / "seed-0" / "episodes.parquet", episode_rows("never", 0.0))
    never = results.collect(folder, "smoke")["arms"][0]
    assert (never["arm"], never["t2g"], never["sr_120"]) == ("never", None, 0)


def test_nothing_evaluated_says_what_to_run(tmp_path: Path) -> None:
    with pytest.raises(RomnavError, match="romnav run ablation spawn-goal --scale cpu"):
        results.load(tmp_path, "cpu")


def test_rows_in_another_place_are_refused(folder: Path) -> None:
    shutil.copytree(folder / "smoke" / "rom", folder / "smoke" / "nocap")
    with pytest.raises(RomnavError, match=r"nocap.*holds the rows of smoke/rom/seed-0"):
        results.load(folder, "smoke")


def test_rows_of_another_scale_are_refused(folder: Path) -> None:
    shutil.copytree(folder / "smoke", folder / "cpu")
    with pytest.raises(RomnavError, match=r"cpu.*holds the rows of smoke/rom/seed-0"):
        results.load(folder, "cpu")
