from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from romnav import stopping
from romnav.stopping import Stopped


@pytest.mark.parametrize("number", stopping.SIGNALS)
def test_a_signal_waits_until_everything_is_saved(number: signal.Signals) -> None:
    done = []

    def work() -> None:
        with stopping.deferred() as stop:
            for step in range(3):
                assert bool(stop) == (step == 2)
                stop.obey()
                if step == 1:
                    signal.raise_signal(number)
                done.append(step)

    with pytest.raises(Stopped) as caught:
        work()
    assert done == [0, 1]
    assert caught.value.number == number


def test_a_second_interrupt_does_not_wait() -> None:
    with stopping.deferred():
        for number in (signal.SIGTERM, signal.SIGTERM, signal.SIGINT):
            signal.raise_signal(number)
        with pytest.raises(Stopped):
            signal.raise_signal(signal.SIGINT)


def test_outside_of_loops_signals_interrupt_at_once() -> None:
    with stopping.at_once(), pytest.raises(Stopped):
        signal.raise_signal(signal.SIGHUP)


def test_what_is_ignored_stays_ignored_and_handlers_come_back() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup does
    try:
        with stopping.at_once(), stopping.deferred() as stop:
            signal.raise_signal(signal.SIGHUP)
            assert not stop
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)
    usual = [signal.getsignal(number) for number in stopping.SIGNALS]
    with stopping.deferred():
        assert [signal.getsignal(number) for number in stopping.SIGNALS] != usual
    assert [signal.getsignal(number) for number in stopping.SIGNALS] == usual


def test_a_child_ends_with_a_parent_that_is_killed(tmp_path: Path) -> None:
    child = "import time; from romnav import stopping; stopping.end_with_parent(); print(flush=True); time.sleep(60)"
    parent = (
        "import subprocess, sys; from romnav import stopping\n"
        f"child = subprocess.Popen([sys.executable, '-c', {child!r}], env=stopping.child(), stdout=subprocess.PIPE)\n"
        "child.stdout.readline(); print(child.pid, flush=True); child.wait()"
    )
    with subprocess.Popen([sys.executable, "-c", parent], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        pid = int(process.stdout.readline())
        process.kill()
    assert ends(pid, 30.0)


def ends(pid: int, within: float) -> bool:
    """Whether a process that is nobody's child ends within some seconds."""
    deadline = time.monotonic() + within
    while _alive(pid):
        if time.monotonic() > deadline:
            return False
        time.sleep(0.05)
    return True


def _alive(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return False
    return state not in "ZX"
