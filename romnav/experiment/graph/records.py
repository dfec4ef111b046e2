"""What lies on disk beside every stage's output: a record of what made it."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import shlex
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

from romnav import __version__
from romnav.errors import RomnavError
from romnav.experiment.graph.stage import Stage
from romnav.files import digest, write

ROOT = Path(__file__).resolve().parents[3]
"""Folder of the code, a repository's where it is not installed."""
SUM = "sha256"
"""Key of a record's own checksum."""
UNKNOWN = "unknown"
"""Commit where git does not tell it."""
_PACKAGES = ("torch", "rsl-rl-lib", "mujoco", "warp-lang", "numpy")


@dataclass
class Record:
    """What made the output of a stage; without ``outputs`` it was begun but not finished."""

    key: str
    """Hash of the specification and of every upstream key."""
    spec: dict[str, Any]
    """Specification, resolved."""
    upstream: dict[str, dict[str, str]] = field(default_factory=dict)
    """Digests of the files that the stage read, by the name of the stage that wrote them."""
    outputs: dict[str, str] = field(default_factory=dict)
    """Digests of the files that the stage wrote."""
    facts: dict[str, Any] = field(default_factory=dict)
    """What the stage reported of itself, e.g. its training steps."""
    seconds: float = 0.0
    """Duration of the session that finished it, s."""
    provenance: dict[str, Any] = field(default_factory=dict)
    """Commit, versions and machine."""


def read(stage: Stage) -> Record | None:
    """The record of a stage, if there is one.

    Raises:
        RomnavError: It is damaged.
    """
    try:
        data = json.loads(stage.record.read_text("utf-8"))
        if data.pop(SUM, None) not in (None, checksum(data)):
            raise ValueError(f"its content does not have the {SUM} that it states")
        return Record(**data)
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise RomnavError(
            f"{stage.record}: damaged record ({error}); restore it, or delete it to run the stage again"
        ) from error


def finished(stage: Stage) -> bool:
    """Whether the output of a stage is there, whole, and made from its present specification.

    Raises:
        RomnavError: An output is not the file that was recorded.
    """
    record = read(stage)
    if record is None or record.key != stage.key:
        return False
    return _whole(stage, record) and _read_what_is_there(stage, record)


def drawn(stage: Stage) -> bool:
    """Whether a report is there and shows what is recorded, be that up to date itself or not.

    Raises:
        RomnavError: As `finished`.
    """
    record = read(stage)
    if record is None or record.spec != stage.spec or not _whole(stage, record):
        return False
    return record.upstream == {above.name: other.outputs for above in stage.upstream if (other := read(above))}


def _whole(stage: Stage, record: Record) -> bool:
    """Whether a stage's files are those that it recorded; none of them is another one."""
    if set(record.outputs) != set(stage.outputs) or not all((stage.folder / name).is_file() for name in stage.outputs):
        return False
    for name, recorded in record.outputs.items():
        if digest(stage.folder / name) != recorded:
            raise RomnavError(
                f"{stage.folder / name}: not the file that {stage.record.name} recorded (truncated, edited); "
                "restore it, or delete it to run the stage again"
            )
    return True


def _read_what_is_there(stage: Stage, record: Record) -> bool:
    """Whether all upstream outputs were read, and are those that were; records tell, the files may be gone."""
    if not record.upstream.keys() >= {above.name for above in stage.upstream}:
        return False  # a report of what there was
    for above in stage.upstream:
        other = read(above)
        if other is None or not other.outputs:
            continue
        if other.outputs != record.upstream.get(above.name) or not _read_what_is_there(above, other):
            return False
    return True


def retrieve(stage: Stage) -> bool:
    """Puts the files of a resumable stage's run with other settings aside, and those of this run back in place.

    Both may be interrupted at any point and done again: a record goes last and comes last.

    Returns:
        Whether this run had been put aside.

    Raises:
        RomnavError: The present record is damaged.
    """
    if not stage.scratch:
        return False
    names = [*dict.fromkeys((*stage.scratch, *stage.beside, *stage.outputs)), stage.record.name]
    old, mine = read(stage), _aside(stage, stage.key)
    if old and old.key != stage.key:
        present = [name for name in names if (stage.folder / name).exists()]
        if present == [stage.record.name] and not old.outputs:
            stage.record.unlink()  # it had only been begun
        else:
            _move(present, stage.folder, _aside(stage, old.key))
    if not mine.is_dir():
        return False
    _move([name for name in names if (mine / name).exists()], mine, stage.folder)
    shutil.rmtree(mine)
    return True


