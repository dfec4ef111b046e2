from __future__ import annotations

import json
import os
import resource
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from romnav.cli import app
from romnav.evaluation import rows, trial_rows
from romnav.experiment import launch, run, stages

ROOT = Path(__file__).parents[1]
HEAVY = {"torch", "warp", "mujoco", "pandas", "pyarrow", "scipy", "matplotlib", "pydantic"}


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A project with this one's experiments and no results; it is the current folder."""
    shutil.copytree(ROOT / "experiments", tmp_path / "experiments")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def evaluated(project: Path, episode_rows: Callable[..., rows.EpisodeRows]) -> Path:
    """A project whose arms have episode rows."""
    for arm, skill in {"rom": 0.8, "uniform": 0.6, "nocap": 0.5, "oracle": 1.0, "straight": 0.2}.items():
        rows.write(project / "results" / "smoke" / arm / "seed-0" / "episodes.parquet", episode_rows(arm, skill))
    return project


def romnav(*words: str) -> Any:
    return CliRunner().invoke(app, words)


def fails(*words: str) -> str:
    """The one line of a user's error."""
    result = romnav(*words)
    assert result.exit_code == 1, result.output
    assert result.stdout == ""
    (line,) = result.stderr.splitlines()
    assert line.startswith("error: ")
    return line.removeprefix("error: ")


def edit(file: Path, old: str, new: str) -> None:
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))


def test_help_is_quick_and_imports_nothing_heavy() -> None:
    code = f"import sys, romnav.cli; print(*({HEAVY!r} & {{*sys.modules}}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""
    times = []
    for _ in range(3):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([sys.executable, ROOT / "cli.py", "--help"], capture_output=True, check=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        times.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    assert min(times) < 0.4  # s of processor time: the same on a busy machine


@pytest.mark.parametrize(
    "words",
    [
        [],
        ["run"],
        ["run", "ablation"],
        ["run", "safety"],
        ["train"],
        ["train", "locomotion"],
        ["train", "gaits"],
        ["eval"],
        ["play", "world"],
        ["play", "locomotion"],
    ],
)
def test_every_command_explains_itself(words: list[str]) -> None:
    result = romnav(*words, "--help")
    assert result.exit_code == 0
    assert "Usage" in result.stdout


def test_list_names_experiments_arms_and_what_is_evaluated(evaluated: Path) -> None:
    lines = romnav("list").stdout.splitlines()
    assert [line.split(":")[0] for line in lines if not line.startswith(" ")] == [
        "deploy",
        "humanoid",
        "pretrain",
        "safety",
        "spawn-goal",
    ]
    assert ["rom", "RoM", "smoke:", "seed", "0"] in [line.split() for line in lines]
    assert ["uniform-nocap", "UniformNoCap", "(RoM)"] in [line.split() for line in lines]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["run", "ablation", "spawn-gaol"], "unknown experiment spawn-gaol; did you mean spawn-goal?"),
        (["run", "ablation", "spawn-goal", "--scale", "smok"], "unknown scale smok; did you mean smoke?"),
        (["run", "safety", "safty"], "unknown experiment safty; did you mean safety?"),
        (["train", "policy", "unifrom"], "unknown arm unifrom; did you mean uniform?"),
        (["train", "encoder", "--device", "cdua"], "device cdua: "),
        (["train", "encoder", "lidra"], "unknown sensor lidra; did you mean lidar?"),
        (["bench", "nothing-like-it"], "unknown benchmark nothing-like-it; there are"),
    ],
)
def test_a_typo_names_the_nearest(project: Path, words: list[str], message: str) -> None:
    assert fails(*words).startswith(message)
    assert not (project / "results").exists()


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("scales/smoke.toml", "rows =", "rosw =", "unknown key lidar.rosw; did you mean rows?"),
        ("scales/smoke.toml", "rows = 15", 'rows = "15"', "key lidar.rows: input should be a valid integer"),
        ("scales/smoke.toml", "[lidar]", "[lidra]", "unknown key lidra; did you mean lidar?"),
        ("spawn-goal.toml", ".cap =", ".capp =", "unknown key arms.nocap.navigation.env.sampler.capp; did"),
        ("spawn-goal.toml", "title =", "titel =", "key title is missing"),
    ],
)
def test_a_wrong_specification_names_file_and_key(project: Path, file: str, old: str, new: str, message: str) -> None:
    edit(project / "experiments" / file, old, new)
    assert fails("run", "ablation", "spawn-goal").startswith(f"{project / 'experiments' / file}: {message}")
    assert not (project / "results").exists()


