"""Files that are written whole or not at all."""

from __future__ import annotations

import csv
import errno
import hashlib
import io
import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from romnav.errors import RomnavError

HINTS = {
    errno.ENOSPC: "free some disk space",
    errno.EDQUOT: "free some of your disk quota",
    errno.EACCES: "make its folder writable",
    errno.EPERM: "make its folder writable",
    errno.EROFS: "make its folder writable",
    errno.EEXIST: "move away what is in its place",
    errno.ENOTDIR: "move away what is in its place",
    errno.EISDIR: "move away what is in its place",
}


@contextmanager
def atomic(path: Path) -> Iterator[BinaryIO]:
    """Opens a file that replaces ``path`` in one step at the end; whoever reads sees the old one or the new.

    Raises:
        RomnavError: The folder cannot be written or the disk is full; the old file is untouched.
    """
    part = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with part.open("wb") as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            part.replace(path)
        except BaseException:
            part.unlink(missing_ok=True)
            raise
    except OSError as error:
        raise unwritable(path, error) from error


def prepare(path: Path) -> None:
    """Makes the folder of a file that is to be written after long work, and makes sure that it can be.

    Raises:
        RomnavError: It cannot.
    """
    if path.is_dir():
        raise RomnavError(f"{path}: cannot be written (is a folder); move it away")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise unwritable(path, error) from error


def write(path: Path, data: bytes | str) -> None:
    """Writes a file with ``atomic``; text in UTF-8."""
    with atomic(path) as file:
        file.write(data.encode() if isinstance(data, str) else data)


def csv_text(rows: Sequence[Mapping[str, Any]], columns: Sequence[str] = ()) -> str:
    """Rows as the text of a CSV file, floats to six digits.

    Without ``columns``, they are those of all rows; where one comes up along the rows, it is 0 above.
    """
    text = io.StringIO()
    found = dict.fromkeys(name for row in rows for name in row)
    writer = csv.DictWriter(text, columns or tuple(found), restval=0, lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow({name: x if isinstance(x, (int, str)) else f"{x:.6g}" for name, x in row.items()})
    return text.getvalue()


def digest(path: Path) -> str:
    """SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def unwritable(path: Path, error: OSError) -> RomnavError:
    """The user's view of a failed write to ``path``."""
    hint = HINTS.get(error.errno or 0, "check the path and the disk")
    return RomnavError(f"{path}: cannot be written ({(error.strerror or str(error)).lower()}); {hint}")