def _aside(stage: Stage, key: str) -> Path:
    return stage.folder / "replaced" / key[:16]


def _move(names: Sequence[str], source: Path, target: Path) -> None:
    """Moves files and folders; those that are there already stay as they are."""
    target.mkdir(parents=True, exist_ok=True)
    for name in names:
        if not (target / name).exists():
            (source / name).rename(target / name)


def begin(stage: Stage, resume: bool) -> Record:
    """Marks a stage as begun where it is resumable or is made again; without ``resume``, drops what there is of it.

    Returns:
        The record to finish, with what the stage is about to read.

    Raises:
        RomnavError: Its folder cannot be written, which is better known before the work than after it.
    """
    above = {stage.name: read(stage) for stage in stage.upstream}
    record = Record(stage.key, stage.spec, {name: other.outputs for name, other in above.items() if other})
    old = read(stage)
    if stage.scratch and (not resume or old is None):
        for path in (stage.folder / name for name in (*stage.scratch, *stage.beside)):
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)
    if stage.scratch or (old and old.key == stage.key):  # the old record would vouch for files that are replaced
        _write(stage, record)
    return record


def finish(stage: Stage, record: Record, old: Record | None, facts: dict[str, Any], seconds: float) -> None:
    """Records a finished stage; the ``old`` record stays if this one would only tell of another time and place."""
    record.outputs = {name: digest(stage.folder / name) for name in stage.outputs}
    record.facts = facts
    if old and all(getattr(old, name) == getattr(record, name) for name in ("key", "upstream", "outputs", "facts")):
        record = old
    else:
        record.seconds = round(seconds, 1)
        record.provenance = provenance()
    _write(stage, record)
    for name in stage.scratch:  # a run that is killed before this goes on from there
        (stage.folder / name).unlink(missing_ok=True)


def _write(stage: Stage, record: Record) -> None:
    data = json.loads(json.dumps(asdict(record)))  # as it will be read
    write(stage.record, json.dumps({**data, SUM: checksum(data)}, indent=2) + "\n")


def checksum(data: dict[str, Any]) -> str:
    """SHA-256 of a record's content, however it is laid out; a record without one, of an older version, is believed."""
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()


def differences(stage: Stage) -> list[str]:
    """What a stage's specification changed since its record, as ``key: old -> new``."""
    record = read(stage)
    if record is None:
        return []
    old, new = _flat(record.spec), _flat(stage.spec)
    return [f"{key}: {old.get(key)} -> {new.get(key)}" for key in sorted({*old, *new}) if old.get(key) != new.get(key)]


def _flat(data: Any, prefix: str = "") -> dict[str, Any]:
    if not isinstance(data, dict):
        return {prefix: data}
    return {k: v for key, value in data.items() for k, v in _flat(value, f"{prefix}.{key}".strip(".")).items()}


def provenance() -> dict[str, Any]:
    """Commit, versions, machine and command of this process, and the time."""
    command = shlex.join(["romnav", *sys.argv[1:]])
    return {**_process(), "command": command, "finished": datetime.now(UTC).isoformat(timespec="seconds")}


@cache
def _process() -> dict[str, Any]:
    return {
        "commit": commit(),
        "romnav": __version__,
        "python": platform.python_version(),
        **{name: _version(name) for name in _PACKAGES},
        "machine": f"{_processor()}, {os.cpu_count()} threads, {platform.system()} {platform.release()}",
    }


def commit() -> str:
    """Git commit of the code, with ``-dirty`` where code or experiments differ; where it is installed, its version."""
    if not (ROOT / ".git").exists():
        return f"v{__version__}"
    head = _git("rev-parse", "HEAD")
    changed = _git("status", "--porcelain", "--", "romnav", "experiments/*.toml", "pyproject.toml")
    return f"{head}{'-dirty' if changed else ''}" if head else UNKNOWN


def _git(*arguments: str) -> str:
    """What git prints; nothing where it fails."""
    try:
        done = subprocess.run(["git", "-C", ROOT, *arguments], capture_output=True, text=True)
    except OSError:
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "none"


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()
