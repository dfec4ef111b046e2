"""One policy trained by one process and by two (torchrun): what they reach, and how much faster two are.

A run of two has as many environments in all as a run of one. Needs two idle cores; the processor time that it reports
does not.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pandas as pd
from _common import ROOT, markdown

from romnav import files
from romnav.experiment.graph import records

NAME = "processes"
COUNTS = (1, 2)
WARM_UP = 2
"""Iterations that are not timed."""
LAST = 0.1
"""Share of a run over which its success is told."""


def train(project: Path, scale: str, arm: str, seed: int, processes: int, results: Path) -> pd.DataFrame:
    """The learning curve of a run."""
    launcher = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(processes)]
    words = ["-m", "romnav.cli", "train", "policy", arm, "--scale", scale, "--seed", str(seed)]
    command = [sys.executable, *(launcher if processes > 1 else ()), *words, "--results", str(results)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    subprocess.run(command, cwd=project, env=environment, check=True)
    return pd.read_csv(results / scale / arm / f"seed-{seed}" / "curve.csv")


def facts(curve: pd.DataFrame) -> dict[str, float]:
    """Success at the end of a run, its nav-steps/s, and the processor seconds of a million steps."""
    last = curve[curve.steps > (1.0 - LAST) * curve.steps.iloc[-1]].dropna(subset="success")
    first, end = curve.iloc[WARM_UP - 1], curve.iloc[-1]
    steps = end.steps - first.steps
    return {
        "success": float(np.average(last.success, weights=last.episodes)),
        "steps_per_s": steps / (end.seconds - first.seconds),
        "cpu_seconds_per_million": 1e6 * (end.cpu_seconds - first.cpu_seconds) / steps,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--arm", default="rom")
    parser.add_argument("--scale", default="smoke")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--project", type=Path, default=ROOT)
    parser.add_argument("--out", type=Path, default=ROOT / "results/bench")
    given = parser.parse_args()
    runs: dict[int, list[dict[str, float]]] = {count: [] for count in COUNTS}
    with tempfile.TemporaryDirectory(prefix="romnav-processes-") as place:
        for seed in range(given.seeds):
            for count in COUNTS:
                results = Path(place) / str(count)
                if (encoder := given.project / "results" / given.scale / "encoder").exists():
                    shutil.copytree(encoder, results / given.scale / "encoder", dirs_exist_ok=True)
                runs[count].append(facts(train(given.project, given.scale, given.arm, seed, count, results)))
                print(f"seed {seed}, {count} processes: {runs[count][-1]}", flush=True)
    source = records.provenance()
    found = {
        "work": f"{given.arm} at scale {given.scale}, {given.seeds} seeds",
        "runs": {str(count): of for count, of in runs.items()},
        "speed_up": _mean(runs[2], "steps_per_s") / _mean(runs[1], "steps_per_s"),
        "cpu_ratio": _mean(runs[2], "cpu_seconds_per_million") / _mean(runs[1], "cpu_seconds_per_million"),
        "load": os.getloadavg()[1],
        "machine": source["machine"],
        "commit": source["commit"],
    }
    files.write(given.out / f"{NAME}.json", json.dumps(found, indent=2) + "\n")
    text = table(found)
    files.write(given.out / f"{NAME}.md", text)
    print(text)


def _mean(runs: list[dict[str, float]], name: str) -> float:
    return float(np.mean([run[name] for run in runs]))


def table(found: dict) -> str:
    """The measurements as Markdown."""
    rows = []
    for count, runs in found["runs"].items():
        success = ", ".join(f"{100 * run['success']:.1f}" for run in runs)
        rate, cpu = _mean(runs, "steps_per_s"), _mean(runs, "cpu_seconds_per_million")
        rows.append([count, success, f"{rate:,.0f}", f"{cpu:.0f}"])
    head = f"{found['work']}. Two processes are {found['speed_up']:.2f} times as fast. Load {found['load']:.1f}.\n\n"
    columns = ["processes", "success at the end, % by seed", "nav-steps/s", "CPU-s per 1 M steps"]
    return head + markdown(columns, rows)


if __name__ == "__main__":
    main()
