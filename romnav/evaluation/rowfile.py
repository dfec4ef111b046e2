"""Files of rows, one an episode or a trial: parquet with a schema, its version and where the rows come from.

Rows are all that evaluation hands on: metrics, tables and figures are pure functions of them.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray
from pydantic import ValidationError

from romnav import files
from romnav.config import Config
from romnav.errors import RomnavError

OUTCOMES = ("success", "fall", "timeout")
POSES = tuple(f"{end}_{axis}" for end in ("spawn", "goal") for axis in ("x", "y", "z", "yaw"))
"""Columns of start and goal, m, m, m, rad."""


class Provenance(Config):
    """Where a file of rows comes from."""

    scale: str
    """Scale of the run: smoke, cpu or paper."""
    commit: str
    """Git commit of the code that evaluated."""
    spec_hash: str
    """Hash of the arm's resolved specification."""
    checkpoint_sha256: str | None
    """Hash of the evaluated checkpoint; none for a scripted arm."""
    episode_set: str
    """Hash of the set of initial conditions."""
    version: str
    """Version of romnav."""
    steps: int
    """Environment steps of training; 0 for a scripted arm."""
    hours: float
    """Wall-clock time of training, h."""
    machine: str
    """Processor or GPU, and the operating system."""
    duration: float | None = None
    """Longest episode, s; files from before it was written down do not tell."""
    reach: float | None = None
    """Distance to the goal that is success, m; likewise."""


@dataclass(frozen=True)
class RowFile:
    """A kind of file of rows."""

    key: str
    """What the rows are, the metadata key of their version."""
    version: int
    """Version of the schema."""
    schema: pa.Schema
    """Columns and their types."""
    again: str
    """What to do where a file is damaged."""
    compression: str
    """Codec of parquet."""

    def write(self, path: Path, columns: Mapping[str, NDArray], provenance: Provenance, **facts: str) -> None:
        """Writes rows, whole or not at all; ``facts`` hold for all of them.

        Raises:
            RomnavError: The folder cannot be written or the disk is full.
        """
        about = {self.key: str(self.version), **facts, "provenance": provenance.model_dump_json()}
        metadata = {f"romnav.{key}": value for key, value in about.items()}
        arrays = {field.name: pa.array(columns[field.name], type=field.type) for field in self.schema}
        with files.atomic(path) as file:
            table = pa.table(arrays, schema=self.schema.with_metadata(metadata))
            pq.write_table(table, file, compression=self.compression, write_page_checksum=True)

    def read(self, path: Path, *facts: str) -> tuple[pa.Table, Provenance, dict[str, str]]:
        """Reads rows, where they come from, and the ``facts`` that hold for all of them.

        Raises:
            RomnavError: The file is missing, damaged, of another schema, or not what the record beside it tells of.
        """
        check_record(path, self.again)
        try:
            table = pq.ParquetFile(path, page_checksum_verification=True).read()
        except FileNotFoundError as error:
            raise RomnavError(
                f"{path}: no such file of {self.key}; {self.again.removesuffix(' again')} first"
            ) from error
        except Exception as error:
            # a damaged file can make the reader fail in any way
            raise RomnavError(f"{path}: not a readable parquet file (truncated?); {self.again}") from error
        stored = {key.decode(): value.decode() for key, value in (table.schema.metadata or {}).items()}
        about = {key.removeprefix("romnav."): value for key, value in stored.items() if key.startswith("romnav.")}
        if (version := about.get(self.key, "none")) != str(self.version):
            raise RomnavError(f"{path}: {self.key} of schema version {version}, not {self.version}; {self.again}")
        if missing := [fact for fact in facts if fact not in about]:
            raise RomnavError(f"{path}: metadata key {missing[0]} is missing; {self.again}")
        try:
            provenance = Provenance.model_validate_json(about.get("provenance", "{}"))
        except ValidationError as error:
            key = ".".join(str(part) for part in error.errors()[0]["loc"])
            raise RomnavError(f"{path}: provenance key {key}: {error.errors()[0]['msg']}; {self.again}") from error
        return table, provenance, {fact: about[fact] for fact in facts}

    def require(self, columns: Mapping[str, NDArray], holds: Mapping[str, NDArray], source: str, row: str) -> None:
        """Checks that what must hold of a column does, row by row; of the outcomes it always is the same.

        Args:
            columns: Arrays (n,).
            holds: Whether the value of a row is possible (n,), by column.
            source: The file, for the error.
            row: What a row is, for the error.

        Raises:
            RomnavError: A value is impossible.
        """
        success = np.isfinite(columns["success_time"])
        ended = np.isin(columns["outcome"], OUTCOMES) & ((columns["outcome"] == "success") == success)
        for name, ok in {"outcome": ended, **holds}.items():
            if not np.all(ok):
                worst = int(np.argmin(ok))
                value = columns[name][worst]
                raise RomnavError(f"{source}: {row} {worst} has an impossible {name} ({value}); {self.again}")


def check_record(path: Path, again: str) -> None:
    """Compares a file with the digest in the record beside it; without a record, rows stand for themselves.

    Args:
        path: The file; its record has its name and ends with ``.json``.
        again: What to do where it is another one.

    Raises:
        RomnavError: The file is not the recorded one, or the record is damaged.
    """
    record = path.with_suffix(".json")
    try:
        recorded = json.loads(record.read_text("utf-8"))["outputs"].get(path.name)
    except FileNotFoundError:
        return
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise RomnavError(f"{record}: damaged record; restore it, or delete it and {again}") from error
    if recorded and path.exists() and files.digest(path) != recorded:
        raise RomnavError(
            f"{path}: not the file that {record.name} recorded (truncated, edited); restore it, or delete it and "
            f"{again}"
        )
