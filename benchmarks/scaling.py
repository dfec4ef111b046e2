"""Speed and memory of training against its size: 64 to 4,096 environments, 12 to 256 tiles.

Every size runs in a process of its own, at the "cpu" scale otherwise: one iteration to warm up, then the median of
three, and the peak memory of the process. There is no peer; ``romnav bench training`` has one.
"""

from __future__ import annotations

import json
import statistics
import tempfile
import time
from pathlib import Path

import torch
from _common import CORES, arguments, in_children, markdown
from _learner import load_world, ours, scale

from romnav import files
from romnav.experiment.graph import records
from romnav.world.lookup import GeodesicLookup

ENVS = (64, 128, 256, 512, 1024, 2048, 4096)
TILES = (12, 24, 48, 96, 192, 256)
MEBI = 2**20


def training(envs: int, tiles: int, repeats: int) -> dict[str, float]:
    """Median nav-steps/s, learning included."""
    torch.set_num_threads(CORES)
    s = scale(envs=envs, tiles=tiles)
    learner = ours(s, load_world(s.world))
    rates = [learner.iterate() for _ in range(repeats + 1)][1:]
    return {"nav_steps_per_s": statistics.median(rates)}


def terrain(tiles: int) -> dict[str, float]:
    """Time to build and to load a world, and the memory of its geodesics."""
    torch.set_num_threads(CORES)
    spec = scale(tiles=tiles).world
    with tempfile.TemporaryDirectory() as folder:
        times = []
        for _ in range(2):
            start = time.perf_counter()
            world = load_world(spec, Path(folder))
            times.append(time.perf_counter() - start)
        size = sum(file.stat().st_size for file in Path(folder).iterdir())
    start = time.perf_counter()
    GeodesicLookup(world)
    return {
        "build_s": times[0],
        "load_s": times[1],
        "lookup_s": time.perf_counter() - start,
        "file_mb": size / MEBI,
        "goals": len(world.goal),
        "nodes": len(world.position),
        "fields_mb": world.fields.numel() * world.fields.element_size() / MEBI,
    }


def main() -> None:
    """Measure, print and write ``results/bench/scaling.json``."""
    options = arguments(__doc__, repeats=3)
    default = scale()
    source = records.provenance()
    rows: dict[str, list[dict[str, float]]] = {"envs": [], "tiles": []}
    load_world(default.world)
    for envs in ENVS:
        [(measured, peak)] = in_children(training, envs, default.world.tiles, options.repeats)
        rows["envs"].append({"envs": envs, **measured, "peak_mb": peak})
        print(rows["envs"][-1], flush=True)
    for tiles in TILES:
        [(built, _)] = in_children(terrain, tiles)
        load_world(scale(tiles=tiles).world)
        [(measured, peak)] = in_children(training, default.navigation.env.envs, tiles, options.repeats)
        rows["tiles"].append({"tiles": tiles, **measured, "peak_mb": peak, **built})
        print(rows["tiles"][-1], flush=True)
    text = f"Training against its size. {source['machine']}.\n"
    for table in rows.values():
        values = [[f"{value:.4g}" for value in row.values()] for row in table]
        text += "\n" + markdown(list(table[0]), values)
    print(text)
    record = {"work": "training against its size", **rows, "machine": source["machine"], "commit": source["commit"]}
    files.write(options.out / "scaling.json", json.dumps(record, indent=2) + "\n")
    files.write(options.out / "scaling.md", text)


if __name__ == "__main__":
    main()
