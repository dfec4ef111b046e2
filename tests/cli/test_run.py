"""Experiments from training to tables."""

from __future__ import annotations

import json
import shlex
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

from romnav.evaluation.paired import rows
from romnav.evaluation.trials import rows as trial_rows
from romnav.experiment.graph import launch
from romnav.files import digest
from tests.cli.conftest import edit, fails, romnav


def test_edited_rows_are_not_shown(evaluated: Path) -> None:
    folder = evaluated / "results" / "smoke" / "rom" / "seed-0"
    recorded = {"episodes.parquet": digest(folder / "episodes.parquet")}
    (folder / "episodes.json").write_text(json.dumps({"key": "", "spec": {}, "outputs": recorded}))
    assert romnav("results").exit_code == 0
    shutil.copy(folder.parents[1] / "oracle" / "seed-0" / "episodes.parquet", folder / "episodes.parquet")
    for words in (("results",), ("tables", "spawn-goal")):
        result = romnav(*words)
        assert result.exit_code == 1
        assert "episodes.parquet: not the file that episodes.json recorded" in result.stderr.splitlines()[-1]


def test_a_command_refuses_an_experiment_of_another_kind(project: Path) -> None:
    file = project / "experiments" / "deploy.toml"
    assert fails("run", "safety", "deploy") == f"{file}: key kind is deploy, not safety; run `romnav run deploy deploy`"
    assert "run `romnav run safety safety`" in fails("run", "ablation", "safety")
    assert fails("run", "safety", "--arm", "oracel").endswith("safety.toml: no arm oracel; did you mean oracle?")


def test_neither_of_two_arms_with_one_name_is_trained_in_the_folder_of_the_other(project: Path) -> None:
    shared, mine = (project / "experiments" / f"{name}.toml" for name in ("spawn-goal", "mine"))
    shutil.copy(shared, mine)
    edit(mine, "stair_probability = 0.0", "stair_probability = 0.1")
    what = "has an arm of this name with other settings; rename it in the newer of the two files"
    assert fails("run", "ablation", "mine", "--print") == f"{mine}: arms.uniform: spawn-goal.toml {what}"
    assert fails("run", "ablation", "spawn-goal") == f"{shared}: arms.uniform: mine.toml {what}"
    assert fails("eval", "uniform").endswith(f"arms.uniform: spawn-goal.toml {what}")
    assert romnav("run", "ablation", "pretrain", "--print").exit_code == 0


def test_trials_are_reported_from_their_rows(project: Path, trial_run: Callable[..., trial_rows.TrialRows]) -> None:
    assert "no trials yet; run `romnav run safety`" in romnav("tables", "safety").stderr
    folder = project / "results" / "smoke"
    trial_rows.write(folder / "straight" / "seed-0" / "safety.parquet", trial_run("straight", n=12))
    result = romnav("tables")
    assert result.exit_code == 0, result.output
    assert "Straight (sees nothing)" in result.stdout
    for name in ("tables/safety.tex", "tables/safety.md", "tables/safety.csv", "figures/safety.png"):
        assert (folder / name).stat().st_size > 500
    assert not (folder / "tables" / "deploy.md").exists()
    # scripted arms that were driven on the reduced-order model say nothing of the humanoid
    assert not (folder / "tables" / "safety-hum.md").exists()


def test_tables_are_made_of_rows_alone(evaluated: Path) -> None:
    result = romnav("tables", "spawn-goal")
    assert result.exit_code == 0
    assert "UniformNoCap" in result.stdout
    folder = evaluated / "results" / "smoke" / "tables"
    kinds = ("perf", "levels", "success", "failures")
    names = [f"spawngoal-{kind}-rom.{end}" for kind in kinds for end in ("tex", "md", "csv")]
    assert sorted(p.name for p in folder.iterdir()) == sorted([*names, "spawn-goal.json"])
    before = {p.name: p.read_bytes() for p in folder.iterdir() if p.suffix != ".json"}
    assert romnav("tables").exit_code == 0
    assert before == {name: (folder / name).read_bytes() for name in before}


def test_a_results_folder_that_cannot_be_written_is_one_clear_error(evaluated: Path) -> None:
    (evaluated / "results" / "smoke" / "tables").write_text("in the way")
    result = romnav("tables")
    assert result.exit_code == 1
    assert result.stderr.splitlines()[-1].startswith("error: ")
    assert "cannot be written" in result.stderr


