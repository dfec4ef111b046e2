from __future__ import annotations

import math

import pytest
import torch

from romnav.navigation.observations import (
    PATCH,
    PRIVILEGED_SIZE,
    STATE_SIZE,
    PrivilegedObservation,
    goal_observation,
    observe,
    privileged_way,
    rotate,
)
from romnav.navigation.perception import Eye, Perception
from romnav.robot.dynamics import Head
from romnav.robot.rom import ReducedOrderModel
from romnav.sensing.corruption import Corruption
from romnav.sensing.encoder import untrained
from romnav.sensing.lidar import Lidar
from romnav.sensing.spec import CorruptionSpec, EncoderSpec, LidarSpec
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
        tile, layer, position, yaw, 4 * one, one, torch.tensor([[math.cos(0.4), math.sin(0.4)]]), one, one, one
    )[0]
    assert out.shape == (PRIVILEGED_SIZE,)
    assert out[5].item() == pytest.approx(0.1)  # 3 m further than it has been
    # the path leads straight ahead
    direction, log_geodesic = privileged_way(torch.cat([torch.zeros(9), out]))
    assert direction.tolist() == pytest.approx([1.0, 0.0], abs=1e-6)
    assert log_geodesic.item() == pytest.approx(math.log(4.0))
    patch = out[8:].view(PATCH, PATCH)
    for i in range(PATCH):
        for j in range(PATCH):
            ahead, left = 0.4 * (i - PATCH // 2), 0.4 * (j - PATCH // 2)
            x = position[0, 0] + ahead * math.cos(0.4) - left * math.sin(0.4)
            y = position[0, 1] + ahead * math.sin(0.4) + left * math.cos(0.4)
            inside = 0 <= x < world.spec.side and 0 <= y < world.spec.side
            free = inside and world.node[1, layer[0], int(x / 0.2), int(y / 0.2)] >= 0
            assert patch[i, j] == (not free)


class Swaying(ReducedOrderModel):
    """A reduced-order model that feels its motion and carries its head as told."""

    def __init__(self, world: World, envs: int) -> None:
        super().__init__(world, envs, 0.2)
        self.felt = torch.rand(envs, 8)
        self.head: Head | None = None

    @property
    def proprioception(self) -> torch.Tensor:
        return self.felt


def eye(world: World, arms: object = None) -> Eye:
    """A LiDAR without noise."""
    lidar = Lidar([tile.solids for tile in world.tiles], LidarSpec(rows=15, columns=55))
    clean = Corruption(CorruptionSpec(noise=(0.0, 0.0, 0.0), dropout=(0.0, 0.0), occlusion=()), 0)
    return Eye(lidar, clean, untrained(EncoderSpec(), lidar.directions, 0).encoder.requires_grad_(False), arms)


def placed(world: World, envs: int) -> Swaying:
    robots, node = Swaying(world, envs), world.spawn[:envs]
    robots.tile = (torch.searchsorted(world.node_start, node, right=True) - 1).long()
    robots.layer, robots.position = world.layer[node], world.position[node]
    robots.yaw = torch.linspace(-3, 3, envs)
    return robots


def test_the_humanoids_observation_begins_with_the_reduced_order_models(world: World) -> None:
    humanoid, rom = placed(world, 5), ReducedOrderModel(world, 5, 0.2)
    rom.load_state_dict(humanoid.state_dict())
    perception = Perception(eye(world))
    rest = torch.rand(5, 3), torch.rand(5), torch.rand(5, 3), torch.zeros(5, 2), perception, 30.0
    full, part = observe(humanoid, *rest), observe(rom, *rest)
    assert torch.equal(full["state"][:, :STATE_SIZE], part["state"])
    assert torch.equal(full["state"][:, STATE_SIZE:], humanoid.felt)
    assert torch.equal(full["lidar"], part["lidar"])


def test_the_eye_looks_from_where_the_head_is(world: World) -> None:
    robots, look = placed(world, 6), eye(world)
    standing = look.ranges(robots, torch.zeros(6, 2))
    mount = torch.tensor([0.0, 0.0, look.sensor.spec.height])
    robots.head = Head(robots.position + mount, robots.yaw, torch.zeros(6, 2))
    assert torch.equal(look.ranges(robots, torch.zeros(6, 2)), standing)
    sway, lean = torch.tensor([0.0, 0.05, 0.04]), torch.tensor([[0.05, 0.1]]).expand(6, 2)
    robots.head = Head(robots.position + mount + sway, robots.yaw + 0.1, lean)
    moved = look.ranges(robots, torch.zeros(6, 2))
    # the same from a robot that stands where the head has moved to, turned likewise, but for the pixels of its field
    other = placed(world, 6)
    other.position, other.yaw = other.position + sway, other.yaw + 0.1
    upright = look.ranges(other, torch.zeros(6, 2))
    both = (moved > 0) & (upright > 0)
    assert both.float().mean() > 0.5
    torch.testing.assert_close(moved[both], upright[both])
    assert not torch.equal(moved > 0, upright > 0)


def test_own_arms_are_in_the_way_of_a_head_that_has_them(world: World) -> None:
    left = torch.zeros(15, 55, dtype=torch.bool)
    left[10:, :9] = True
    look = eye(world, lambda tilt: left.expand(len(tilt), -1, -1))
    robots = placed(world, 6)
    clear = look.ranges(robots, torch.zeros(6, 2))
    mount = torch.tensor([0.0, 0.0, look.sensor.spec.height])
    robots.head = Head(robots.position + mount, robots.yaw, torch.zeros(6, 2))
    hidden = look.ranges(robots, torch.zeros(6, 2))
    assert (clear[:, left] > 0).any()
    assert (hidden[:, left] == 0).all()
    assert torch.equal(hidden[:, ~left], clear[:, ~left])
