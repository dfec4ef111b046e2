"""A strip of frames for each terrain of the test, so that a person sees the policy walk."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import mujoco
import numpy as np
import pandas as pd
import torch

from romnav.errors import RomnavError
from romnav.robot.g1 import Humanoids
from romnav.robot.locomotion.control import Controller, has_fallen
from romnav.robot.locomotion.evaluate import Row, rows
from romnav.robot.locomotion.planar import heading_of
from romnav.robot.locomotion.terrain import Ground, steer
from romnav.robot.locomotion.train import load_policy

matplotlib.use("Agg")
import matplotlib.pyplot as plt

CHAINS = (
    ("left_ankle_roll_link", "left_ankle_pitch_link", "left_knee_link", "left_hip_yaw_link", "pelvis"),
    ("right_ankle_roll_link", "right_ankle_pitch_link", "right_knee_link", "right_hip_yaw_link", "pelvis"),
    ("pelvis", "torso_link", "left_shoulder_roll_link", "left_elbow_link", "left_wrist_yaw_link"),
    ("torso_link", "right_shoulder_roll_link", "right_elbow_link", "right_wrist_yaw_link"),
)
"""Bodies joined by the lines of the stick figure."""


def strip(checkpoint: Path, out: Path, *, seconds: float = 8.0, frames: int = 9, threads: int = 0) -> list[Path]:
    """Write `out/locomotion-<terrain>.png` for each terrain: side views at equal times, deterministic policy.

    Args:
        checkpoint: written by `train`.
        out: directory.
        seconds: how long to walk; a fall ends the strip.
        frames: of each strip.
        threads: of the physics.
    """
    out.mkdir(parents=True, exist_ok=True)
    return [_strip(row, checkpoint, out, seconds, frames, threads) for row in rows()]


def curve(table: Path, path: Path) -> Path:
    """Draw the levels and the shares of episodes ended by a fall, by kind of terrain, over the steps of a training.

    Args:
        table: curve.csv, written by `train`.
        path: PNG to write.

    Raises:
        RomnavError: There is no curve, or a damaged one.
    """
    if not table.exists():
        raise RomnavError(f"{table}: no training curve; train with `romnav train locomotion`")
    try:
        rows = pd.read_csv(table).astype(float)
    except (OSError, ValueError) as error:
        raise RomnavError(f"{table}: damaged, or no training curve ({error}); restore it") from error
    # Some hundred points: single iterations end only a few episodes of a kind.
    rows = rows.groupby(np.arange(len(rows)) // max(1, len(rows) // 120)).mean()
    figure, (levels, falls) = plt.subplots(1, 2, figsize=(11, 3.6))
    for kind in [name.removeprefix("level/") for name in rows.columns if name.startswith("level/")]:
        steps = rows["steps"] / 1e6
        if kind != "flat":
            levels.plot(steps, rows[f"level/{kind}"], label=kind)
        falls.plot(steps, rows[f"fallen/{kind}"] / rows[f"ended/{kind}"].clip(lower=1e-9), label=kind)
    levels.set_ylabel("mean level")
    falls.set_ylabel("share of episodes that end in a fall")
    for axis in (levels, falls):
        axis.set_xlabel("million policy steps")
        axis.legend(fontsize=8)
        axis.grid(alpha=0.3)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100, bbox_inches="tight")
    plt.close(figure)
    return path


def _strip(row: Row, checkpoint: Path, out: Path, seconds: float, frames: int, threads: int) -> Path:
    spec, policy, iteration = load_policy(checkpoint)
    ground = Ground([row.lanes[-1]])
    robots = Humanoids(spec.robot, [ground.geoms], 1, threads=threads)
    control = Controller(spec, robots)
    one, lane = torch.zeros(1, dtype=torch.long), torch.zeros(1, dtype=torch.long)
    arc, speed = ground.spawn[:1, 0].clone(), torch.full((1,), 0.5)
    at = ground.at(lane, arc)
    command = torch.tensor([[0.5, 0.0, 0.0]])
    control.stand(one, torch.cat([at, torch.zeros(1, 1)], dim=1), torch.zeros(1), torch.zeros_like(one), command)
    ticks = round(seconds / control.dt)
    shown = np.linspace(0, ticks - 1, frames).astype(int)
    poses = []
    fell = False
    for tick in range(ticks):
        xy = robots.pelvis[:, :2]
        if row.terrain != "flat":
            arc = ground.project(lane, xy, arc)
            command = steer(ground, lane, arc, torch.ones(1), xy, heading_of(robots.orientation), speed)
        control.refer(command, ground.map, torch.full((1,), tick == 0))
        control.act(policy(control.observe(command, ground.map)))
        fell = fell or bool(has_fallen(robots))
        if tick in shown or fell:
            data = robots.batch.get_data(0)
            mujoco.mj_kinematics(robots.model, data)
            poses.append((tick * control.dt, {name: data.body(name).xpos.copy() for c in CHAINS for name in c}))
        if fell:
            break

    figure, axis = plt.subplots(figsize=(12, 4))
    low = min(p["pelvis"][0] for _, p in poses) - 0.6
    high = max(p["pelvis"][0] for _, p in poses) + 0.6
    x = torch.arange(low, high, 0.01)
    line = torch.stack([x, torch.full_like(x, float(at[0, 1]))], dim=1)
    height = ground.map(line, torch.full_like(x, 99.0)).numpy()
    axis.fill_between(x.numpy(), height, height.min() - 0.1, color="0.85", step="mid")
    for time, pose in poses:
        for chain, colour in zip(CHAINS, ("C0", "C3", "0.3", "0.6"), strict=True):
            points = np.array([pose[name] for name in chain])
            axis.plot(points[:, 0], points[:, 2], color=colour, linewidth=1.5)
        axis.annotate(f"{time:.1f} s", (pose["pelvis"][0], pose["pelvis"][2] + 0.75), ha="center", fontsize=7)
    axis.set_aspect("equal")
    axis.set_title(f"{row.terrain}, iteration {iteration}, 0.5 m/s" + (": fell" if fell else ""))
    axis.set_xlabel("x, m")
    path = out / f"locomotion-{row.terrain}.png"
    figure.savefig(path, dpi=100, bbox_inches="tight")
    plt.close(figure)
    return path