def test_the_main_job_runs_every_stage_once_and_then_nothing(
    project: Path, monkeypatch: pytest.MonkeyPatch, episode_rows: Callable[..., rows.EpisodeRows]
) -> None:
    """The command, the plan and the records are real; the parts are quick stand-ins."""
    ran: list[str] = []

    def write(*arguments: Any) -> dict[str, Any]:
        *_, stage, _, progress = arguments
        ran.append(stage.name)
        for name in stage.outputs:
            (stage.folder / name).write_text(stage.key)
        progress(1, 1, "done")
        return {"steps": 1, "hours": 0.1}

    def evaluate(*arguments: Any) -> dict[str, Any]:
        *_, stage, _, _ = arguments
        ran.append(stage.name)
        rows.write(stage.folder / "episodes.parquet", episode_rows(stage.arm, 0.7))
        (stage.folder / "tracks.npz").write_bytes(b"")
        return {}

    def in_this_process(commands: Mapping[str, Sequence[str]], workers: int) -> None:
        for words in commands.values():
            result = romnav(*words)
            assert result.exit_code == 0, result.output
            said.append(result.stderr)

    said: list[str] = []
    monkeypatch.setattr(launch, "side_by_side", in_this_process)
    monkeypatch.setattr("romnav.experiment.kinds.encoder._pretrain", write)
    monkeypatch.setattr("romnav.experiment.kinds.policy._train", write)
    monkeypatch.setattr("romnav.experiment.kinds.episodes._evaluate", evaluate)
    command = ("run", "ablation", "spawn-goal")
    result = romnav(*command)
    assert result.exit_code == 0, result.output
    assert len(ran) == 1 + 4 + 4 + 2
    assert "RoM − UniformNoCap" in result.stdout
    ran.clear()
    again = romnav(*command)
    assert (again.exit_code, ran) == (0, [])
    assert "nothing to do" in again.stderr
    assert again.stdout == result.stdout
    edit(
        project / "experiments" / "spawn-goal.toml",
        'cap = "euclidean"\n\n[arms.uniform-nocap]',
        'cap = "euclidean"\nnavigation.ppo.gamma = 0.9\n\n[arms.uniform-nocap]',
    )
    planned = romnav(*command, "--print").stdout.splitlines()
    assert ran == []
    assert [line.partition(" # ")[2] for line in planned] == ["1", "2 after 1", "3 after 1,2"]
    for line in planned:
        result = romnav(*shlex.split(line, comments=True)[1:])
        said.append(result.stderr)
    assert ran == ["policy nocap, seed 0", "episodes nocap, seed 0"]
    assert any("policy nocap, seed 0 (changed: navigation.ppo.gamma: 0.99 -> 0.9)" in line for line in said)
    ran.clear()
    assert romnav("train", "policy", "rom", "--no-resume").exit_code == 0
    assert ran == ["policy rom, seed 0"]
    assert "rom" in romnav("eval", "--paired", "rom", "uniform").stdout
    ran.clear()
    (project / "results" / "smoke" / "uniform" / "seed-0" / "policy.pt").unlink()
    compared = romnav("eval", "--paired")
    assert compared.exit_code == 0, compared.output
    assert ran == []  # everything is evaluated already
    train = "romnav train policy ARM --scale smoke"
    assert f"left out: 1 policy that is not finished here (uniform); train with `{train}`\n" in compared.stderr
    assert "uniform-nocap" in compared.stdout


def test_learning_curves_need_training_alone(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Fifteen runs, no evaluation; figure and table come again from what the runs recorded."""
    ran: list[str] = []

    def encoder(*arguments: Any) -> dict[str, Any]:
        *_, stage, _, _ = arguments
        ran.append(stage.name)
        for name in stage.outputs:
            (stage.folder / name).write_text(stage.key)
        return {}

    def policy(*arguments: Any) -> dict[str, Any]:
        *_, stage, _, _ = arguments
        ran.append(stage.name)
        (stage.folder / "policy.pt").write_text("weights")
        count = stage.settings.navigation.ppo.iterations
        rows = [f"{k},{100 * k},{2 * k},8,0.{stage.seed}" for k in range(1, count + 1)]
        (stage.folder / "curve.csv").write_text("\n".join(["iteration,steps,cpu_seconds,episodes,success", *rows]))
        return {"steps": 1, "hours": 0.1}

    def in_this_process(commands: Mapping[str, Sequence[str]], workers: int) -> None:
        for words in commands.values():
            result = romnav(*words)
            assert result.exit_code == 0, result.output

    monkeypatch.setattr(launch, "side_by_side", in_this_process)
    monkeypatch.setattr("romnav.experiment.kinds.encoder._pretrain", encoder)
    monkeypatch.setattr("romnav.experiment.kinds.policy._train", policy)
    assert "no arm of pretrain is trained; run `romnav run ablation pretrain`" in romnav("tables", "pretrain").stderr
    result = romnav("run", "ablation", "pretrain")
    assert result.exit_code == 0, result.output
    assert len(ran) == 1 + 15
    assert [line.split("|")[2].strip() for line in result.stdout.splitlines() if "No Pre" in line] == ["20.0"]
    folder = project / "results" / "smoke"
    files = [
        folder / "figures" / "pretrain.png",
        *(folder / "tables" / f"pretrain.{end}" for end in ("tex", "md", "csv")),
    ]
    assert not [*folder.glob("*/*/episodes.*")]
    before = [file.read_bytes() for file in files]
    for file in [*files, *folder.glob("*/seed-*/policy.pt")]:
        file.unlink()
    assert result.stdout in romnav("tables").stdout
    assert [file.read_bytes() for file in files] == before
    assert len(ran) == 1 + 15