def test_a_missing_locomotion_policy_says_how_to_train_one(project: Path) -> None:
    folder = project / "results" / "smoke" / "locomotion"
    assert fails("eval", "locomotion") == (
        f"{folder}: no locomotion policy; train one with `romnav train locomotion --scale smoke`"
    )
    assert fails("play", "locomotion").startswith(f"{folder / 'policy.pt'}: no locomotion policy; train one with")


@pytest.mark.slow
def test_locomotion_is_trained_continued_and_recorded(project: Path) -> None:
    edit(project / "experiments" / "scales" / "smoke.toml", "iterations = 60", "iterations = 1")
    edit(project / "experiments" / "scales" / "smoke.toml", "robots = 128", "robots = 16")
    assert romnav("train", "locomotion").exit_code == 0
    assert "nothing to do" in romnav("train", "locomotion").stderr
    record = json.loads((project / "results" / "smoke" / "locomotion" / "policy.json").read_text())
    assert record["facts"]["iterations"] == 1
    edit(project / "experiments" / "scales" / "smoke.toml", "iterations = 1 ", "iterations = 2 ")
    assert romnav("train", "locomotion").exit_code == 0
    curve = (project / "results" / "smoke" / "locomotion" / "curve.csv").read_text().splitlines()
    assert len(curve) == 3
    assert romnav("play", "locomotion").exit_code == 0
    assert (project / "results" / "smoke" / "figures" / "locomotion-stairs-low.png").stat().st_size > 1000
    edit(project / "experiments" / "scales" / "smoke.toml", "robots = 16", "robots = 32")
    refused = romnav("train", "locomotion")
    assert refused.exit_code == 1
    assert "trained by another specification; use another directory or --no-resume" in refused.stderr


def test_a_command_refuses_an_experiment_of_another_kind(project: Path) -> None:
    file = project / "experiments" / "deploy.toml"
    assert fails("run", "safety", "deploy") == f"{file}: key kind is deploy, not safety; run `romnav run deploy deploy`"
    assert "run `romnav run safety safety`" in fails("run", "ablation", "safety")
    assert fails("run", "safety", "--arm", "oracel").endswith("safety.toml: no arm oracel; did you mean oracle?")


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


def test_outside_of_a_project_there_is_one_clear_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert "no experiments/ here or above" in fails("list")


def test_an_untrained_arm_is_not_evaluated(project: Path) -> None:
    assert "policy rom, seed 0 is not trained; run `romnav train policy rom`" in fails("eval", "rom")


def test_results_are_printed_for_people_and_for_scripts(evaluated: Path) -> None:
    data = json.loads(romnav("results", "--json").stdout)
    assert data["scale"] == "smoke"
    assert {run["arm"] for run in data["arms"]} == {"rom", "uniform", "nocap", "oracle", "straight"}
    text = romnav("results").stdout
    assert "uniform" in text
    assert data["episode_set"] in text


def test_results_before_any_evaluation_are_an_error(project: Path) -> None:
    assert "no arm has been evaluated" in fails("results")


def test_rows_of_different_episode_sets_are_not_compared(
    evaluated: Path, episode_rows: Callable[..., rows.EpisodeRows]
) -> None:
    file = evaluated / "results" / "smoke" / "uniform" / "seed-0" / "episodes.parquet"
    rows.write(file, episode_rows("uniform", episode_set="another"))
    assert "rows of different episode sets" in fails("results")


def test_tables_are_made_of_rows_alone(evaluated: Path) -> None:
    result = romnav("tables", "spawn-goal")
    assert result.exit_code == 0
    assert "UniformNoCap" in result.stdout
    folder = evaluated / "results" / "smoke" / "tables"
    names = [f"spawngoal-{kind}-rom.{end}" for kind in ("perf", "levels") for end in ("tex", "md", "csv")]
    assert sorted(p.name for p in folder.iterdir()) == sorted([*names, "spawn-goal.json"])
    before = {p.name: p.read_bytes() for p in folder.iterdir() if p.suffix != ".json"}
    assert romnav("tables").exit_code == 0
    assert before == {p.name: p.read_bytes() for p in folder.iterdir() if p.suffix != ".json"}


def test_a_results_folder_that_cannot_be_written_is_one_clear_error(evaluated: Path) -> None:
    (evaluated / "results" / "smoke" / "tables").write_text("in the way")
    result = romnav("tables")
    assert result.exit_code == 1
    assert result.stderr.splitlines()[-1].startswith("error: ")
    assert "cannot be written" in result.stderr


