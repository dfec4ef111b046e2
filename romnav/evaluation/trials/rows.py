"""Rows of trials in scenes: one parquet file per arm, training seed and experiment, one row per trial and filter."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from romnav.errors import RomnavError
from romnav.evaluation.rowfile import POSES, Provenance, RowFile

SCHEMA = pa.schema(
    [
        pa.field("scene", pa.string()),
        pa.field("filter", pa.bool_()),  # whether the safety filter was on
        pa.field("trial", pa.int64()),  # 0 .. n - 1 in each scene; the same start and goal with the filter off and on
        *(pa.field(name, pa.float64()) for name in POSES),  # m, m, m, rad
        pa.field("geodesic", pa.float64()),  # planar length of the shortest path, m
        pa.field("success_time", pa.float64()),  # s; NaN if never
        pa.field("outcome", pa.string()),
        pa.field("time", pa.float64()),  # at which the trial ended, s
        pa.field("path_length", pa.float64()),  # planar, m
        pa.field("final_distance", pa.float64()),  # geodesic, at the end, m
        pa.field("collisions", pa.int64()),  # contacts of the body with a solid, a second apart
        pa.field("contact_time", pa.float64()),  # in contact, s
        pa.field("brink_time", pa.float64()),  # stopped by a drop-off, s
        pa.field("acting_time", pa.float64()),  # the filter changes the command, s
        pa.field("held_time", pa.float64()),  # the filter leaves next to nothing of it, s
        pa.field("blocked", pa.bool_()),  # timed out, and at the end the filter held the robot where it stood
        pa.field("hits", pa.list_(pa.int16())),  # periods in which the collisions began
        pa.field("track", pa.list_(pa.int16())),  # x, y, z after every period from the start on, cm
    ]
)
FILE = RowFile("trials", version=1, schema=SCHEMA, again="run the experiment again", compression="zstd")


@dataclass(frozen=True)
class TrialRows:
    """The rows of one arm and training seed, and where they come from."""

    arm: str
    seed: int
    columns: Mapping[str, NDArray]
    """Name to array of shape (n,), see ``SCHEMA``; ``hits`` and ``track`` hold an int16 array each."""
    provenance: Provenance

    @property
    def scenes(self) -> list[str]:
        """Names of the scenes in the order of their rows."""
        return list(dict.fromkeys(self.columns["scene"]))

    def of(self, scene: str, filtered: bool) -> dict[str, NDArray]:
        """Columns of one scene with the filter off or on, by trial."""
        mask = (self.columns["scene"] == scene) & (self.columns["filter"] == filtered)
        return {name: column[mask] for name, column in self.columns.items()}

    def tracks(self, scene: str, filtered: bool) -> list[NDArray[np.float64]]:
        """Positions (K, 3) of each trial, m."""
        return [track.reshape(-1, 3) / 100.0 for track in self.of(scene, filtered)["track"]]


def write(path: Path, rows: TrialRows) -> None:
    """Writes rows to a parquet file, whole or not at all.

    Raises:
        RomnavError: The folder cannot be written or the disk is full.
    """
    FILE.write(path, rows.columns, rows.provenance, arm=rows.arm, seed=str(rows.seed))


def read(path: Path) -> TrialRows:
    """Reads and validates rows.

    Raises:
        RomnavError: The file is missing, truncated, of another schema, or its rows are impossible.
    """
    table, provenance, facts = FILE.read(path, "arm", "seed")
    if table.schema.names != SCHEMA.names or not facts["seed"].isdecimal():
        raise RomnavError(f"{path}: not the columns and the seed of trials; {FILE.again}")
    columns = {name: _array(table.column(name).to_pylist(), SCHEMA.field(name).type) for name in SCHEMA.names}
    _check(columns, path)
    return TrialRows(facts["arm"], int(facts["seed"]), columns, provenance)


def _array(values: list, kind: pa.DataType) -> NDArray:
    if not pa.types.is_list(kind):
        return np.array(values, dtype=object if pa.types.is_string(kind) else kind.to_pandas_dtype())
    out = np.empty(len(values), object)
    out[:] = [np.array(value, np.int16) for value in values]
    return out


def _check(c: Mapping[str, NDArray], path: Path) -> None:
    time, success = c["success_time"], np.isfinite(c["success_time"])
    holds: dict[str, NDArray] = {
        "success_time": ~success | (time > 0),
        "collisions": c["collisions"] == [len(hits) for hits in c["hits"]],
        "track": np.array([len(track) >= 6 and len(track) % 3 == 0 for track in c["track"]], bool),
        **{name: c[name] >= 0 for name in ("geodesic", "time", "path_length", "contact_time", "held_time")},
    }
    FILE.require(c, holds, str(path), "row")
    for scene in dict.fromkeys(c["scene"]):
        off, on = (c["trial"][(c["scene"] == scene) & (c["filter"] == f)] for f in (False, True))
        if not np.array_equal(off, np.arange(len(off))) or not np.array_equal(on, off):
            raise RomnavError(f"{path}: scene {scene}: trials with the filter off and on do not pair; {FILE.again}")
