from __future__ import annotations

import pytest

from romnav.errors import RomnavError
from romnav.experiment.graph.launch import side_by_side


def test_commands_run_in_processes_of_their_own(capfd: pytest.CaptureFixture[str]) -> None:
    side_by_side({"one": ["list"], "two": ["--help"]}, 2)
    assert capfd.readouterr().out == ""


def test_the_first_failure_names_its_reason() -> None:
    with pytest.raises(RomnavError, match="nosuch"):
        side_by_side({"good": ["list"], "bad": ["train", "policy", "nosuch"]}, 1)
