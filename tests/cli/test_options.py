"""Options that many commands take."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from romnav import __version__
from romnav.evaluation.paired import rows
from tests.cli.conftest import ROOT, edit, fails, romnav


@pytest.mark.parametrize(
    "words",
    [
        ("--scale", "cpu", "--results", "elsewhere", "results"),
        ("results", "--scale", "cpu", "--results", "elsewhere"),
        ("--scale", "cpu", "results", "--results", "elsewhere"),
        ("--scale", "smoke", "--results", "nowhere", "results", "--scale", "cpu", "--results", "elsewhere"),
        ("--results", "nowhere", "results", "--scale", "cpu", "--results", "elsewhere"),
    ],
    ids=" ".join,
)
def test_common_options_hold_before_and_behind_the_command(
    project: Path, words: tuple[str, ...], episode_rows: Callable[..., rows.EpisodeRows]
) -> None:
    for scale, skill in {"cpu": 1.0, "smoke": 0.1}.items():
        file = project / "elsewhere" / scale / "rom" / "seed-0" / "episodes.parquet"
        rows.write(file, episode_rows("rom", skill, scale=scale))
    result = romnav(*words)
    assert result.exit_code == 0, result.output
    assert "scale cpu" in result.stdout


def test_a_default_behind_the_command_holds_over_what_stands_before_it(project: Path) -> None:
    assert f"{project / 'results' / 'smoke'}: no arm" in fails("--scale", "cpu", "results", "--scale", "smoke")
    assert f"{project / 'results' / 'cpu'}: no arm" in fails("--scale", "cpu", "results")


def test_the_version_is_told() -> None:
    assert romnav("--version").stdout == f"romnav {__version__}\n"


@pytest.mark.parametrize(
    ("words", "names"),
    [
        ("romnav train policy unf", {"unfrozen"}),
        ("romnav run ablation sp", {"spawn-goal"}),
        ("romnav results --scale c", {"cpu"}),
        ("romnav eval or", {"oracle", "oracle-hum", "oracle-hum-free", "oracle-hum-limited"}),
    ],
)
def test_the_shell_completes_names(project: Path, words: str, names: set[str]) -> None:
    asked = {"_ROMNAV_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": str(len(words.split()) - 1)}
    program = "import sys; sys.argv[0] = 'romnav'; from romnav.cli import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", program],
        env={**os.environ, "PYTHONPATH": str(ROOT), **asked},
        capture_output=True,
        text=True,
        cwd=project,
    )
    assert {*done.stdout.split()} == names, done.stderr


@pytest.mark.parametrize("words", [("train", "policy", "rom"), ("run", "ablation", "spawn-goal"), ("eval", "rom")])
@pytest.mark.parametrize("seed", ["-1", str(2**32), str(10**40), "one"])
def test_a_seed_is_a_number_that_every_generator_takes(project: Path, words: tuple[str, ...], seed: str) -> None:
    result = romnav(*words, "--seed", seed)
    assert result.exit_code == 2
    assert "--seed" in result.stderr
    assert not (project / "results").exists()


@pytest.mark.parametrize("device", ["cpu:0", "gpu", "", "cuda:x", "mps", "../cpu"])
def test_a_device_is_one_that_all_parts_know(project: Path, device: str) -> None:
    message = fails("train", "encoder", "lidar", "--device", device)
    assert message.startswith(f"device {device}: ")
    assert message.endswith("use cpu, cuda or cuda:N")


@pytest.mark.parametrize(
    ("out", "reason"), [("a.xyz", "names no picture"), ("a", "names no picture"), ("f.png", "is a folder")]
)
def test_a_picture_is_named_before_it_is_drawn(project: Path, out: str, reason: str) -> None:
    (project / "f.png").mkdir()
    for words in (("play", "world"), ("play", "episodes", "rom"), ("describe", "world")):
        assert reason in fails(*words, "--out", out)


@pytest.mark.parametrize("name", ["../paired-2", "a/b", "..", "", "x" * 300])
def test_an_episode_set_is_a_name_and_no_path(project: Path, name: str) -> None:
    assert "names no file" in fails("episodes", name)
    edit(project / "experiments" / "scales" / "smoke.toml", "[lidar]", f'[evaluation]\nepisodes = "{name}"\n[lidar]')
    assert "evaluation.episodes: " in fails("eval", "oracle")


@pytest.mark.parametrize(
    "words", [("results",), ("check",), ("watch", "--once"), ("report",), ("tables",), ("eval", "rom")], ids=" ".join
)
def test_a_scale_is_one_of_the_projects(project: Path, words: tuple[str, ...]) -> None:
    assert fails(*words, "--scale", "smok") == "unknown scale smok; did you mean smoke?"
    assert fails(*words, "--scale", "../..").startswith("unknown scale ../..")


def test_a_hint_is_a_command_for_the_same_place(project: Path) -> None:
    where = ("--scale", "cpu", "--results", "else where")
    hint = "run `romnav train policy rom --seed 3 --scale cpu --results 'else where'`"
    assert fails("eval", "rom", "--seed", "3", *where).endswith(hint)
    message = fails("run", "safety", "deploy", "--scale", "cpu", "--seed", "7")
    assert message.endswith("run `romnav run deploy deploy --scale cpu --seed 7`")


def test_a_script_is_no_arm_to_train(project: Path) -> None:
    assert fails("train", "policy", "oracle") == (
        "arm oracle is a script: there is nothing to train; drive it by `romnav eval oracle`"
    )


def test_output_suits_any_terminal(evaluated: Path) -> None:
    done = subprocess.run(
        [sys.executable, ROOT / "cli.py", "results"],
        env={**os.environ, "PYTHONPATH": str(ROOT), "PYTHONIOENCODING": "latin-1"},
        capture_output=True,
        cwd=evaluated,
    )
    assert done.returncode == 0, done.stderr
    assert "SR@45" in done.stdout.decode("latin-1")
