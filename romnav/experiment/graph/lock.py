"""One process at a time makes a stage."""

from __future__ import annotations

import fcntl
import os
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from romnav import files


@contextmanager
def held(path: Path, wait: Callable[[str], None]) -> Iterator[bool]:
    """Holds the lock that is the file ``path``; yields whether another process held it before.

    The system takes the lock from a process that ends, however it ends: none is ever stale.

    Args:
        path: A file that is there while the lock is held, and tells by whom.
        wait: Is told who holds it, before waiting for that.

    Raises:
        RomnavError: The folder cannot be written, or its file system has no locks.
    """
    try:
        file, waited = _acquire(path, wait)
    except OSError as error:
        raise files.unwritable(path, error) from error
    with file:
        try:
            yield waited
        finally:
            path.unlink(missing_ok=True)


def _acquire(path: Path, wait: Callable[[str], None]) -> tuple[TextIO, bool]:
    path.parent.mkdir(parents=True, exist_ok=True)
    waited = False
    while True:
        file = path.open("a+", encoding="utf-8")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            wait(file.read() or "another process")
            fcntl.flock(file, fcntl.LOCK_EX)
            waited = True
        if _is(file, path):
            file.truncate(0)
            file.write(f"process {os.getpid()} on {socket.gethostname()}")
            file.flush()
            return file, waited
        file.close()  # whoever held it took the file away


def _is(file: TextIO, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except FileNotFoundError:
        return False
