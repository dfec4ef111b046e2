from __future__ import annotations

import json
import os
import pickle
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from romnav import arrays

DTYPES = [np.bool_, np.int8, np.uint8, np.int16, np.uint16, np.int32, np.int64, np.float32, np.float64]
made = st.dictionaries(
    st.text("abcdefg.", min_size=1, max_size=4),
    st.sampled_from(DTYPES).flatmap(lambda dtype: hnp.arrays(dtype, hnp.array_shapes(min_dims=0, min_side=0))),
    max_size=5,
)


def read_by_the_format(path: Path) -> dict[str, np.ndarray]:
    """What a file holds by the published description of the format: length, header, data without gaps."""
    raw = path.read_bytes()
    length = int.from_bytes(raw[:8], "little")
    header: dict[str, Any] = json.loads(raw[8 : 8 + length])
    assert all(isinstance(value, str) for value in header.pop("__metadata__").values())
    data, names, out = raw[8 + length :], {"F": "f", "I": "i", "U": "u"}, {}
    end = 0
    for name, entry in sorted(header.items(), key=lambda item: item[1]["data_offsets"]):
        begin, last = entry["data_offsets"]
        assert begin == end
        end = last
        kind = entry["dtype"]
        dtype = np.dtype("?" if kind == "BOOL" else f"<{names[kind[0]]}{int(kind[1:]) // 8}")
        out[name] = np.frombuffer(data[begin:last], dtype).reshape(entry["shape"])
    assert end == len(data)
    return out


@settings(deadline=None)
@given(made, st.dictionaries(st.text(max_size=3), st.integers() | st.text(max_size=5), max_size=3))
def test_what_is_saved_is_loaded_and_is_in_the_format(given: dict[str, np.ndarray], facts: dict[str, Any]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "file"
        arrays.save(path, given, facts)
        stored = arrays.load(path)
        assert stored is not None
        assert stored[1] == facts
        for found in (stored[0], read_by_the_format(path)):
            assert found.keys() == given.keys()
            for name, array in given.items():
                assert found[name].dtype == array.dtype
                assert found[name].shape == array.shape
                assert found[name].tobytes() == array.tobytes()
        assert all(array.ctypes.data % array.itemsize == 0 for array in stored[0].values() if array.size)


@settings(deadline=None, max_examples=50)
@given(st.data())
def test_a_torn_or_altered_file_is_none(data: st.DataObject) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "file"
        arrays.save(path, {"a": np.arange(9), "b": np.ones((2, 3), np.float32)}, {"k": 1})
        whole = path.read_bytes()
        where = data.draw(st.integers(0, len(whole) - 1))
        altered = bytearray(whole)
        altered[where] ^= 1 << data.draw(st.integers(0, 7))
        path.write_bytes(whole[:where] if data.draw(st.booleans()) else altered)
        assert arrays.load(path) is None or whole[where : where + 1].isspace()


@pytest.mark.parametrize(
    "header",
    [
        {},
        {"__metadata__": {}},
        {"__metadata__": {"facts": "1"}, "a": {"dtype": "F32", "shape": [-1, -4], "data_offsets": [0, 16]}},
        {"__metadata__": {"facts": "1"}, "a": {"dtype": "F32", "shape": [1000], "data_offsets": [0, 4000]}},
        {"__metadata__": {"facts": "1"}, "a": {"dtype": "F32", "shape": [4], "data_offsets": [0, 8]}},
        {"__metadata__": {"facts": "1"}, "a": {"dtype": "O", "shape": [1], "data_offsets": [0, 8]}},
        {"__metadata__": {"facts": "1"}, "a": []},
        [],
    ],
)
def test_a_header_that_does_not_fit_its_data_is_none(tmp_path: Path, header: object) -> None:
    if isinstance(header, dict) and "__metadata__" in header:
        header = {**header, "__metadata__": dict(header["__metadata__"])}
        header["__metadata__"]["crc32"] = arrays._checksum(header, [bytes(16)])
    text = json.dumps(header).encode()
    (tmp_path / "file").write_bytes(len(text).to_bytes(8, "little") + text + bytes(16))
    assert arrays.load(tmp_path / "file") is None


def test_a_missing_file_is_none(tmp_path: Path) -> None:
    assert arrays.load(tmp_path / "nothing") is None


class Bomb:
    """Unpickling it makes a folder."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.path),)


def test_code_in_a_file_is_never_run(tmp_path: Path) -> None:
    pickle.loads(pickle.dumps(Bomb(tmp_path / "bomb works")))
    assert (tmp_path / "bomb works").exists()
    bomb = Bomb(tmp_path / "exploded")
    (tmp_path / "pickle").write_bytes(pickle.dumps(bomb))
    np.save(tmp_path / "array.npy", np.array([bomb], object), allow_pickle=True)
    np.savez(tmp_path / "arrays.npz", a=np.array([bomb], object))
    for name in ("pickle", "array.npy", "arrays.npz"):
        assert arrays.load(tmp_path / name) is None
    assert not (tmp_path / "exploded").exists()


def test_writing_to_an_array_leaves_the_file(tmp_path: Path) -> None:
    arrays.save(tmp_path / "file", {"a": np.zeros(4)}, None)
    stored = arrays.load(tmp_path / "file")
    assert stored is not None
    stored[0]["a"][:] = 7.0
    again = arrays.load(tmp_path / "file")
    assert again is not None
    assert (again[0]["a"] == 0.0).all()
