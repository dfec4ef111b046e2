"""Episode rows: one parquet file per arm and training seed, one row per evaluation episode."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import ArrayLike, NDArray

from romnav.errors import RomnavError
from romnav.evaluation.rowfile import POSES, Provenance, RowFile
from romnav.evaluation.spec import HORIZONS, ROWS_VERSION

SUCCESS_RADIUS = 0.5
"""Distance to the goal that counts as success, m (paper, Sec. IV-A)."""
WHERE = ("same level", "never on a stair", "on a stair", "on the goal's level")
"""How far the robot of a failed episode got: goals on the spawn's level; for the others, the last that it reached."""
HOW = ("fell", "pressed", "stood", "circled", "roamed")
"""What it did in the end, see `failures`."""

SCHEMA = pa.schema(
    [
        pa.field("arm", pa.string()),
        pa.field("seed", pa.int64()),  # of the training run
        pa.field("episode", pa.int64()),  # 0 .. n - 1
        pa.field("tile", pa.int64()),
        pa.field("tile_class", pa.string()),
        pa.field("multi_story", pa.bool_()),
        *(pa.field(name, pa.float64()) for name in POSES),  # m, m, m, rad
        pa.field("geodesic", pa.float64()),  # planar length of the shortest path from spawn to goal, m
        pa.field("level", pa.string()),  # "same" or "cross": does the goal lie on another level
        pa.field("success_time", pa.float64()),  # first time within SUCCESS_RADIUS in 3D, s; NaN if never
        pa.field("outcome", pa.string()),
        pa.field("time", pa.float64()),  # at which the episode ended, s
        pa.field("path_length", pa.float64()),  # planar, sampled at 5 Hz until the end, m
        pa.field("final_distance", pa.float64()),  # geodesic, at the end, m; may be infinite
        pa.field("collisions", pa.int64()),  # steps with contact
        pa.field("where", pa.string()),  # one of WHERE; empty where the goal was reached
        pa.field("how", pa.string()),  # one of HOW; likewise
    ]
)
FILE = RowFile("rows", version=ROWS_VERSION, schema=SCHEMA, again="evaluate the arm again", compression="snappy")


@dataclass(frozen=True)
class EpisodeRows:
    """The rows of one evaluated arm and training seed, in order of the episode id.

    Attributes:
        columns: Name to array of shape (n,), see ``SCHEMA``.
        provenance: Where the rows come from.
        source: The file they were read from (or will be called by in an error).
    """

    columns: Mapping[str, NDArray]
    provenance: Provenance
    source: str = "rows"

    @property
    def arm(self) -> str:
        """Name of the arm."""
        return str(self.columns["arm"][0])

    @property
    def seed(self) -> int:
        """Seed of the training run."""
        return int(self.columns["seed"][0])

    def __len__(self) -> int:
        return len(self.columns["episode"])


@dataclass(frozen=True)
class Arm:
    """An arm over its training seeds, all evaluated on the same episodes."""

    name: str
    runs: tuple[EpisodeRows, ...]

    def stack(self, column: str) -> NDArray:
        """A column of every training seed, shape (seeds, n)."""
        return np.stack([run.columns[column] for run in self.runs])


def make(columns: Mapping[str, ArrayLike], provenance: Provenance, source: str = "rows") -> EpisodeRows:
    """Validates columns and puts them in order of the episode id.

    Raises:
        RomnavError: A column is missing, has another type, or holds impossible values.
    """
    if missing := [name for name in SCHEMA.names if name not in columns]:
        raise RomnavError(f"{source}: column(s) {', '.join(missing)} missing; evaluate the arm again")
    if unknown := sorted(set(columns) - set(SCHEMA.names)):
        raise RomnavError(f"{source}: unknown column(s) {', '.join(unknown)}")
    arrays: dict[str, NDArray] = {}
    for field in SCHEMA:
        array = np.asarray(columns[field.name])
        kind = {"string": "OUT", "bool": "b", "int64": "iu", "double": "fiu"}[str(field.type)]
        if array.ndim != 1 or array.dtype.kind not in kind:
            raise RomnavError(f"{source}: column {field.name} must hold {field.type}, not {array.dtype}")
        arrays[field.name] = array.astype(object if kind == "OUT" else field.type.to_pandas_dtype())
    if len({len(array) for array in arrays.values()}) != 1 or not len(arrays["episode"]):
        raise RomnavError(f"{source}: columns are empty or of different lengths; evaluate the arm again")
    order = np.argsort(arrays["episode"], kind="stable")
    arrays = {name: array[order] for name, array in arrays.items()}
    _check(arrays, source)
    return EpisodeRows(arrays, provenance, source)


