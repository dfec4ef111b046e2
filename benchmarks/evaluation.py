"""Evaluation of a committed arm: the paired episodes of up to 120 s, once under each backend of the LiDAR.

The policy is `ARM` of the "cpu" scale, as ``romnav eval`` drives it. The mesh backend casts rays at the triangles of
the same solids, so the paired difference of success tells whether the columns change what a policy reaches.
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace

import numpy as np
from _common import ROOT, arguments, report
from numpy.typing import NDArray

from romnav.evaluation import episodes
from romnav.evaluation.paired.run import run
from romnav.evaluation.rollout import Policy
from romnav.experiment.kinds._driven import Driven
from romnav.experiment.kinds.episodes import paired_set
from romnav.experiment.project import Project
from romnav.experiment.workspace import Workspace
from romnav.sensing.lidar import Lidar

ARM = "rom"
LIMIT = 120.0
"""Longest time that all episodes may take, s."""
RESAMPLES = 10_000


def paired(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> tuple[float, float]:
    """95 % interval of the difference of success, percent, over paired resamples of the episodes."""
    rng = np.random.default_rng(0)
    difference = 100.0 * (a.astype(float) - b)
    picked = rng.integers(len(a), size=(RESAMPLES, len(a)))
    low, high = np.percentile(difference[picked].mean(axis=1), [2.5, 97.5])
    return float(low), float(high)


def main() -> None:
    """Measure, print and write ``results/bench/evaluation.json``."""
    options = arguments(__doc__, episodes=1024)
    work = Workspace(Project(ROOT, ROOT / "results"), "cpu")
    driven, path = Driven.by(work, ARM, 0), paired_set(work)
    whole = episodes.load(path)
    walked = replace(whole, columns={name: column[: options.episodes] for name, column in whole.columns.items()})
    world = episodes.terrain(whole, path, work.project.worlds)
    times, success = {}, {}
    for backend in ("columns", "mesh"):
        policy = driven.driver(world, "cpu")
        assert isinstance(policy, Policy)
        spec = driven.settings.lidar.model_copy(update={"backend": backend})
        policy.perception.lidar.sensor = Lidar([tile.solids for tile in world.tiles], spec)
        start = time.perf_counter()
        measured = run(policy, world, walked, driven.settings.navigation.env, work.settings.evaluation)
        times[backend] = time.perf_counter() - start
        success[backend] = measured["outcome"] == "success"
        print(f"{backend}: {times[backend]:.0f} s, success {success[backend].mean():.1%}", flush=True)
    low, high = paired(success["columns"], success["mesh"])
    agree = low <= 0.0 <= high
    print(f"success, columns minus mesh: 95 % interval [{low:+.2f}, {high:+.2f}] %")
    report(
        "evaluation",
        f"{len(walked)} episodes of up to {work.settings.evaluation.duration:.0f} s, {ARM} of the cpu scale",
        "s",
        [times["columns"]],
        {"romnav with the mesh LiDAR": [times["mesh"]]},
        options.out,
        agree=agree,
        limit=LIMIT,
        success={backend: float(reached.mean()) for backend, reached in success.items()},
        success_difference_percent=(low, high),
    )
    if not agree or times["columns"] > LIMIT:
        sys.exit("slower than two minutes, or the LiDAR's backends give different success")


if __name__ == "__main__":
    main()
