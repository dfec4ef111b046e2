"""Tables on the terminal."""

from __future__ import annotations

import pytest

from romnav.cli.printing import print_table


def test_what_a_row_does_not_have_is_a_dash(capsys: pytest.CaptureFixture[str]) -> None:
    print_table("Falls", [{"place": "all", "sr_45": 0.5}, {"place": "flat"}], {"place": "place", "sr_45": "SR@45"})
    lines = capsys.readouterr().out.splitlines()
    assert any("all" in line and "0.5" in line for line in lines)
    assert any("flat" in line and "–" in line for line in lines)
