from __future__ import annotations

import math

import pytest
import torch

from romnav.navigation.observations import (
    PATCH,
    PRIVILEGED_SIZE,
    PrivilegedObservation,
    goal_observation,
    rotate,
)
from romnav.world.world import World


def test_goal_observation_by_hand() -> None:
    position = torch.tensor([[1.0, 2.0, 0.0]])
    goal = torch.tensor([[1.0, 5.0, 4.0]])
    out = goal_observation(position, torch.tensor([math.pi / 2]), goal, torch.tensor([math.pi]), 30.0)[0]
    # the robot faces +y: the goal is 3 m ahead, 4 m up, and its heading a quarter turn to the left
    expected = [3.0, 0.0, math.log(5.0) / math.log(30.0), 4.0, 1.0, 0.0]
    assert out.tolist() == pytest.approx(expected, abs=1e-6)


def test_goal_observation_is_finite_at_the_goal() -> None:
    here = torch.zeros(1, 3)
    assert goal_observation(here, torch.zeros(1), here, torch.zeros(1), 30.0).isfinite().all()


def test_goal_observation_ignores_the_tile_frame() -> None:
    """Turning and shifting robot and goal together changes nothing."""
    generator = torch.Generator().manual_seed(0)
    position, goal = torch.randn(2, 50, 3, generator=generator)
    yaw, goal_yaw = torch.randn(2, 50, generator=generator)
    turn, shift = 0.7, torch.tensor([3.0, -2.0, 0.0])

    def moved(p: torch.Tensor) -> torch.Tensor:
        return torch.cat([rotate(p[:, :2], torch.full((50,), -turn)), p[:, 2:]], dim=1) + shift

    before = goal_observation(position, yaw, goal, goal_yaw, 30.0)
    after = goal_observation(moved(position), yaw + turn, moved(goal), goal_yaw + turn, 30.0)
    torch.testing.assert_close(before, after, atol=2e-5, rtol=0)


def test_privileged_patch_is_the_occupancy_around_the_robot(world: World) -> None:
    node = int(world.node_start[1]) + 40
    position = world.position[node : node + 1]
    tile, layer = torch.tensor([1]), world.layer[node : node + 1]
    yaw = torch.tensor([0.4])
    one = torch.ones(1)
    out = PrivilegedObservation(world)(
        tile, layer, position, yaw, 4 * one, torch.tensor([[math.cos(0.4), math.sin(0.4)]]), one, one, one
    )[0]
    assert out.shape == (PRIVILEGED_SIZE,)
    # the path leads straight ahead
    assert out[5:7].tolist() == pytest.approx([1.0, 0.0], abs=1e-6)
    patch = out[7:].view(PATCH, PATCH)
    for i in range(PATCH):
        for j in range(PATCH):
            ahead, left = 0.4 * (i - PATCH // 2), 0.4 * (j - PATCH // 2)
            x = position[0, 0] + ahead * math.cos(0.4) - left * math.sin(0.4)
            y = position[0, 1] + ahead * math.sin(0.4) + left * math.cos(0.4)
            inside = 0 <= x < world.spec.side and 0 <= y < world.spec.side
            free = inside and world.node[1, layer[0], int(x / 0.2), int(y / 0.2)] >= 0
            assert patch[i, j] == (not free)
