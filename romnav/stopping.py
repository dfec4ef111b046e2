"""Signals that ask the program to end, and when it does: a run saves first."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
PARENT = "ROMNAV_PARENT"
"""Environment variable with the process that another one works for."""
LOOK = 0.5
"""Time between two looks whether that is still there, s."""


class Stopped(KeyboardInterrupt):
    """A signal has asked the program to end."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = number
        """Of the signal."""


class Request:
    """Whether a signal has come."""

    def __init__(self) -> None:
        self._number: int | None = None

    def __bool__(self) -> bool:
        return self._number is not None

    def note(self, number: int, frame: Any = None) -> None:
        """Handles a signal. Ctrl-C a second time does not wait; others are repeated by programs, not in anger."""
        if number == self._number == signal.SIGINT:
            raise Stopped(number)
        self._number = number
        if number == signal.SIGINT:
            with suppress(OSError):
                os.write(2, b"\nsaving when this iteration is done; Ctrl-C again does not wait\n")

    def obey(self) -> None:
        """To be called where everything is saved.

        Raises:
            Stopped: A signal has come.
        """
        if self._number is not None:
            raise Stopped(self._number)


@contextmanager
def at_once() -> Iterator[None]:
    """Signals interrupt whatever is done, as Ctrl-C does."""

    def stop(number: int, frame: Any) -> None:
        raise Stopped(number)

    with _handled(stop):
        yield


@contextmanager
def deferred() -> Iterator[Request]:
    """Signals wait until a loop has saved what it has: it asks whether one has come, saves, and obeys."""
    request = Request()
    with _handled(request.note):
        yield request


@contextmanager
def _handled(handler: Callable[[int, Any], None]) -> Iterator[None]:
    """A signal that is ignored stays so: that is how nohup works."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in SIGNALS}
    taken = {number: old for number, old in before.items() if old not in (signal.SIG_IGN, None)}
    for number in taken:
        signal.signal(number, handler)
    try:
        yield
    finally:
        for number, old in taken.items():
            signal.signal(number, old)


def child() -> dict[str, str]:
    """The environment of a process that `end_with_parent` is to end with this one."""
    return {**os.environ, PARENT: str(os.getpid())}


def end_with_parent() -> None:
    """Sends SIGTERM to this process when the one that it works for is gone, however that ended."""
    parent = os.environ.pop(PARENT, "")
    if parent:
        threading.Thread(target=_watch, args=(int(parent),), daemon=True).start()


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(LOOK)
    os.kill(os.getpid(), signal.SIGTERM)
