from __future__ import annotations

from pathlib import Path

import pytest

from romnav.config import Config
from romnav.errors import RomnavError
from romnav.experiment.launch import side_by_side, waves
from romnav.experiment.plan import Stage


def test_commands_run_in_processes_of_their_own(capfd: pytest.CaptureFixture[str]) -> None:
    side_by_side({"one": ["list"], "two": ["--help"]}, 2)
    assert capfd.readouterr().out == ""


def test_the_first_failure_names_its_reason() -> None:
    with pytest.raises(RomnavError, match="nosuch"):
        side_by_side({"good": ["list"], "bad": ["train", "policy", "nosuch"]}, 1)


def test_who_is_taught_waits_for_the_teacher() -> None:
    def stage(name: str, *above: Stage) -> Stage:
        here = Path(name)
        return Stage("policy", name, here, (), here / "record", Config(), (), upstream=above)

    encoder = stage("encoder")
    rom, other = stage("rom", encoder), stage("other", encoder)
    taught = stage("taught", encoder, rom)
    assert waves([taught, rom, other]) == [[rom, other], [taught]]
    assert waves([taught]) == [[taught]]
    assert waves([]) == []