@pytest.mark.parametrize(
    ("band", "code", "message"),
    [
        ([0, 100], 0, "rom sr_45"),
        ([100, 100], 1, "rom sr_45 "),
        (None, 1, "no readable file of bands"),
    ],
)
def test_check_names_the_metric_outside_of_its_band(
    evaluated: Path, band: list[int] | None, code: int, message: str
) -> None:
    if band:
        file = evaluated / "results" / "smoke" / "bands.json"
        file.write_text(json.dumps({"rom": {"sr_45": band, "spl": [0, 1]}}))
    result = romnav("check")
    assert result.exit_code == code
    assert message in (result.stderr if code else result.stdout)
    if band and code:
        assert "1 of 2 metrics outside" in result.stderr
        assert "band 100 to 100" in result.stderr


def test_the_main_job_runs_every_stage_once_and_then_nothing(
    project: Path, monkeypatch: pytest.MonkeyPatch, episode_rows: Callable[..., rows.EpisodeRows]
) -> None:
    """The command, the plan and the records are real; the parts are quick stand-ins."""
    ran: list[str] = []

    def write(self: Any, stage: Any, progress: Any) -> dict[str, Any]:
        ran.append(stage.name)
        for name in stage.outputs:
            (stage.folder / name).write_text(stage.key)
        progress(1, 1, "done")
        return {"steps": 1, "hours": 0.1}

    def evaluate(self: Any, stage: Any, progress: Any) -> dict[str, Any]:
        ran.append(stage.name)
        rows.write(stage.folder / "episodes.parquet", episode_rows(stage.arm, 0.7))
        return {}

    def in_this_process(commands: Mapping[str, Sequence[str]], workers: int) -> None:
        for words in commands.values():
            result = romnav(*words)
            assert result.exit_code == 0, result.output
            said.append(result.stderr)

    said: list[str] = []
    monkeypatch.setattr(launch, "side_by_side", in_this_process)
    monkeypatch.setattr(stages.Stages, "encoder", write)
    monkeypatch.setattr(stages.Stages, "policy", write)
    monkeypatch.setattr(stages.Stages, "episodes", evaluate)
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
        'cap = "euclidean"\n\n',
        'cap = "euclidean"\nnavigation.ppo.gamma = 0.9\n\n',
    )
    assert romnav(*command).exit_code == 0
    assert ran == ["policy nocap, seed 0", "episodes nocap, seed 0"]
    assert any("policy nocap, seed 0 (changed: navigation.ppo.gamma: 0.99 -> 0.9)" in line for line in said)
    ran.clear()
    assert romnav("train", "policy", "rom", "--no-resume").exit_code == 0
    assert ran == ["policy rom, seed 0"]
    assert "rom" in romnav("eval", "--paired", "rom", "uniform").stdout


def test_learning_curves_need_training_alone(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Fifteen runs, no evaluation; figure and table come again from what the runs recorded."""
    ran: list[str] = []

    def encoder(self: Any, stage: Any, progress: Any) -> dict[str, Any]:
        ran.append(stage.name)
        for name in stage.outputs:
            (stage.folder / name).write_text(stage.key)
        return {}

    def policy(self: Any, stage: Any, progress: Any) -> dict[str, Any]:
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
    monkeypatch.setattr(stages.Stages, "encoder", encoder)
    monkeypatch.setattr(stages.Stages, "policy", policy)
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
    assert romnav("tables").stdout == result.stdout
    assert [file.read_bytes() for file in files] == before
    assert len(ran) == 1 + 15


def test_control_c_says_how_to_go_on(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*arguments: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(run, "execute", interrupted)
    monkeypatch.setattr(sys, "argv", ["romnav", "train", "encoder", "--no-resume"])
    result = romnav("train", "encoder", "--no-resume")
    assert result.exit_code == 130
    assert result.stderr.splitlines()[-1] == "stopped; what is done is kept, go on with: romnav train encoder"


def test_errors_and_control_c_of_a_real_process(project: Path) -> None:
    """No traceback, whatever the process was doing."""
    done = subprocess.run([sys.executable, ROOT / "cli.py", "bench", "x"], capture_output=True, text=True)
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    (project / "benchmarks").mkdir()
    (project / "benchmarks" / "long.py").write_text("import time\nprint('on', flush=True)\ntime.sleep(60)\n")
    process = subprocess.Popen(
        [sys.executable, ROOT / "cli.py", "bench", "long"],
        # a runner in the background ignores Ctrl-C, and its children would inherit that
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stdout is not None
    while process.stdout.readline() != "on\n":
        pass
    os.killpg(process.pid, signal.SIGINT)
    _, error = process.communicate(timeout=20)
    assert process.returncode == 130
    assert "go on with: romnav bench long" in error
