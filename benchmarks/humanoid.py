"""The humanoid under navigation commands beside its physics alone: the same robots, the same torques, one process.

Ours walks robots on tiles of the world for some seconds by a locomotion policy: commands, reference gait, inverse
kinematics, policy, physics, poses. What the joints are told is written down. The floor is `mujoco.batch` told the same,
in the same models: it ends in the same states to the bit. Beside it, `mujoco.batch` in models that hold every solid of
a tile, as MuJoCo has it by itself. Compared is the CPU time of one thread.
"""

from __future__ import annotations

import cProfile
import pstats
import statistics
import time

import mujoco
import mujoco.batch
import numpy as np
import torch
from _common import ROOT, arguments, markdown, report, take_turns

from romnav.random import integers, uniform
from romnav.robot.g1 import build_spec
from romnav.robot.gaits import GaitLibrary
from romnav.robot.humanoid import Humanoid
from romnav.robot.spec import RobotSpec
from romnav.robot.tiles import geoms
from romnav.world.build import build
from romnav.world.spawns import Start
from romnav.world.spec import WorldSpec

LOCOMOTION = ROOT / "results/cpu/locomotion"
PARTS = {
    "physics": ("step", "mujoco._batch"),
    "surroundings": ("_surround", "g1.py"),
    "reference gait, with": ("update", "walker.py"),
    "inverse kinematics": ("inverse", "legs.py"),
    "observation": ("observe", "control.py"),
    "policy": ("policy", "train.py"),
}
"""Functions whose time is told, by name and a part of their file's."""
_NODE, _HEADING, _COMMAND = range(3)


class Walk:
    """Robots that walk from random places, again and again the same way."""

    def __init__(self, robots: int, steps: int) -> None:
        world = build(WorldSpec(tiles=6, goals_per_tile=2))
        gaits = GaitLibrary.load(LOCOMOTION / "gaits.pt")
        self.body = Humanoid(world, robots, 0.2, LOCOMOTION / "policy.pt", gaits, threads=1)
        self.steps, ids, zero = steps, torch.arange(robots), torch.zeros(robots, dtype=torch.long)
        node = integers(len(world.position), 0, ids, zero, _NODE)
        tile = (torch.searchsorted(world.node_start, node, right=True) - 1).long()
        heading = 2 * torch.pi * uniform(0, ids, zero, _HEADING)
        self.body.reset(
            ids, Start(tile, world.layer[node], world.position[node, :2], heading, zero, torch.zeros(robots))
        )
        draws = torch.stack([uniform(0, ids, zero, _COMMAND, k) for k in range(3)], dim=1)
        self.command = torch.tensor([0.0, -0.25, -1.0]) + draws * torch.tensor([1.0, 0.5, 2.0])
        self.start = self.body.state_dict()
        self.told: list[tuple[np.ndarray, np.ndarray | None]] = []
        self.end = self._record()

    def _record(self) -> np.ndarray:
        batch = self.body.robots.batch
        step = self.body.robots.step

        def recorded(target: torch.Tensor, ids: torch.Tensor | None = None) -> None:
            self.told.append((target.double().numpy().copy(), None if ids is None else ids.numpy().copy()))
            step(target, ids)

        self.body.robots.step = recorded  # type: ignore[method-assign]
        self.ours()
        self.body.robots.step = step  # type: ignore[method-assign]
        return batch.qpos.copy()

    def ours(self) -> None:
        self.body.load_state_dict(self.start)
        for _ in range(self.steps):
            self.body.step(self.command)

    def alone(self) -> None:
        """The physics of `ours`, in the same models."""
        batch = self.body.robots.batch
        self.body.load_state_dict(self.start)
        for target, standing in self.told:
            batch.ctrl[:] = target
            self.body.robots._surround(batch.qpos[:, :3])
            batch.step(ids=standing, nstep=RobotSpec().decimation, stage=mujoco.mjtStage.mjSTAGE_VEL)


class Whole:
    """The physics of a walk with one model for each tile, of all its solids."""

    def __init__(self, walk: Walk) -> None:
        self.walk, state = walk, walk.start
        self.batches = []
        for tile in walk.body.tile.unique().tolist():
            ids = (walk.body.tile == tile).nonzero()[:, 0].numpy()
            model = build_spec(RobotSpec(), geoms(walk.body.world.tiles[tile].solids)).compile()
            batch = mujoco.batch.Batch(model, len(ids), 1, persistent=True)
            for field in ("qpos", "qvel", "ctrl", "qacc_warmstart", "sensordata", "xpos", "xmat"):
                batch.bind(field)
            start = {name: state[f"physics.{name}"].numpy()[ids] for name in ("qpos", "qvel", "qacc_warmstart")}
            self.batches.append((batch, ids, start))

    def __call__(self) -> None:
        for batch, ids, start in self.batches:
            for name, value in start.items():
                getattr(batch, name)[:] = value
            batch.forward(stage=mujoco.mjtStage.mjSTAGE_VEL)
            for target, _ in self.walk.told:
                batch.ctrl[:] = target[ids]
                batch.step(nstep=RobotSpec().decimation, stage=mujoco.mjtStage.mjSTAGE_VEL)


def shares(walk: Walk) -> dict[str, float]:
    """Part of the time of `ours` in each of `PARTS`, and elsewhere."""
    profile = cProfile.Profile(time.process_time)
    profile.runcall(walk.ours)
    rows = pstats.Stats(profile).stats  # type: ignore[attr-defined]
    total = sum(row[2] for row in rows.values())
    found = {
        name: sum(row[3] for (file, _, function), row in rows.items() if where in file + function and what in function)
        for name, (what, where) in PARTS.items()
    }
    rest = total - sum(seconds for name, seconds in found.items() if name != "inverse kinematics")
    return {name: seconds / total for name, seconds in (found | {"everything else": rest}).items()}


def main() -> None:
    """Measure, print and write ``results/bench/humanoid.json``."""
    options = arguments(__doc__, robots=128, steps=10, repeats=5)
    torch.set_num_threads(1)
    walk = Walk(options.robots, options.steps)
    walk.alone()
    agree = bool(np.array_equal(walk.body.robots.batch.qpos, walk.end))
    works = {"ours": walk.ours, "mujoco.batch alone": walk.alone, "mujoco.batch alone, whole tiles": Whole(walk)}
    times = {
        name: [seconds / options.steps for seconds in turns]
        for name, turns in take_turns(works, options.repeats, time.process_time).items()
    }
    ours = times.pop("ours")
    part = shares(walk)
    report(
        "humanoid",
        f"A step of navigation, 0.2 s, of {options.robots} robots on tiles of 40 m, CPU time of one thread",
        "s",
        ours,
        times,
        options.out,
        agree=agree,
        nav_steps_per_cpu_second=options.robots / statistics.median(ours),
        shares={name: round(share, 3) for name, share in part.items()},
    )
    print(markdown(["part", "share"], [[name, f"{100 * share:.0f} %"] for name, share in part.items()]))
    if not agree:
        raise SystemExit("the physics alone ends elsewhere")


if __name__ == "__main__":
    main()
