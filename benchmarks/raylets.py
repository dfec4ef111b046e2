"""An ablation on a Ray cluster of two machines, which are processes of this one with a core each: the same rows as
without it, what it costs, and what is lost with a machine. The simulation of `cluster.py` is held against it.

Needs the extra ``ray`` and two idle cores.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import cluster
import numpy as np
from _common import ROOT, markdown

from romnav import files
from romnav.evaluation import episodes
from romnav.evaluation.paired import rows
from romnav.experiment.graph import records
from romnav.experiment.graph.run import with_all_above
from romnav.experiment.graph.stage import Stage
from romnav.experiment.kinds import reports
from romnav.experiment.project import Project
from romnav.experiment.workspace import Workspace
from romnav.world.build import build

NODES = 2
NAME = "raylets"


def warm(project: Path, scale: str) -> None:
    """Has the worlds in the cache, so that nobody's time is that of building them."""
    work = Workspace(Project(project, project / "results"), scale)
    file = project / "experiments" / "episodes" / f"{work.settings.evaluation.episodes}.json"
    for spec in (work.settings.world, episodes.load(file).world):
        build(spec, work.project.worlds)


def ablation(project: Path, experiment: str, scale: str, results: Path, *words: str, **variables: str) -> float:
    """Runs an ablation from nothing; how long it took, s."""
    begun = time.monotonic()
    command = [sys.executable, "-m", "romnav.cli", "run", "ablation", experiment, "--scale", scale, *words]
    paths = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    environment = {**os.environ, "PYTHONPATH": paths, "OMP_NUM_THREADS": "1", **variables}
    subprocess.run([*command, "--results", str(results)], cwd=project, env=environment, check=True)
    return time.monotonic() - begun


def on_ray(project: Path, experiment: str, scale: str, results: Path, plug: Callable[[], bool] | None = None) -> float:
    """The same on a cluster. A machine of it is gone from when ``plug`` first says so; it is asked now and then."""
    from ray.cluster_utils import Cluster

    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
    nodes = [made.add_node(num_cpus=1) for _ in range(NODES)]
    ended = threading.Event()

    def watch() -> None:
        while plug and not ended.wait(0.2):
            if plug():
                made.remove_node(nodes[0], allow_graceful=False)
                return

    watching = threading.Thread(target=watch)
    watching.start()
    try:
        return ablation(project, experiment, scale, results, "--on", "ray", RAY_ADDRESS=made.address)
    finally:
        ended.set()
        watching.join()
        made.shutdown()


def stages(project: Path, experiment: str, scale: str, results: Path) -> list[Stage]:
    """Of the ablation, upstream ones first."""
    work = Workspace(Project(project, results), scale)
    return cluster.upstream_first(with_all_above(reports(work, experiment, work.project.experiment(experiment).seeds)))


def simulated(of: Sequence[Stage]) -> float:
    """How long finished stages take on the cluster by the simulation, from what each took, s."""
    lasts = {stage.name: record.seconds for stage in of if (record := records.read(stage))}
    return cluster.simulate(of, lasts, NODES, 0.0, math.inf, 0)[0]


def same_rows(a: Path, b: Path) -> bool:
    """Whether two folders of results have the same arms with the same rows, to the bit."""
    mine, theirs = ({str(path.relative_to(folder)) for path in folder.rglob("episodes.parquet")} for folder in (a, b))
    return bool(mine) and mine == theirs and all(_same(a / name, b / name) for name in mine)


def _same(a: Path, b: Path) -> bool:
    one, other = rows.read(a).columns, rows.read(b).columns
    return one.keys() == other.keys() and all(
        np.array_equal(one[name], other[name], equal_nan=one[name].dtype.kind == "f") for name in one
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("experiment", nargs="?", default="spawn-goal")
    parser.add_argument("--scale", default="smoke")
    parser.add_argument("--project", type=Path, default=ROOT)
    parser.add_argument("--out", type=Path, default=ROOT / "results/bench")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="romnav-raylets-") as place:
        run, folder = (given.project, given.experiment, given.scale), Path(place)
        warm(given.project, given.scale)
        alone = ablation(*run, folder / "alone")
        there = on_ray(*run, folder / "ray")
        half = time.monotonic() + 0.5 * there
        killed = on_ray(*run, folder / "killed", plug=lambda: time.monotonic() > half)
        source = records.provenance()
        found = {
            "work": f"{given.experiment} at scale {given.scale}, {NODES} cores",
            "alone": alone,
            "ray": there,
            "overhead": there / alone - 1.0,
            "simulated": simulated(stages(*run, folder / "alone")),
            "killed": killed,
            "same_rows": same_rows(folder / "alone", folder / "ray"),
            "same_rows_after_kill": same_rows(folder / "alone", folder / "killed"),
            "load": os.getloadavg()[1],
            "machine": source["machine"],
            "commit": source["commit"],
        }
    files.write(given.out / f"{NAME}.json", json.dumps(found, indent=2) + "\n")
    text = table(found)
    files.write(given.out / f"{NAME}.md", text)
    print(text)


def table(found: dict) -> str:
    """The measurements as Markdown."""
    lines = [
        ["without Ray", f"{found['alone']:.0f}", ""],
        ["two machines of Ray", f"{found['ray']:.0f}", "yes" if found["same_rows"] else "no"],
        ["the same, simulated", f"{found['simulated']:.0f}", ""],
        ["one machine killed half-way", f"{found['killed']:.0f}", "yes" if found["same_rows_after_kill"] else "no"],
    ]
    head = (
        f"{found['work']}. With Ray it takes {1.0 + found['overhead']:.2f} times as long. Load {found['load']:.1f}.\n\n"
    )
    return head + markdown(["", "seconds", "same rows"], lines)


if __name__ == "__main__":
    main()
