from __future__ import annotations

import os
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from romnav import files
from romnav.errors import RomnavError


def test_an_interrupted_write_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "new" / "file"
    files.write(path, "old")

    def half() -> None:
        with files.atomic(path) as file:
            file.write(b"half of the new o")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        half()
    assert path.read_text() == "old"
    assert os.listdir(path.parent) == ["file"]


def test_bytes_and_text_are_written(tmp_path: Path) -> None:
    files.write(tmp_path / "a", b"\x00\xff")
    files.write(tmp_path / "b", "ä")
    assert (tmp_path / "a").read_bytes() == b"\x00\xff"
    assert (tmp_path / "b").read_bytes() == "ä".encode()


def test_rows_have_exact_counts_six_digits_and_zeros_before_a_column_comes_up() -> None:
    rows = [{"arm": "a", "steps": 50331648, "loss": 1 / 3}, {"arm": "b", "steps": 2, "late": np.float32(1.0)}]
    assert files.csv_text(rows) == "arm,steps,loss,late\na,50331648,0.333333,0\nb,2,0,1\n"
    assert files.csv_text(rows[:1], ["loss", "arm", "steps"]) == "loss,arm,steps\n0.333333,a,50331648\n"


def test_a_file_in_place_of_the_folder_is_one_clear_error(tmp_path: Path) -> None:
    (tmp_path / "results").write_text("")
    with pytest.raises(RomnavError, match=r"results/out: cannot be written \((file exists|not a directory)\)"):
        files.write(tmp_path / "results" / "out", "x")


@pytest.mark.parametrize(
    ("number", "hint"), [("ENOSPC", "free some disk space"), ("EROFS", "make its folder writable")]
)
def test_a_full_or_read_only_disk_is_one_clear_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: str, hint: str
) -> None:
    import errno

    code = getattr(errno, number)

    def fail(descriptor: int) -> None:
        raise OSError(code, os.strerror(code))

    files.write(tmp_path / "out", "old")
    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(RomnavError, match=hint):
        files.write(tmp_path / "out", "new")
    assert (tmp_path / "out").read_text() == "old"
    assert os.listdir(tmp_path) == ["out"]


def test_the_kernel_refuses_to_write_on(tmp_path: Path) -> None:
    """A limit on the size of files stands in for a full disk."""
    code = "from pathlib import Path; from romnav import files; files.write(Path('out'), b'x' * 100_000)"

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))

    files.write(tmp_path / "out", "old")
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, preexec_fn=limit, capture_output=True, text=True)
    assert "RomnavError: out: cannot be written (file too large)" in done.stderr
    assert os.listdir(tmp_path) == ["out"]
    assert (tmp_path / "out").read_text() == "old"
