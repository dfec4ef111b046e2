"""Rows of kept policies are read whole or refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from romnav import files
from romnav.errors import RomnavError
from romnav.evaluation.paired.progress import COLUMNS, read


@pytest.fixture
def kept(tmp_path: Path) -> Path:
    """Two policies, of which the first one reached no goal."""
    place = {"policy": "f00d", "conditions": "feed", "iteration": 192, "steps": 6_291_456}
    row = dict.fromkeys(COLUMNS, 62.5) | place
    files.write(tmp_path / "kept.csv", files.csv_text([row | {"t2g": float("nan")}, row], COLUMNS))
    return tmp_path / "kept.csv"


def test_rows_are_as_they_were_written(kept: Path) -> None:
    first, second = read(kept)
    assert tuple(first) == COLUMNS
    assert (first["steps"], first["t2g"], second["t2g"]) == ("6291456", "nan", "62.5")


@pytest.mark.parametrize("end", [0, 30, len(",".join(COLUMNS)) + 1, -40, -20, -2, -1])
def test_a_truncated_file_is_one_line(kept: Path, end: int) -> None:
    kept.write_bytes(kept.read_bytes()[:end])
    with pytest.raises(RomnavError) as raised:
        read(kept)
    assert str(raised.value).startswith(f"{kept}: damaged (")
    assert str(raised.value).endswith("); restore it, or delete it and judge the kept policies again")


def _of_another_version(text: str) -> str:
    return text.replace(",sr_45_storey", ",sr_45_far")


def _emptied(text: str) -> str:
    return text.replace("feed,192,6291456", "feed,192,", 1)


def _no_number(text: str) -> str:
    return text.replace("feed,192", "feed,a hundred", 1)


def _wider(text: str) -> str:
    return text.replace("nan\n", "nan,3\n")


@pytest.mark.parametrize(
    ("edit", "reason"),
    [
        (_of_another_version, "the first line does not name its columns"),
        (_emptied, "row 1 has no steps"),
        (_no_number, "row 1: iteration is a hundred, no number"),
        (_wider, "row 1 has more values than columns"),
    ],
)
def test_an_edited_file_is_refused_with_the_reason(kept: Path, edit: Callable[[str], str], reason: str) -> None:
    kept.write_text(edit(kept.read_text()))
    with pytest.raises(RomnavError, match=f"damaged \\({reason}\\); restore it"):
        read(kept)


def test_bytes_that_are_no_text_and_a_file_that_is_gone_are_refused(kept: Path) -> None:
    kept.write_bytes(b"\xff" + kept.read_bytes())
    with pytest.raises(RomnavError, match=r"kept\.csv: damaged \("):
        read(kept)
    kept.unlink()
    with pytest.raises(RomnavError, match=r"kept\.csv: damaged \("):
        read(kept)


def test_whole_rows_that_are_not_the_recorded_ones_are_refused(kept: Path) -> None:
    record = kept.with_suffix(".json")
    record.write_text(json.dumps({"outputs": {"kept.csv": files.digest(kept)}}))
    assert len(read(kept)) == 2
    kept.write_text("".join(kept.read_text().splitlines(keepends=True)[:2]))
    with pytest.raises(
        RomnavError, match=r"kept\.csv: not the file that kept\.json recorded .*; restore it, or delete"
    ):
        read(kept)
    record.unlink()
    assert len(read(kept)) == 1
