from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from romnav import threads


def test_only_cores_that_this_process_may_use_count() -> None:
    code = "import os; os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})\n"
    code += "from romnav.threads import cores; print(cores())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "1"
    assert 1 <= threads.cores() <= len(os.sched_getaffinity(0))


@pytest.mark.parametrize(("quota", "most"), [("150000 100000", 1), ("50000 100000", 1), ("200000 100000", 2)])
def test_a_containers_quota_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, quota: str, most: int) -> None:
    monkeypatch.setattr(threads, "CGROUPS", tmp_path)
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(64)))
    monkeypatch.setattr(os, "cpu_count", lambda: 64)
    assert threads.cores() == 64
    for file, text in (("cpu.max", quota), ("cpu/cpu.cfs_quota_us", quota.split()[0])):
        (tmp_path / file).parent.mkdir(exist_ok=True)
        (tmp_path / file).write_text(text)
    (tmp_path / "cpu" / "cpu.cfs_period_us").write_text("100000")
    assert threads.cores() == most


def test_no_quota_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threads, "CGROUPS", tmp_path)
    (tmp_path / "cpu.max").write_text("max 100000")
    assert threads.cores() == len(os.sched_getaffinity(0))
