"""Evaluation of one arm: 1,024 paired episodes of up to 120 s at the "cpu" scale.

By default the policy has random weights. It reaches next to no goal, so that almost every episode runs to its end:
no arm takes longer. With ``--policy`` and ``--encoder``, files of a trained arm, that policy
drives, once under each backend of the LiDAR, and the paired difference of their success is reported beside the times.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
import torch
from _common import CORES, ROOT, report
from _learner import CACHE, ours, scale, sensors
from numpy.typing import NDArray

from romnav.evaluation import episodes
from romnav.evaluation.paired.run import run
from romnav.evaluation.rollout import Policy
from romnav.evaluation.spec import EpisodeSetSpec
from romnav.experiment.scales import Scale
from romnav.navigation import checkpoint
from romnav.sensing import encoder as encoders
from romnav.sensing.lidar import Lidar
from romnav.world.build import build
from romnav.world.world import World

RESAMPLES = 10_000


def driver(s: Scale, world: World, backend: str, options: argparse.Namespace) -> Policy:
    """The policy to evaluate, seeing through ``backend``."""
    perception = sensors(s, world)
    if options.encoder:
        perception.lidar.encoder = encoders.load(options.encoder)
    spec = s.lidar.model_copy(update={"backend": backend})
    perception.lidar.sensor = Lidar([tile.solids for tile in world.tiles], spec)
    if not options.policy:
        return Policy(ours(s, world).algorithm.actor, perception)
    return Policy(checkpoint.load_actor(options.policy, perception.encoder), perception)


def paired(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> tuple[float, float]:
    """95 % interval of the difference of success, percent, over paired resamples of the episodes."""
    rng = np.random.default_rng(0)
    difference = 100.0 * (a.astype(float) - b)
    picked = rng.integers(len(a), size=(RESAMPLES, len(a)))
    low, high = np.percentile(difference[picked].mean(axis=1), [2.5, 97.5])
    return float(low), float(high)


def main() -> None:
    """Measure, print and write ``results/bench/evaluation.json``."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=int, default=EpisodeSetSpec().episodes)
    parser.add_argument("--policy", type=Path, help="policy.pt of a trained arm")
    parser.add_argument("--encoder", type=Path, help="encoder.pt it was trained with")
    parser.add_argument("--out", type=Path, default=ROOT / "results/bench")
    options = parser.parse_args()
    torch.set_num_threads(CORES)
    s = scale()
    spec = EpisodeSetSpec(episodes=options.episodes)
    world = build(spec.world, CACHE)
    drawn = episodes.draw("bench", spec, world)
    times, success = {}, {}
    for backend in ("columns", "mesh") if options.policy else ("columns",):
        policy = driver(s, world, backend, options)
        start = time.perf_counter()
        measured = run(policy, world, drawn, s.navigation.env, s.evaluation)
        times[backend] = [time.perf_counter() - start]
        success[backend] = measured["outcome"] == "success"
    own = times.pop("columns")
    more = {"limit": 120.0, "success": {k: float(v.mean()) for k, v in success.items()}}
    agree = True
    if options.policy:
        low, high = more["success_difference_percent"] = paired(success["columns"], success["mesh"])
        agree = low <= 0.0 <= high
        print(f"success, columns minus mesh: 95 % interval [{low:+.2f}, {high:+.2f}] %")
    kind = "a trained" if options.policy else "an untrained"
    work = f"{options.episodes} episodes of up to {s.evaluation.duration:.0f} s, {kind} policy"
    peers = {f"romnav with the {k} LiDAR": v for k, v in times.items()}
    report("evaluation", work, "s", own, peers, options.out, agree=agree, **more)
    if not agree or own[0] > more["limit"]:
        raise SystemExit("slower than two minutes, or the LiDAR's backends give different success")


if __name__ == "__main__":
    main()
