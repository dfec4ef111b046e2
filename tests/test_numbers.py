"""Numbers in README and docs are those of results/."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
sys.path.append(str(ROOT / "tools"))
import numbers_in_pages as numbers  # noqa: E402


def test_every_quoted_number_is_that_of_the_results() -> None:
    assert not numbers.outdated(), "run `make numbers`"


def test_numbers_are_read_from_json_csv_and_tables(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(numbers, "ROOT", tmp_path)
    (tmp_path / "a.json").write_text(json.dumps({"of": [{"name": "x", "rate": 0.985}, {"name": "y", "rate": 1.0}]}))
    rows = 'paper,,R,c,1,0\nours,"A, 0","R, on",c,2.25,0\nours,"B, 0","R, on",c,9,1\nours,,S,c,-9,1\n'
    (tmp_path / "t.csv").write_text(f"source,block,row,column,value,dagger\n{rows}")
    (tmp_path / "t.md").write_text("| a |\n|---|\n| 1 |\n")
    (tmp_path / "b.json").write_text(json.dumps({"shares": {"one part": 0.25, "two": 0.125}, "ends": [-1.5, 0.5]}))
    page = (
        'Sum <!-- = b.json "shares/one part" shares/two 1000*,.0f --><!-- -->, <!-- = b.json ends/0 +.1f --><!-- -->. '
        "Rates of <!-- = a.json of/name=x/rate 100*.3g -->?<!-- --> and <!-- = a.json of/name=y/rate .1f --><!-- -->, "
        'or <!-- = t.csv "R, on" c "A, 0" .1f -->7<!-- -->, <!-- = t.csv "R, on" c "A, 0" +.1f† --><!-- -->, '
        "<!-- = t.csv S c 2*+.1f† --><!-- -->.\n<!-- = t.md -->\nold\n<!-- -->\n"
    )
    text = numbers.written(page)
    assert "rate 100*.3g -->98.5<!-- -->" in text
    assert "1000*,.0f -->375<!-- -->, <!-- = b.json ends/0 +.1f -->-1.5<!-- -->." in text
    assert "rate .1f -->1.0<!-- -->," in text
    assert 'c "A, 0" .1f -->2.2<!-- -->, ' in text
    assert 'c "A, 0" +.1f† -->+2.2<!-- -->, ' in text
    assert "c 2*+.1f† -->-18.0†<!-- -->." in text
    with pytest.raises(numbers.SourceError, match="R, on, c is in A, 0; B, 0; name one of them"):
        numbers.value('t.csv "R, on" c .1f')
    assert "\n\n| a |\n|---|\n| 1 |\n\n<!-- -->" in text
    assert "old" not in text
    assert numbers.written(text) == text


def test_arms_are_shown_on_seen_and_unseen_terrain(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(numbers, "ROOT", tmp_path)
    folder = tmp_path / "results" / "tiny" / "rom" / "seed-1"
    folder.mkdir(parents=True)
    rates = [f"sr_{horizon}_{level}" for horizon in (45, 120) for level in ("all", "cross")]
    rows = [{"tiles": 96 - k, **{rate: 10.0 * i + k for i, rate in enumerate(rates)}} for k in (0, 1)]
    (folder / "generalization.json").write_text(json.dumps(rows))
    table = numbers.value("generalization tiny").strip().splitlines()
    assert table[0] == "| arm | seed | tiles | SR@45 | SR@45, cross level | SR@120 | SR@120, cross level |"
    assert table[2:] == ["| rom | 1 | 96 | 0.0, 1.0 | 10.0, 11.0 | 20.0, 21.0 | 30.0, 31.0 |"]


@pytest.mark.parametrize(
    "source",
    [
        "gone.json x .1f",
        "a.json y .1f",
        "a.json x",
        "a.json l/9 .1f",
        "a.json l/k=2 .1f",
        "t.txt x .1f",
        "kept nowhere",
        "generalization nowhere",
    ],
)
def test_a_source_that_is_not_there_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, source: str) -> None:
    monkeypatch.setattr(numbers, "ROOT", tmp_path)
    (tmp_path / "a.json").write_text('{"x": 1, "l": [{"k": 1}]}')
    with pytest.raises(numbers.SourceError, match=source.split()[0]):
        numbers.written(f"<!-- = {source} -->1<!-- -->")
    with pytest.raises(numbers.SourceError, match="has no"):
        numbers.written("<!-- = a.json x .1f -->1")
