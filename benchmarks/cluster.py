"""How long the stages of the ablations take on more machines: a simulation of the graph of stages, no machine is used.

Each stage takes the time that its steps take at a measured rate, times a random factor; a machine fails now and then,
and the stage goes on elsewhere from its last checkpoint. Stages start as soon as those that they need are done and a
core is free, longest way to the end first (list scheduling, Graham 1969).
"""

from __future__ import annotations

import argparse
import heapq
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from _common import ROOT

from romnav import files
from romnav.experiment.graph import records
from romnav.experiment.graph.run import with_all_above
from romnav.experiment.graph.stage import Stage
from romnav.experiment.kinds import reports
from romnav.experiment.project import Project
from romnav.experiment.workspace import Workspace

CHECKPOINT = 120.0
"""Seconds between two checkpoints: at most that much is lost with a machine."""
FIXED = {"encoder": 800.0, "quality": 20.0, "locomotion": 3.7 * 3600, "gaits": 45.0, "episodes": 120.0}
"""Seconds of the stages that do not train a policy (records of results/cpu; locomotion is trained once)."""


@dataclass(frozen=True)
class Rates:
    """Measured nav-steps/s of one core, learning included, by body."""

    rom: float
    g1: float


def seconds(stage: Stage, rates: Rates) -> float:
    """Time of a stage alone on a core."""
    if stage.kind != "policy":
        return FIXED.get(stage.kind, 5.0)
    spec = stage.settings.navigation  # type: ignore[attr-defined]
    steps = spec.env.envs * spec.ppo.steps * spec.ppo.iterations * spec.ppo.stages
    return steps / (rates.rom if spec.dynamics == "rom" else rates.g1)


def simulate(
    stages: Sequence[Stage], lasts: Mapping[str, float], cores: int, spread: float, mtbf: float, seed: int
) -> tuple[float, float]:
    """Makespan and work of one run, s.

    Args:
        stages: Upstream ones first.
        lasts: Time of each stage alone, s.
        cores: Of the cluster; a stage takes one.
        spread: Standard deviation of the logarithm of the factor by which a stage takes longer.
        mtbf: Mean time between two failures of a core's machine, s.
        seed: Of factors and failures.
    """
    rng = np.random.default_rng(seed)
    names = {stage.name for stage in stages}
    above = {stage.name: {other.name for other in stage.upstream} & names for stage in stages}
    below: dict[str, list[str]] = {name: [] for name in names}
    for name, others in above.items():
        for other in others:
            below[other].append(name)
    takes, tail = {}, {}
    for stage in stages:
        work = lasts[stage.name] * float(np.exp(spread * rng.standard_normal()))
        failures = rng.poisson(work / mtbf)
        takes[stage.name] = work + float(rng.uniform(0.0, CHECKPOINT, failures).sum())
    for stage in reversed(stages):
        tail[stage.name] = takes[stage.name] + max((tail[name] for name in below[stage.name]), default=0.0)
    ready = [(-tail[name], name) for name in names if not above[name]]
    heapq.heapify(ready)
    running: list[tuple[float, str]] = []
    now, free = 0.0, cores
    while ready or running:
        while ready and free:
            _, name = heapq.heappop(ready)
            heapq.heappush(running, (now + takes[name], name))
            free -= 1
        now, done = heapq.heappop(running)
        free += 1
        for name in below[done]:
            above[name].discard(done)
            if not above[name]:
                heapq.heappush(ready, (-tail[name], name))
    return now, sum(takes.values())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("experiments", nargs="*", default=["spawn-goal", "pretrain", "kickstart", "careful"])
    parser.add_argument("--scale", default="cpu")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--cores", type=int, nargs="+", default=[2, 8, 64, 1000])
    parser.add_argument(
        "--rom", type=float, default=7800.0, help="nav-steps/s of a core, or GPU, on the reduced-order model"
    )
    parser.add_argument("--g1", type=float, default=500.0, help="the same on the humanoid")
    parser.add_argument("--spread", type=float, default=0.1)
    parser.add_argument("--mtbf-hours", type=float, default=500.0)
    parser.add_argument("--unit", default="core", choices=["core", "GPU"])
    parser.add_argument("--name", default="cluster", help="of the file")
    parser.add_argument("--out", type=Path, default=ROOT / "results/bench")
    given = parser.parse_args()

    work = Workspace(Project(ROOT, ROOT / "results"), given.scale)
    wanted = [stage for name in given.experiments for stage in reports(work, name, range(given.seeds))]
    stages = with_all_above(wanted)
    order = {stage.name: stage for stage in stages}
    stages = upstream_first(list(order.values()))
    lasts = {stage.name: seconds(stage, Rates(given.rom, given.g1)) for stage in stages}
    lines = [
        f"Simulated: {', '.join(given.experiments)} at scale {given.scale}, {given.seeds} seeds, {len(stages)} stages. "
        f"A {given.unit} does {given.rom:g} nav-steps/s on the reduced-order model and {given.g1:g} on the humanoid. "
        "Hours, mean and range of 50 runs.",
        "",
        f"| {given.unit}s | hours | range | {given.unit}s at work |",
        "| --- | --- | --- | --- |",
    ]
    for cores in given.cores:
        runs = [simulate(stages, lasts, cores, given.spread, given.mtbf_hours * 3600, seed) for seed in range(50)]
        hours = np.array([makespan for makespan, _ in runs]) / 3600
        busy = np.mean([total / (makespan * cores) for makespan, total in runs])
        lines.append(f"| {cores} | {hours.mean():.1f} | {hours.min():.1f} to {hours.max():.1f} | {busy:.0%} |")
    text = "\n".join(lines) + f"\n\nCommit {records.commit()[:12]}.\n"
    files.write(given.out / f"{given.name}.md", text)
    print(text)


def upstream_first(stages: Sequence[Stage]) -> list[Stage]:
    """The stages in an order in which they can be made."""
    known = {stage.name: stage for stage in stages}
    ordered: dict[str, Stage] = {}

    def visit(stage: Stage) -> None:
        if stage.name not in ordered:
            for above in stage.upstream:
                if above.name in known:
                    visit(known[above.name])
            ordered[stage.name] = stage

    for stage in stages:
        visit(stage)
    return list(ordered.values())


if __name__ == "__main__":
    main()
