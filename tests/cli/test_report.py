from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from romnav.experiment.kinds import page
from tests.cli.conftest import fails, romnav


def test_tables_of_what_is_there_and_notes_of_what_is_not(evaluated: Path) -> None:
    result = romnav("report")
    assert result.exit_code == 0, result.output
    page = evaluated / "results" / "smoke" / "report.html"
    assert result.stdout.strip() == str(page)
    text = page.read_text("utf-8")
    assert "spawngoal-perf-rom" in text
    assert "Uniform" in text
    assert "no episodes of rom: " in result.stderr
    assert "rows of episode set feedc0ffee123456, but experiments/episodes/paired-2.json" in result.stderr
    assert str(evaluated) not in text


def test_what_lies_among_results_and_is_none_is_noted(evaluated: Path) -> None:
    for name in ("gone/seed-0", "rom/seed-0-old"):
        (evaluated / "results" / "smoke" / name).mkdir(parents=True)
        (evaluated / "results" / "smoke" / name / "episodes.parquet").touch()
    result = romnav("report")
    assert result.exit_code == 0, result.output
    assert "no episodes of results/smoke/gone/seed-0: no arm and training seed" in result.stderr
    assert "no episodes of results/smoke/rom/seed-0-old: no arm and training seed" in result.stderr


def test_mistakes_are_one_line(project: Path, evaluated: Path) -> None:
    assert "nothing is recorded; run `romnav run ablation" in fails("report", "--scale", "paper")
    assert "no such file of rows" in fails("report", "single-stage")


@pytest.mark.parametrize(
    ("out", "reason"), [("results", "is a folder"), ("a.html/report.html", "file exists"), (None, "is a folder")]
)
def test_a_page_that_cannot_be_written_is_refused_before_it_is_made(
    evaluated: Path, monkeypatch: pytest.MonkeyPatch, out: str | None, reason: str
) -> None:
    (evaluated / "a.html").touch()
    (evaluated / "results" / "smoke" / "report.html").mkdir()

    def write(*_: Any) -> None:
        raise AssertionError("the page was made")

    monkeypatch.setattr(page, "write", write)
    message = fails("report", *(("--out", out) if out else ()))
    assert message.startswith(f"{out or evaluated / 'results' / 'smoke' / 'report.html'}: cannot be written ({reason})")