def _check(c: Mapping[str, NDArray], source: str) -> None:
    episodes, n = c["episode"], len(c["episode"])
    repeated = np.unique(episodes[:-1][np.diff(episodes) == 0])
    if len(repeated):
        raise RomnavError(f"{source}: episode(s) {_some(repeated)} occur twice; evaluate the arm again")
    if not np.array_equal(episodes, np.arange(n)):
        missing = np.setdiff1d(np.arange(episodes[-1] + 1), episodes)
        raise RomnavError(f"{source}: episode(s) {_some(missing)} missing; evaluate the arm again")
    time, failed = c["success_time"], c["outcome"] != "success"
    holds: dict[str, NDArray] = {
        "arm": c["arm"] == c["arm"][0],
        "seed": c["seed"] == c["seed"][0],
        "tile_class": c["tile_class"] != "",
        "level": np.isin(c["level"], ("same", "cross")),
        "success_time": np.isnan(time) | ((time >= 0) & (time <= HORIZONS[-1])),
        "final_distance": c["final_distance"] >= 0,
        "collisions": c["collisions"] >= 0,
        "where": np.where(failed, np.isin(c["where"], WHERE), c["where"] == ""),
        "how": np.where(failed, np.isin(c["how"], HOW), c["how"] == ""),
        **{name: np.isfinite(c[name]) & (c[name] >= 0) for name in ("geodesic", "time", "path_length")},
        **{name: np.isfinite(c[name]) for name in POSES},
    }
    FILE.require(c, holds, source, "episode")


def _some(ids: NDArray) -> str:
    shown = ", ".join(str(i) for i in ids[:3])
    return shown if len(ids) <= 3 else f"{shown}, ... ({len(ids)} in all)"


def write(path: Path, rows: EpisodeRows) -> None:
    """Writes rows to a parquet file, whole or not at all.

    Raises:
        RomnavError: The folder cannot be written or the disk is full.
    """
    FILE.write(path, rows.columns, rows.provenance)


def read(path: Path) -> EpisodeRows:
    """Reads and validates rows.

    Raises:
        RomnavError: The file is missing, truncated, of another schema, or its rows are impossible.
    """
    table, provenance, _ = FILE.read(path)
    return make(table.to_pydict(), provenance, str(path))  # to_numpy would import pandas


def pair(runs: Iterable[EpisodeRows]) -> list[Arm]:
    """Groups runs into arms (in order of first appearance) and checks that all saw the same episodes.

    Raises:
        RomnavError: Two runs differ in episode set, in episodes or in how they were evaluated; one is given twice.
    """
    runs = list(runs)
    groups: dict[str, dict[int, EpisodeRows]] = {}
    for run in runs:
        _same_episodes(runs[0], run)
        seeds = groups.setdefault(run.arm, {})
        if run.seed in seeds:
            raise RomnavError(
                f"{seeds[run.seed].source} and {run.source}: both hold {run.arm}, seed {run.seed}; remove one"
            )
        seeds[run.seed] = run
    return [Arm(name, tuple(seeds[seed] for seed in sorted(seeds))) for name, seeds in groups.items()]


def _same_episodes(a: EpisodeRows, b: EpisodeRows) -> None:
    both = f"{a.source} and {b.source}"
    if a.provenance.episode_set != b.provenance.episode_set:
        raise RomnavError(
            f"{both}: rows of different episode sets, {a.provenance.episode_set} and "
            f"{b.provenance.episode_set}; evaluate both on the same set"
        )
    for name, unit in (("duration", "s"), ("reach", "m")):
        mine, other = getattr(a.provenance, name), getattr(b.provenance, name)
        if None not in (mine, other) and mine != other:
            raise RomnavError(
                f"{both}: evaluated with a {name} of {mine} and {other} {unit}; evaluate both alike (evaluation.{name})"
            )
    if len(a) != len(b):
        raise RomnavError(
            f"{both}: {len(a)} and {len(b)} episodes of set {a.provenance.episode_set}; evaluate the shorter one again"
        )
    for name in ("tile", "level"):
        if not np.array_equal(a.columns[name], b.columns[name]):
            raise RomnavError(
                f"{both}: episodes differ in {name} although both name set {a.provenance.episode_set}; "
                "evaluate both arms again"
            )
