"""Lanes: the height map and the geoms are one world, paths are followed by arc length."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from romnav.robot.g1 import build_spec
from romnav.robot.locomotion.terrain import Ground, Slab, curriculum, flat, ramp, rough, stairs, steer, uturn
from romnav.robot.spec import RobotSpec


@pytest.fixture(scope="module")
def ground() -> Ground:
    rng = np.random.default_rng(0)
    return Ground(
        [flat(), rough(0, 0.05, rng), ramp(0, 12.0, 3.0), stairs(0, 0.15, 0.31, 0.27, 6), uturn(0, 0.1, 0.3, 5)]
    )


def test_height_map_is_what_rays_hit(ground: Ground) -> None:
    model = build_spec(RobotSpec(), ground.geoms).compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    rng = np.random.default_rng(1)
    points = rng.uniform([0.0, 0.0], [12.0, 20.0], (3000, 2))
    groups = np.array([1, 0, 0, 0, 0, 0], dtype=np.uint8)
    hit = np.zeros(1, dtype=np.int32)
    truth = np.array(
        [
            5.0 - mujoco.mj_ray(model, data, np.array([*p, 5.0]), np.array([0, 0, -1.0]), groups, 1, -1, hit)
            for p in points
        ]
    )
    error = np.abs(ground.map(torch.tensor(points, dtype=torch.float32), torch.full((3000,), 9.0)).numpy() - truth)
    # A cell is 2 cm: only points in the cells of an edge may differ by more than the slope of a ramp.
    assert np.mean(error > 0.006) < 0.02
    assert truth.max() > 0.9


def test_stairs_rise_by_their_riser_on_every_tread() -> None:
    lane = stairs(0, 0.17, 0.28, 0.28, 20)
    tops = [s.z0 for s in lane.slabs]
    assert max(tops) == pytest.approx(20 * 0.17)
    assert np.abs(np.diff([0.0, *tops, 0.0])) == pytest.approx(0.17)


def test_arc_length_and_projection(ground: Ground) -> None:
    lane = torch.tensor([4, 4, 4])
    arc = torch.tensor([0.5, 4.0, 6.5])
    at = ground.at(lane, arc)
    samples = ground.at(lane[:1].expand(20001), torch.linspace(0, float(ground.length[4]), 20001))
    for i in range(3):
        nearest = (samples - at[i]).norm(dim=1)
        assert nearest.min() < 1e-3
    off = at + torch.tensor([0.02, 0.1])
    best = torch.stack([(samples - p).norm(dim=1).argmin() for p in off]) * float(ground.length[4]) / 20000
    torch.testing.assert_close(ground.project(lane, off, arc + 0.2), best, atol=0.03, rtol=0)


def test_steering_returns_to_the_path_and_rounds_the_corner(ground: Ground) -> None:
    """A unicycle that obeys the command walks the whole U-turn within 30 cm of its centre line."""
    lane, arc = torch.tensor([4]), torch.tensor([0.3])
    at, yaw = ground.at(lane, arc) + torch.tensor([[0.0, 0.2]]), torch.tensor([0.4])
    worst = 0.0
    for k in range(2000):
        arc = ground.project(lane, at, arc)
        command = steer(ground, lane, arc, torch.ones(1), at, yaw, torch.full((1,), 0.5))
        at = at + 0.02 * command[:, 0] * torch.stack([torch.cos(yaw), torch.sin(yaw)], dim=1)
        yaw = yaw + 0.02 * command[:, 2]
        if k > 100:
            worst = max(worst, (at - ground.at(lane, arc)).norm().item())
        if arc > ground.length[4] - 0.1:
            break
    assert arc > ground.length[4] - 0.1
    assert worst < 0.3


def test_curriculum_grows_harder() -> None:
    lanes = curriculum(np.random.default_rng(0))
    top = [max(max(s.z0, s.z1) for s in lane.slabs) for lane in lanes if lane.kind == "stairs"]
    assert top == sorted(top)
    assert all(isinstance(s, Slab) for lane in lanes for s in lane.slabs)
