"""MuJoCo Warp against native MuJoCo: the same robots walk the same way."""

from __future__ import annotations

import numpy as np
import pytest
import torch

pytest.importorskip("mujoco_warp", reason="MuJoCo Warp comes with the extra: pip install romnav[cuda]")

from romnav.robot.g1 import Humanoids, Robots
from romnav.robot.locomotion.control import Controller
from romnav.robot.locomotion.terrain import Ground, flat, stairs
from romnav.robot.spec import LocomotionSpec
from romnav.robot.statics import Geoms
from romnav.robot.tiles import geoms
from romnav.robot.warp import WarpHumanoids
from romnav.world.solids import SolidsBuilder

SPEC = LocomotionSpec()


def grounds() -> list[Geoms]:
    """A platform, a ramp and, on the floor, a pillar at the robot's chest, all where robots start at (1, 1)."""
    builders = [SolidsBuilder() for _ in range(3)]
    builders[0].box((1.0, 1.0), (2.0, 2.0), (0.0, 0.4), layers=(0, 0))
    builders[1].box((1.0, 1.0), (2.0, 2.0), (0.0, 0.2), slope=0.1, layers=(0, 0))
    builders[2].cylinder((1.24, 1.0), 0.15, (0.5, 2.0))
    return [geoms(builder.build()) for builder in builders]


HEIGHTS = torch.tensor([0.4, 0.2, 0.0])

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
    native = walk(Humanoids(SPEC.robot, [GROUND.geoms], 3, threads=1), ticks)
    warp = walk(WarpHumanoids(SPEC.robot, [GROUND.geoms], 3, device="cpu"), ticks)
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


@pytest.mark.slow
def test_every_robot_is_on_a_ground_of_its_own() -> None:
    """Which change places on the way: what held them up, or was in the way, is then under another's feet."""
    pose = torch.zeros(3, 22)
    pose[:, :2], pose[:, 2], pose[:, 3] = 1.0, HEIGHTS + 0.795, 1.0
    found = []
    for robots in (
        Humanoids(SPEC.robot, grounds(), 3, threads=1),
        WarpHumanoids(SPEC.robot, grounds(), 3, device="cpu"),
    ):
        for ground in (torch.arange(3), torch.tensor([2, 0, 1])):
            robots.stand_on(ground)
            pose[:, 2] = HEIGHTS[ground] + 0.795
            robots.set_state(torch.arange(3), pose, torch.zeros(3, 21))
            touched = torch.zeros_like(robots.touch)
            for _ in range(5):
                robots.step(torch.zeros(3, 15))
                touched |= robots.touch  # the pillar pushes it away
            found.append((robots.pelvis.clone(), touched))
            torch.testing.assert_close(robots.pelvis[:, 2], pose[:, 2], atol=0.03, rtol=0)
            assert robots.touch[:, robots.feet].all()
            assert ((touched.sum(1) > 2) == (ground == 2)).all(), "the pillar touches one"
    for (at, touch), (same, touching) in zip(found[:2], found[2:], strict=True):
        torch.testing.assert_close(at, same, atol=3e-3, rtol=0)
        assert torch.equal(touch, touching)
