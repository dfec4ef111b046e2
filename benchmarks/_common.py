"""What the benchmarks share: work taking turns, reports, and the learner of the "cpu" scale."""

from __future__ import annotations

import argparse
import importlib
import json
import multiprocessing
import os
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

from romnav import files
from romnav.experiment.graph import records
from romnav.threads import cores

ROOT = Path(__file__).parents[1]
CORES = cores()


def arguments(description: str | None, **options: int) -> argparse.Namespace:
    """Command line of a benchmark: ``options`` with their defaults, and where results go."""
    parser = argparse.ArgumentParser(description=description)
    for name, default in options.items():
        parser.add_argument(f"--{name.replace('_', '-')}", type=int, default=default)
    parser.add_argument("--out", type=Path, default=ROOT / "results/bench")
    return parser.parse_args()


def importable(module: str) -> bool:
    """Whether a peer can be used; says why not, as where its package or a library of the system is missing."""
    try:
        importlib.import_module(module)
    except ImportError as error:
        print(f"left out: {module} ({error})")
        return False
    return True


def take_turns(
    works: Mapping[str, Callable[[], object]],
    repeats: int,
    clock: Callable[[], float] = time.perf_counter,
    warm_up: int = 1,
) -> dict[str, list[float]]:
    """Times of each work, s, after ``warm_up`` calls that do not count.

    Works take turns, so that another load on the machine hits all of them.
    """
    times: dict[str, list[float]] = {name: [] for name in works}
    for turn in range(warm_up + repeats):
        for name, work in works.items():
            start = clock()
            work()
            if turn >= warm_up:
                times[name].append(clock() - start)
    return times


def report(
    name: str,
    work: str,
    unit: str,
    ours: Sequence[float],
    peers: Mapping[str, Sequence[float]],
    out: Path,
    *,
    agree: bool,
    larger_is_better: bool = False,
    **more: Any,
) -> None:
    """Print a comparison of repeated measurements as a Markdown table; write ``<name>.json`` and ``<name>.md``."""
    medians = {peer: statistics.median(values) for peer, values in peers.items()}
    own = statistics.median(ours)
    ratios = {peer: own / m if larger_is_better else m / own for peer, m in medians.items()}
    source = records.provenance()
    rows = [("romnav", own, ours, ""), *((p, m, peers[p], f"{ratios[p]:.2f}") for p, m in medians.items())]
    table = [
        [label, f"{median:.4g}", f"{min(values):.4g} to {max(values):.4g}", ratio]
        for label, median, values, ratio in rows
    ]
    text = f"{work}. {source['machine']}.\n\n"
    text += markdown(["", f"median, {unit}", "range", "ours is better by"], table)
    print(f"{text}\nsame answers: {'yes' if agree else 'NO'}", flush=True)
    record = {
        "work": work,
        "ours": own,
        "peers": medians,
        "unit": unit,
        "ratio_to_best_peer": min(ratios.values(), default=None),
        "agree": agree,
        **more,
        "machine": source["machine"],
        "load": os.getloadavg()[1],
        "commit": source["commit"],
    }
    files.write(out / f"{name}.json", json.dumps(record, indent=2) + "\n")
    files.write(out / f"{name}.md", text)


def markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def in_children(work: Callable[..., Any], *inputs: Any, count: int = 1) -> list[tuple[Any, float]]:
    """Results of ``work`` in ``count`` processes at once, each with the peak memory of its process, MB."""
    with ProcessPoolExecutor(count, mp_context=multiprocessing.get_context("spawn")) as pool:
        return [f.result() for f in [pool.submit(_with_peak, work, *inputs) for _ in range(count)]]


def _with_peak(work: Callable[..., Any], *inputs: Any) -> tuple[Any, float]:
    result = work(*inputs)
    # not getrusage: its peak begins with that of the parent
    status = Path("/proc/self/status").read_text().split()
    return result, int(status[status.index("VmHWM:") + 1]) / 1024
