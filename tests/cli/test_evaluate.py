"""Evaluating, and what was measured."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from romnav.evaluation.paired import rows
from romnav.experiment.bands import read
from romnav.experiment.project import Project
from tests.cli.conftest import ROOT, edit, fails, romnav

BANDS = Path("results") / "smoke" / "bands.json"


def test_a_missing_locomotion_policy_says_how_to_train_one(project: Path) -> None:
    folder = project / "results" / "smoke" / "locomotion"
    assert fails("eval", "locomotion") == (
        f"{folder}: locomotion is missing, and terrain test needs it; run `romnav train locomotion --scale smoke`"
    )
    assert fails("play", "locomotion").startswith(f"{folder / 'policy.pt'}: no such locomotion policy; train one with")


def test_the_navigation_test_is_of_the_locomotion_policy_and_needs_rom(project: Path) -> None:
    assert fails("eval", "rom", "--navigation").startswith("--navigation: a test of the locomotion policy")
    assert fails("eval", "rom", "--kept", "--navigation").startswith("--navigation: a test of the locomotion policy")
    message = fails("eval", "locomotion", "--navigation")
    assert "policy rom, seed 0 is missing, and navigation test needs it" in message


@pytest.mark.parametrize("words", [("--seed", "0"), ("--joints",), ("--paired",)], ids=" ".join)
def test_options_of_arms_are_none_of_the_locomotion_test(project: Path, words: tuple[str, ...]) -> None:
    message = f"{words[0]}: is of arms, and locomotion is none; leave it out, or name an arm, too"
    assert fails("eval", "locomotion", *words) == message
    assert "locomotion is missing, and terrain test needs it" in fails("eval", "locomotion", "oracle", "--seed", "0")


def test_an_untrained_arm_is_not_evaluated(project: Path) -> None:
    message = fails("eval", "rom")
    assert "policy rom, seed 0 is missing, and episodes rom, seed 0 needs it" in message
    assert message.endswith("run `romnav train policy rom --seed 0 --scale smoke`")


def test_joints_are_kept_of_humanoids_only(project: Path) -> None:
    message = "--joints: oracle is driven on a body without joints; only the humanoid has them"
    assert fails("eval", "oracle", "--joints") == message
    assert fails("eval", "--paired", "--joints").startswith("--joints: are those of evaluated arms; name arms")
    assert fails("eval", "rom", "--kept", "--joints").startswith("--joints: are those of evaluated arms; name arms")


@pytest.mark.parametrize("size", [30, 400])
def test_damaged_rows_of_kept_policies_are_one_clear_error(project: Path, size: int) -> None:
    """They are here, their policies on another machine."""
    shutil.copytree(ROOT / "results" / "cpu" / "rom", project / "results" / "cpu" / "rom")
    file = project / "results" / "cpu" / "rom" / "seed-0" / "kept.csv"
    words = ("eval", "rom", "--kept", "--seed", "0", "--scale", "cpu")
    assert romnav(*words).exit_code == 0
    file.write_bytes(file.read_bytes()[:size])
    result = romnav(*words)
    assert result.exit_code == 1
    message = f"error: {file}: not the file that kept.json recorded (truncated, edited); restore it, or delete it and "
    assert result.stderr.splitlines()[-1] == f"{message}judge the kept policies again"
    assert not result.stdout
    drawn = romnav("tables", "spawn-goal", "--scale", "cpu")
    assert (drawn.exit_code, drawn.stderr.splitlines()[-1]) == (1, f"{message}judge the kept policies again")


def test_results_are_printed_for_people_and_for_scripts(evaluated: Path) -> None:
    data = json.loads(romnav("results", "--json").stdout)
    assert data["scale"] == "smoke"
    assert {run["arm"] for run in data["arms"]} == {"rom", "uniform", "nocap", "oracle", "straight"}
    text = romnav("results").stdout
    assert "uniform" in text
    assert data["episode_set"] in text


def test_each_arm_is_compared_with_its_experiments_reference(evaluated: Path) -> None:
    def pairs(*words: str) -> list[str]:
        lines = [line.split("│") for line in romnav(*words).stdout.splitlines() if "│ 120 │ cross" in line]
        return [line[1].strip() for line in lines]

    assert pairs("results") == [f"rom - {other}" for other in ("uniform", "nocap", "oracle", "straight")]
    assert len(pairs("results", "--all-pairs")) == 10
    assert "McNemar" not in romnav("results").stdout
    assert "McNemar" in romnav("results", "--verbose").stdout


def test_what_cannot_be_compared_is_one_clear_error(project: Path) -> None:
    assert fails("eval", "rom", "uniform", "rom") == "rom is named twice; name each arm once"
    assert fails("eval", "--paired", "rom").startswith("--paired compares arms: name one beside rom, or none")
    assert fails("eval", "--paired", "--generalization").startswith("--generalization: is of each arm by itself")
    for option in ("--paired", "--all-pairs", "--verbose"):
        assert fails("eval", "rom", "--kept", option).startswith("--kept: is of each arm by itself; leave --paired, ")
    assert "policy rom, seed 0 is missing, and generalization" in fails("eval", "rom", "--generalization")
    assert fails("eval").startswith("name arms, or compare all that are trained by `romnav eval --paired`")
    assert fails("eval", "--paired").endswith("no arm is trained; run `romnav run ablation spawn-goal --scale smoke`")


def test_results_before_any_evaluation_are_an_error(project: Path) -> None:
    assert "no arm has been evaluated" in fails("results")


def test_rows_of_different_episode_sets_are_not_compared(
    evaluated: Path, episode_rows: Callable[..., rows.EpisodeRows]
) -> None:
    file = evaluated / "results" / "smoke" / "uniform" / "seed-0" / "episodes.parquet"
    rows.write(file, episode_rows("uniform", episode_set="another"))
    assert "rows of different episode sets" in fails("results")


def test_rows_of_arms_that_are_not_asked_for_may_be_of_another_set(
    evaluated: Path, episode_rows: Callable[..., rows.EpisodeRows], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Arms of an ablation are evaluated side by side: the first one to end finds the others' old rows."""
    stale = evaluated / "results" / "smoke" / "oracle" / "seed-0" / "episodes.parquet"
    rows.write(stale, episode_rows("oracle", 1.0, episode_set="another"))
    monkeypatch.setattr("romnav.experiment.graph.run.pending", lambda *_: [])
    monkeypatch.setattr("romnav.experiment.graph.run.require", lambda *_: None)
    result = romnav("eval", "rom")
    assert result.exit_code == 0, result.output
    assert "rom" in result.stdout
    refused = romnav("eval", "rom", "oracle")
    assert (refused.exit_code, "rows of different episode sets" in refused.stderr) == (1, True)


