"""Warp's cache of kernels: what is wrong with its folder is told at the start, not by LLVM in the middle of work."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

NARROW = "import shutil; shutil.disk_usage = lambda path: shutil._ntuple_diskusage(1, 1, 1_000_000); "


@pytest.mark.parametrize(
    ("before", "below", "words"),
    [("", "file", ("not a directory", "cannot be kept")), (NARROW, "cache", ("1.0 MB left", "free some"))],
)
def test_a_cache_that_cannot_hold_kernels_is_named_at_the_start(
    tmp_path: Path, before: str, below: str, words: tuple[str, str]
) -> None:
    (tmp_path / "file").touch()
    cache = tmp_path / below / "kernels"
    work = f"{before}import romnav.kernels"
    run = subprocess.run(
        [sys.executable, "-c", work],
        env={**os.environ, "WARP_CACHE_PATH": str(cache)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode != 0
    last = run.stderr.splitlines()[-1]
    assert last.startswith(f"romnav.errors.RomnavError: {cache}")
    assert all(word in last for word in (*words, "WARP_CACHE_PATH"))
