"""Processes that compile the same kernels at once into one cache that is empty: all of them load the same code."""

from __future__ import annotations

import os
import subprocess
import sys
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parents[1]
PROCESSES = 8
WORK = """
import torch
from romnav.sensing.corruption import Corruption
from romnav.sensing.spec import CorruptionSpec
ranges = torch.linspace(0.1, 20.0, 6 * 8).view(1, 6, 8)
index = torch.zeros(1, dtype=torch.int32)
print(Corruption(CorruptionSpec(), 0)(ranges, index, index).sum().item())
"""
"""The quickest to compile of romnav's kernels."""


def race(kind: str, rounds: range, folder: Path) -> Counter[str]:
    """Numbered rounds of as many processes at once, each round with a cache of its own."""
    count: Counter[str] = Counter()
    for n in rounds:
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "WARP_CACHE_PATH": str(folder / str(n))}
        running = [
            subprocess.Popen(
                [sys.executable, "-c", WORK],
                env=environment,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
            )
            for _ in range(PROCESSES)
        ]
        told = [process.communicate() for process in running]
        answers = {out.splitlines()[-1] if out else "" for out, _ in told}
        well = len(answers) == 1 and not any(process.returncode for process in running)
        count["same bits" if well else "lost"] += 1
        if not well:
            failed = next((error for (_, error), p in zip(told, running, strict=True) if p.returncode), "")
            print(f"round {n}: {answers} {failed[-500:]}", flush=True)
    return count