@pytest.mark.parametrize(("band", "code", "message"), [([0, 100], 0, "rom sr_45"), ([100, 100], 1, "rom sr_45 ")])
def test_check_names_the_metric_outside_of_its_band(evaluated: Path, band: list[int], code: int, message: str) -> None:
    (evaluated / BANDS).write_text(json.dumps({"rom": {"sr_45": band, "spl": [0, 1]}}))
    result = romnav("check")
    assert result.exit_code == code
    assert message in (result.stderr if code else result.stdout)
    if code:
        assert "1 of 2 metrics outside" in result.stderr
        assert "band 100 to 100" in result.stderr


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, 'cannot be read (no such file or directory); write {"rom": {"sr_45": [31, 100]}}: arms'),
        ("rom", "not valid JSON (Expecting value: line 1 column 1 (char 0)); write {"),
        ("[" * 100_000, "not valid JSON ("),
        ("{}", "{} holds no bands; write {"),
        ("[1]", "[1] holds no bands; write {"),
        ('{"rom": 3}', "key rom: 3 holds no bands; write {"),
        ('{"rom": {}}', "key rom: {} holds no bands; write {"),
        ('{"romm": {"sr_45": [0, 1]}}', "key romm: unknown arm romm; did you mean rom?"),
        ('{"rom": {"sr_46": [0, 1]}}', "key rom.sr_46: unknown metric; did you mean sr_45?"),
        ('{"rom": {"hours": [0, 1]}}', "key rom.hours: unknown metric; there are falls, spl, sr_120,"),
        ('{"rom": {"sr_45": [2, 1]}}', "key rom.sr_45: [2, 1] is no band; write [lowest, highest], two numbers of"),
        ('{"rom": {"sr_45": [0, NaN]}}', "key rom.sr_45: [0, NaN] is no band; write [lowest, highest]"),
        ('{"rom": {"sr_45": [0, Infinity]}}', "key rom.sr_45: [0, Infinity] is no band; write"),
        ('{"rom": {"sr_45": [0, "1"]}}', 'key rom.sr_45: [0, "1"] is no band; write'),
        ('{"rom": {"sr_45": [0, true]}}', "key rom.sr_45: [0, true] is no band; write"),
        ('{"rom": {"sr_45": [0]}}', "key rom.sr_45: [0] is no band; write"),
        ('{"rom": {"sr_45": 50}}', "key rom.sr_45: 50 is no band; write"),
    ],
)
def test_a_wrong_file_of_bands_is_one_clear_error(evaluated: Path, text: str | None, message: str) -> None:
    """It would check nothing, or read as a regression."""
    file = evaluated / BANDS
    if text is not None:
        file.write_text(text)
    assert fails("check").startswith(f"{file}: {message}")


def test_an_arm_with_a_band_may_be_in_an_experiment_that_is_invalid(evaluated: Path) -> None:
    edit(evaluated / "experiments" / "spawn-goal.toml", "[arms.uniform]", "[arms.uniform]\nlabel = 3")
    (evaluated / BANDS).write_text('{"uniform": {"sr_45": [0, 100]}}')
    assert "bands.json: key uniform: " in (message := fails("check"))
    assert "spawn-goal.toml: not valid TOML" in message


@pytest.mark.parametrize("scale", ["smoke", "cpu"])
def test_the_projects_own_bands_are_valid(scale: str) -> None:
    file = ROOT / "results" / scale / "bands.json"
    assert read(file, Project(ROOT, ROOT / "results")) == {
        arm: {metric: tuple(band) for metric, band in metrics.items()}
        for arm, metrics in json.loads(file.read_text()).items()
    }
