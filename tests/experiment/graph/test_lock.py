from __future__ import annotations

import subprocess
import sys
import threading
from pathlib import Path

import pytest

from romnav.errors import RomnavError
from romnav.experiment.graph.lock import held


def free(holder: str) -> None:
    raise AssertionError(f"held by {holder}")


def test_many_processes_hold_it_one_at_a_time(tmp_path: Path) -> None:
    """Each adds one to a number, slowly; the file of the lock comes and goes between them."""
    (tmp_path / "number").write_text("0")
    script = (
        "import sys, time; from pathlib import Path; from romnav.experiment.graph.lock import held\n"
        "for _ in range(15):\n"
        "    with held(Path('lock'), lambda holder: None):\n"
        "        number = int(Path('number').read_text()); time.sleep(0.001)\n"
        "        Path('number').write_text(str(number + 1))"
    )
    processes = [subprocess.Popen([sys.executable, "-c", script], cwd=tmp_path) for _ in range(4)]
    assert [process.wait() for process in processes] == [0] * 4
    assert (tmp_path / "number").read_text() == "60"
    assert not (tmp_path / "lock").exists()


def test_one_left_by_a_process_that_was_killed_is_free(tmp_path: Path) -> None:
    script = (
        "import os, signal; from pathlib import Path; from romnav.experiment.graph.lock import held\n"
        "with held(Path('lock'), lambda holder: None): os.kill(os.getpid(), signal.SIGKILL)"
    )
    subprocess.run([sys.executable, "-c", script], cwd=tmp_path)
    assert (tmp_path / "lock").read_text().startswith("process ")
    with held(tmp_path / "lock", free) as waited:
        assert not waited


def test_who_waits_is_told_for_whom(tmp_path: Path) -> None:
    told = threading.Event()
    seen: list[str | bool] = []

    def wait(holder: str) -> None:
        seen.append(holder)
        told.set()

    def second() -> None:
        with held(tmp_path / "lock", wait) as waited:
            seen.append(waited)

    with held(tmp_path / "lock", free):
        thread = threading.Thread(target=second)
        thread.start()
        assert told.wait(30)
    thread.join()
    assert str(seen[0]).startswith("process ")
    assert " on " in str(seen[0])
    assert seen[1] is True


def test_a_folder_that_cannot_be_written_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(RomnavError, match="cannot be written"), held(tmp_path / "file" / "lock", free):
        pass
