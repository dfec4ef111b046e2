"""Arrays and facts in a file of a cache, in the format of safetensors: mapped, not read; nothing in it is ever run."""

from __future__ import annotations

import json
import math
import zlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from romnav import files
from romnav.errors import RomnavError

NAMES = {
    "BOOL": np.dtype(np.bool_),
    **{f"{kind.upper()}{8 * size}": np.dtype(f"{kind}{size}") for kind in "iu" for size in (1, 2, 4, 8)},
    "F32": np.dtype(np.float32),
    "F64": np.dtype(np.float64),
}
"""Types of arrays by their names in a file."""
ALIGNMENT = 64
"""The first array begins at a multiple of this, bytes."""


def save(path: Path, arrays: Mapping[str, NDArray], facts: Any) -> None:
    """Writes arrays, and facts: whatever JSON can tell.

    Raises:
        RomnavError: The file cannot be written.
    """
    types = {dtype: name for name, dtype in NAMES.items()}
    # widest elements first: so all of them lie aligned, without the gaps that the format forbids
    order = sorted(arrays, key=lambda name: -arrays[name].itemsize)
    metadata = {"facts": json.dumps(facts)}
    header: dict[str, Any] = {"__metadata__": metadata}
    end = 0
    for name in order:
        array = arrays[name]
        begin, end = end, end + array.nbytes
        header[name] = {"dtype": types[array.dtype], "shape": array.shape, "data_offsets": [begin, end]}
    parts = [np.ascontiguousarray(arrays[name]).reshape(-1).view(np.uint8).data for name in order]
    metadata["crc32"] = _checksum(header, parts)
    text = json.dumps(header).encode()
    text += b" " * (-(8 + len(text)) % ALIGNMENT)
    try:
        with files.atomic(path) as file:
            file.write(len(text).to_bytes(8, "little") + text)
            for part in parts:
                file.write(part)
    except RomnavError as error:
        raise RomnavError(
            f"{error}. {path.parent} is a cache: empty it, or make it a link to a folder elsewhere"
        ) from error


def load(path: Path) -> tuple[dict[str, NDArray], Any] | None:
    """The arrays and facts of a file, or None where it is missing, torn, altered or another format.

    Arrays are pages of the file, shared with other processes; who writes to one writes to a copy of its page.
    """
    try:
        data = np.memmap(path, np.uint8, "c")
        start = 8 + int.from_bytes(data[:8].tobytes(), "little")
        header = json.loads(data[8:start].tobytes())
        checksum = header["__metadata__"].pop("crc32")
        if checksum != _checksum(header, [data[start:]]):
            return None
        facts = json.loads(header.pop("__metadata__")["facts"])
        arrays = {}
        for name, entry in header.items():
            dtype, shape, (begin, end) = NAMES[entry["dtype"]], tuple(entry["shape"]), entry["data_offsets"]
            if min(shape, default=0) < 0 or end - begin != math.prod(shape) * dtype.itemsize or start + end > len(data):
                return None
            arrays[name] = np.asarray(data[start + begin : start + end]).view(dtype).reshape(shape)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None
    return arrays, facts


def _checksum(header: Mapping[str, Any], parts: Iterable[Any]) -> str:
    """CRC-32 of a header without its checksum and of the bytes behind it."""
    total = zlib.crc32(json.dumps(header).encode())
    for part in parts:
        total = zlib.crc32(part, total)
    return f"{total:08x}"
