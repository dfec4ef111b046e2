"""MuJoCo Warp against native MuJoCo: the same robots walk the same way."""

from __future__ import annotations

import numpy as np
import pytest
import torch

pytest.importorskip("mujoco_warp", reason="MuJoCo Warp comes with the extra: pip install romnav[cuda]")

from romnav.robot.g1 import Humanoids, Robots
from romnav.robot.locomotion.task import Controller
from romnav.robot.locomotion.terrain import Ground, flat, stairs
from romnav.robot.spec import LocomotionSpec
from romnav.robot.warp import WarpHumanoids

SPEC = LocomotionSpec()
GROUND = Ground([flat(), stairs(0, 0.1, 0.3, 0.3, 3)])


def walk(robots: Robots, ticks: int) -> dict[str, np.ndarray]:
    """Two robots walk by the reference gait, on the flat and towards a stair; the third is held after a while."""
    control = Controller(SPEC, robots)
    ids = torch.arange(3)
    lane = torch.tensor([0, 1, 0])
    at = GROUND.at(lane, torch.tensor([0.0, 1.0, 0.5]))
    command = torch.tensor([[0.3, 0.0, 0.2]]).expand(3, -1)
    control.stand(ids, torch.cat([at, torch.zeros(3, 1)], dim=1), torch.zeros(3), torch.tensor([0, 20, 0]), command)
    track: dict[str, list] = {name: [] for name in ("pelvis", "joints", "com_velocity", "ankle", "touch", "anchor")}
    for k in range(ticks):
        control.refer(command, GROUND.map, torch.full((3,), k == 0))
        control.act(torch.zeros(3, 15), ids[:2] if k >= 5 else None)
        for name, values in track.items():
            values.append(getattr(robots, name).numpy().copy())
    return {name: np.stack(values) for name, values in track.items()}


@pytest.mark.slow
def test_both_engines_walk_alike() -> None:
    """Engines differ in precision and solver; chaos makes that visible after about a second, so half of one."""
    ticks = 25
    native = walk(Humanoids(SPEC.robot, GROUND.boxes, 3, threads=1), ticks)
    warp = walk(WarpHumanoids(SPEC.robot, GROUND.boxes, 3, device="cpu"), ticks)
    moved = np.abs(native["pelvis"][-1] - native["pelvis"][0]).max()
    assert moved > 0.05
    for name, tolerance in {
        "pelvis": 2e-3,
        "ankle": 5e-3,
        "anchor": 5e-3,
        "joints": 2e-2,
        "com_velocity": 3e-2,
    }.items():
        assert np.abs(native[name] - warp[name]).max() < tolerance, name
    assert (native["touch"] == warp["touch"]).mean() > 0.98
    assert native["touch"].any()
    held = native["pelvis"][5:, 2]
    assert np.array_equal(held, np.broadcast_to(held[0], held.shape))
    held = warp["pelvis"][5:, 2]
    assert np.array_equal(held, np.broadcast_to(held[0], held.shape))
