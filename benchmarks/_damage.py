"""Files with an end cut off or a bit flipped: what their readers make of them."""

from __future__ import annotations

import functools
import hashlib
import json
import multiprocessing
import shutil
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from romnav.errors import RomnavError
from romnav.evaluation import episodes, tracks
from romnav.evaluation.paired import rows
from romnav.evaluation.trials import rows as trial_rows
from romnav.experiment.graph import records
from romnav.experiment.graph.stage import Stage, digest
from romnav.experiment.scales import ScaleFile
from romnav.experiment.spec import load_experiments
from romnav.navigation import checkpoint
from romnav.robot import gaits
from romnav.robot.locomotion import train as locomotion
from romnav.sensing import encoder
from romnav.world import build as worlds
from romnav.world.spec import WorldSpec

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "results"
WORLD = WorldSpec(tiles=1, side=12.0, classes=("building",), max_storeys=1, goals_per_tile=4)
OUTCOMES = ("refused", "unharmed", "another", "traceback", "crash")
"""One clear line; read as if nothing were; read as something else without a word; a fault of ours; the end of the
process."""


@dataclass(frozen=True)
class File:
    """A kind of file: one of them, and how romnav reads it."""

    make: Callable[[Path], None]
    read: Callable[[Path], Any]
    by_hand: bool = False
    """Whether people write it: then another text can be another wish."""


def _copy(path: Path) -> Callable[[Path], None]:
    return lambda target: shutil.copy(path, target)


def _anew(kind: Any, path: Path) -> Callable[[Path], None]:
    return lambda target: kind.write(target, kind.read(path))


def _make_world(target: Path) -> None:
    worlds.build(WORLD, target.parent)
    next(target.parent.glob("world-*")).rename(target)


def _read_world(path: Path) -> bytes:
    """The cache is asked for a world: a damaged one is made anew, which is not the file's content but the truth."""
    from romnav import arrays

    stored = arrays.load(path)
    if stored is None:
        raise RomnavError(f"{path}: made anew")
    return json.dumps([stored[1], sorted(stored[0])]).encode() + b"".join(a.tobytes() for a in stored[0].values())


def _make_tracks(target: Path) -> None:
    walk = np.cumsum(np.random.default_rng(0).normal(0, 0.1, (300, 4)), 0).astype(np.float32)
    first = np.array([0, 100, 300])
    tracks.write(target, tracks.Tracks(first, walk[:, :3], walk[:, 3], walk[:, 0] > 0), {"scale": "smoke"})


def _read_curve(path: Path) -> Any:
    """As stages read what others wrote: by the digest in the record beside it."""
    about = records.Record(key="k", spec={}, outputs={path.name: digest(CURVE)})
    stage = Stage("policy", "policy", path.parent, (path.name,), path, WORLD, (), lambda *told: {})
    if not records._whole(stage, about):
        raise RomnavError(f"{path}: missing")
    return pd.read_csv(path).to_csv()


def _make_record(target: Path) -> None:
    """One with a checksum, as records are written."""
    data = json.loads((RESULTS / "smoke/rom/seed-0/spec.json").read_text())
    data.pop(records.SUM, None)
    target.write_text(json.dumps({**data, records.SUM: records.checksum(data)}, indent=2) + "\n")


def _read_record(path: Path) -> Any:
    return records.read(Stage("policy", "policy", path.parent, (), path, WORLD, (), lambda *told: {}))


def _read_experiment(path: Path) -> Any:
    folder = path.parent / "experiments"
    folder.mkdir(exist_ok=True)
    shutil.copytree(ROOT / "experiments" / "scales", folder / "scales", dirs_exist_ok=True)
    shutil.copy(path, folder / "mine.toml")
    found, faults = load_experiments(folder)
    for fault in faults.values():
        raise fault
    return repr(found)


def _read_scale(path: Path) -> Any:
    shutil.copy(path, path.parent / "mine.toml")
    return repr(ScaleFile(path.parent, "mine").settings)


CURVE = RESULTS / "smoke" / "rom" / "seed-0" / "curve.csv"
FILES = {
    "policy or checkpoint": File(_copy(RESULTS / "smoke/rom/seed-0/policy.pt"), checkpoint.KIND.load),
    "encoder": File(_copy(RESULTS / "smoke/encoder/lidar/encoder.pt"), encoder.KIND.load),
    "locomotion policy": File(_copy(RESULTS / "cpu/locomotion/policy.pt"), locomotion.KIND.load),
    "gait library": File(_copy(RESULTS / "cpu/locomotion/gaits.pt"), gaits.KIND.load),
    "world": File(_make_world, _read_world),
    "episode set": File(_copy(ROOT / "experiments/episodes/dev.json"), episodes.load),
    "rows of episodes": File(_anew(rows, RESULTS / "smoke/rom/seed-0/episodes.parquet"), rows.read),
    "rows of trials": File(_anew(trial_rows, RESULTS / "smoke/rom/seed-0/safety.parquet"), trial_rows.read),
    "tracks": File(_make_tracks, tracks.read),
    "learning curve": File(_copy(CURVE), _read_curve),
    "record": File(_make_record, _read_record),
    "experiment": File(_copy(ROOT / "experiments/spawn-goal.toml"), _read_experiment, by_hand=True),
    "scale": File(_copy(ROOT / "experiments/scales/cpu.toml"), _read_scale, by_hand=True),
}


def damage(kind: str, trials: range, folder: Path) -> Counter[str]:
    """How ``kind`` of file fares in numbered trials: even ones cut its end off, odd ones flip a bit."""
    count: Counter[str] = Counter()
    for n in trials:
        try:
            count[_child().submit(_try, kind, n, folder).result()] += 1
        except BrokenProcessPool:
            count["crash"] += 1
            _child.cache_clear()
    return count


@functools.cache
def _child() -> ProcessPoolExecutor:
    """A process that may end in the middle of reading."""
    return ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn"))


@functools.cache
def _whole(kind: str, folder: Path) -> tuple[bytes, str]:
    """A file of a kind, and what is read from it."""
    path = folder / kind / "file"
    path.parent.mkdir(parents=True)
    FILES[kind].make(path)
    return path.read_bytes(), _plain(FILES[kind].read(path))


def _try(kind: str, n: int, folder: Path) -> str:
    whole, before = _whole(kind, folder)
    data = bytearray(whole)
    luck = np.random.default_rng([n, *kind.encode()])
    where = int(luck.integers(len(data)))
    if n % 2:
        data[where] ^= 1 << int(luck.integers(8))
    else:
        data = data[:where]
    path = folder / kind / "file"  # its name is part of what is read
    path.write_bytes(data)
    try:
        after = _plain(FILES[kind].read(path))
    except RomnavError as error:
        return "traceback" if "\n" in str(error) else "refused"
    except Exception as error:
        print(f"{kind} {n}: {error!r}", flush=True)
        return "traceback"
    return "unharmed" if after == before else "another"


def _plain(content: Any) -> str:
    """Everything that was read, as text."""
    import torch

    if isinstance(content, torch.Tensor):
        content = content.flatten().view(torch.uint8).numpy()
    if isinstance(content, np.ndarray):
        told = str(content.tolist()).encode() if content.dtype.hasobject else content.tobytes()
        return f"{content.dtype} {content.shape} {hashlib.sha256(told).hexdigest()}"
    if isinstance(content, dict):
        return str({str(key): _plain(value) for key, value in content.items()})
    if isinstance(content, list | tuple):
        return str([_plain(value) for value in content])
    if hasattr(content, "__dict__") and not isinstance(content, type):
        return _plain(vars(content))
    return repr(content)
