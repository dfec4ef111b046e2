"""Leg kinematics against MuJoCo's."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from romnav.robot.g1 import SIDES, Humanoids
from romnav.robot.locomotion.legs import STRAIGHT, Legs, rotation
from romnav.robot.spec import RobotSpec
from romnav.robot.statics import NOTHING

REST = torch.tensor([-0.3, 0.0, 0.0, 0.6, -0.3, 0.0])
BENT = torch.tensor([-0.45, 0.0, 0.0, 0.9, -0.45, 0.0])


@pytest.fixture(scope="module")
def robots() -> Humanoids:
    return Humanoids(RobotSpec(), [NOTHING], 4, threads=1)


@pytest.fixture(scope="module")
def legs(robots: Humanoids) -> Legs:
    return Legs(robots.model)


def test_forward_is_mujoco_s(robots: Humanoids, legs: Legs) -> None:
    joints = REST + 0.3 * torch.randn(4, 2, 6, generator=torch.Generator().manual_seed(0))
    qpos = torch.zeros(4, 22)
    qpos[:, 2], qpos[:, 3], qpos[:, 7:19] = 2.0, 1.0, joints.flatten(1)
    robots.set_state(torch.arange(4), qpos, torch.zeros(4, 21))
    position, turn, _ = legs.forward(joints)
    torch.testing.assert_close(position + robots.pelvis[:, None], robots.ankle, atol=1e-6, rtol=0)
    torch.testing.assert_close(turn, robots.ankle_rotation, atol=1e-6, rtol=0)


def test_jacobian_is_the_derivative(legs: Legs) -> None:
    joints = REST + 0.2 * torch.randn(1, 2, 6, generator=torch.Generator().manual_seed(1))
    _, turn, jacobian = legs.forward(joints)
    for k in range(6):
        step = torch.zeros(6)
        step[k] = 1e-3
        (p1, r1, _), (p0, r0, _) = legs.forward(joints + step), legs.forward(joints - step)
        spin = (r1 - r0) / 2e-3 @ turn.transpose(-1, -2)
        omega = torch.stack([spin[..., 2, 1], spin[..., 0, 2], spin[..., 1, 0]], dim=-1)
        torch.testing.assert_close(jacobian[..., :3, k], (p1 - p0) / 2e-3, atol=2e-3, rtol=0)
        torch.testing.assert_close(jacobian[..., 3:, k], omega, atol=2e-3, rtol=0)


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(-0.25, 0.25), min_size=12, max_size=12))
def test_inverse_finds_the_pose(legs: Legs, offsets: list[float]) -> None:
    wanted = BENT + torch.tensor(offsets).reshape(1, 2, 6)
    position, turn, _ = legs.forward(wanted.clamp(legs.limits[..., 0], legs.limits[..., 1]))
    found = legs.inverse(position, turn, REST.expand(1, 2, 6), iterations=15)
    at, as_turned, _ = legs.forward(found)
    assert (at - position).abs().max() < 2e-3
    assert (as_turned - turn).abs().max() < 1e-2


@pytest.mark.parametrize("iterations", [1, 2, 6])
def test_the_kernel_takes_the_steps_of_gauss_newton(robots: Humanoids, legs: Legs, iterations: int) -> None:
    """Against the same by tensor operations; some poses beyond reach, some joints at their limits."""
    generator = torch.Generator().manual_seed(0)
    start, goal = (BENT + 0.3 * torch.randn(2, 50, 2, 6, generator=generator)).clamp(*legs.limits.unbind(-1))
    position, turn, _ = legs.forward(goal)
    position[:10] *= 1.3
    bodies = [robots.model.body(f"{side}_hip_pitch_link") for side in SIDES]
    hip = torch.tensor(np.array([body.pos for body in bodies]), dtype=torch.float32)
    longest = (legs.forward(torch.tensor([0.0, 0.0, 0.0, STRAIGHT, 0.0, 0.0]).expand(1, 2, 6))[0] - hip).norm(dim=-1)
    way = position - hip
    near = hip + way * (longest / way.norm(dim=-1)).clamp(max=1.0)[..., None]
    expected = start
    for _ in range(iterations):
        at, turned, jacobian = legs.forward(expected)
        twist = 0.5 * torch.linalg.cross(turned, turn, dim=-2).sum(-1)
        error = torch.cat([near - at, twist], dim=-1)[..., None]
        square = jacobian.mT @ jacobian + 2e-4 * torch.eye(6)
        step = torch.linalg.solve(square, jacobian.mT @ error)[..., 0]
        expected = (expected + step.clamp(-0.5, 0.5)).clamp(*legs.limits.unbind(-1))
    torch.testing.assert_close(legs.inverse(position, turn, start, iterations=iterations), expected, atol=1e-3, rtol=0)


def test_what_cannot_be_reached_is_approached_within_the_limits(legs: Legs) -> None:
    position = torch.tensor([[[0.0, 0.1, -0.85], [0.0, -0.1, -0.85]]])
    joints = legs.inverse(position, torch.eye(3).expand(1, 2, 3, 3), REST.expand(1, 2, 6), iterations=30)
    assert ((joints >= legs.limits[..., 0]) & (joints <= legs.limits[..., 1])).all()
    assert legs.forward(joints)[0][0, :, 2].max() < -0.72


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_rotation_is_right_handed(axis: int) -> None:
    unit = torch.eye(3)
    turned = rotation(axis, torch.tensor(np.pi / 2, dtype=torch.float32)) @ unit[(axis + 1) % 3]
    torch.testing.assert_close(turned, unit[(axis + 2) % 3], atol=1e-6, rtol=0)
