from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from romnav.robot.rom import ReducedOrderModel
from romnav.world.build import build
from romnav.world.spawns import Start
from romnav.world.spec import WorldSpec
from romnav.world.world import World


@pytest.fixture(scope="module")
def world() -> World:
    return build(WorldSpec(tiles=3, seed=11, goals_per_tile=4))


def at(world: World, nodes: torch.Tensor, yaw: torch.Tensor) -> ReducedOrderModel:
    robot = ReducedOrderModel(world, len(nodes), 0.2)
    tile = torch.searchsorted(world.node_start, nodes, right=True) - 1
    zero = torch.zeros(len(nodes), dtype=torch.int64)
    start = Start(tile, world.layer[nodes], world.position[nodes, :2].clone(), yaw, zero, yaw)
    robot.reset(torch.arange(len(nodes)), start)
    return robot


def crowd(world: World, count: int = 400) -> ReducedOrderModel:
    generator = torch.Generator().manual_seed(0)
    nodes = torch.randint(len(world.position), (count,), generator=generator)
    return at(world, nodes, torch.rand(count, generator=generator) * 2 * math.pi)


def test_integrates_the_papers_dynamics_in_free_space(world: World) -> None:
    """x' = x + (vx cos - vy sin) dt, y' = y + (vy cos + vx sin) dt, yaw' = yaw + wz dt, to second order in dt."""
    robot = crowd(world)
    before, yaw = robot.position.clone(), robot.yaw.clone()
    command = torch.tensor([0.8, -0.2, 0.5]).expand(400, 3)
    robot.step(command)
    free = robot.contacts == 0
    assert free.float().mean() > 0.5
    middle = yaw + 0.5 * 0.5 * 0.2  # heading half way through the step
    dx = (0.8 * middle.cos() + 0.2 * middle.sin()) * 0.2
    dy = (-0.2 * middle.cos() + 0.8 * middle.sin()) * 0.2
    moved = (robot.position - before)[:, :2]
    torch.testing.assert_close(moved[free], torch.stack([dx, dy], dim=1)[free], atol=6e-3, rtol=0)
    turned = torch.remainder(robot.yaw - yaw - 0.1 + math.pi, 2 * math.pi) - math.pi
    assert turned.abs().max() < 1e-5


def test_never_enters_an_occupied_cell(world: World) -> None:
    robot = crowd(world)
    generator = torch.Generator().manual_seed(1)
    for _ in range(150):
        robot.step((torch.rand(400, 3, generator=generator) * 2 - 1) * torch.tensor([1.0, 0.25, 1.0]))
        node = world.node_at(robot.tile, robot.layer, robot.position[:, :2])
        assert (node >= 0).all()
        assert torch.equal(world.layer[node], robot.layer)
        height = world.surface(robot.tile, robot.layer, robot.position[:, :2])
        assert torch.equal(height, robot.position[:, 2])


def test_walks_only_where_geodesics_do(world: World) -> None:
    """Every half step leads to one of the eight cells that the grid calls neighbours: never between two occupied
    cells that touch at a corner. A tenth of the cells is occupied at random, so that there are many such pairs."""
    generator = torch.Generator().manual_seed(3)
    gone = torch.rand(len(world.position), generator=generator) < 0.1
    scattered = replace(world, node=torch.where((world.node >= 0) & gone[world.node.long()], -1, world.node))
    neighbours = []
    for grid, first in zip(world.grids, world.node_start.tolist(), strict=False):
        kept = np.where((grid.node >= 0) & ~gone.numpy()[grid.node + first], grid.node, -1)
        near = replace(grid, node=kept).neighbours()
        neighbours.append(torch.from_numpy(np.where(near >= 0, near + first, -1)))
    adjacent = torch.cat(neighbours)
    robot = at(scattered, torch.nonzero(~gone)[::29, 0], torch.zeros(len(torch.nonzero(~gone)[::29])))
    crossed = 0
    for _ in range(60):
        before = world.node_at(robot.tile, robot.layer, robot.position[:, :2])
        cell = world.index(robot.position[:, :2])
        robot._slide(torch.rand(len(before), 2, generator=generator) * 0.2 - 0.1)
        after = world.node_at(robot.tile, robot.layer, robot.position[:, :2])
        assert ((adjacent[before] == after[:, None]).any(dim=1) | (before == after)).all()
        crossed += int((world.index(robot.position[:, :2]) != cell).all(dim=1).sum())
    assert crossed > 100, "no diagonal step was tried"


def test_walks_over_no_drop(world: World) -> None:
    robot = crowd(world)
    generator = torch.Generator().manual_seed(2)
    for _ in range(100):
        before = robot.position[:, 2].clone()
        robot.step(torch.rand(400, 3, generator=generator) * torch.tensor([1.0, 0.25, 1.0]))
        # two cells of the steepest stairs (0.18 m over 0.26 m), each with a step edge inside
        assert (robot.position[:, 2] - before).abs().max() <= 2 * world.spec.grid.max_step


def test_slides_along_walls(world: World) -> None:
    """Held at 45 degrees against an axis-aligned border, the tangential half of the motion is kept."""
    _, _, count, _ = world.node.shape
    floor = world.node[0, 0]
    run = 12
    found = None
    for x in range(1, count - 1):
        for y in range(1, count - run):
            lane = floor[x, y : y + run]
            if (lane >= 0).all() and (floor[x + 1, y : y + run] < 0).all():
                found = lane[2:3].long()
                break
        if found is not None:
            break
    assert found is not None
    robot = at(world, found, torch.tensor([math.pi / 4]))
    before = robot.position.clone()
    for _ in range(5):
        robot.step(torch.tensor([[1.0, 0.0, 0.0]]))
    moved = (robot.position - before)[0]
    assert moved[1].item() == pytest.approx(math.sqrt(0.5), abs=1e-4)
    assert 0 <= moved[0].item() <= 0.1
    assert robot.contacts.item() == 1.0


def test_changes_layer_by_height_on_every_stair(world: World) -> None:
    """Driven along each connector's centre line, the robot ends on the connector's other layer."""
    for t, tile in enumerate(world.tiles):
        for connector in tile.connectors:
            for path, layers in (
                (connector.path, connector.layers),
                (connector.path[::-1], connector.layers[::-1]),
            ):
                first = torch.tensor(path[0].copy(), dtype=torch.float32)
                robot = ReducedOrderModel(world, 1, 0.2)
                one = torch.zeros(1, dtype=torch.int64)
                start = Start(one + t, one + layers[0], first[None, :2], torch.zeros(1), one, torch.zeros(1))
                robot.reset(one, start)
                for target in path[1:]:
                    for _ in range(300):
                        offset = torch.tensor(target[:2].copy(), dtype=torch.float32) - robot.position[0, :2]
                        if offset.norm() < 0.15:
                            break
                        robot.yaw = torch.atan2(offset[1:], offset[:1])
                        robot.step(torch.tensor([[0.7, 0.0, 0.0]]))
                assert robot.layer.item() == layers[1], (tile.kind, connector.kind)
                assert robot.position[0, 2].item() == pytest.approx(path[-1][2], abs=0.3)


def test_select_keeps_rows(world: World) -> None:
    robot = crowd(world)
    expected = robot.position[[7, 3]].clone()
    robot.select(torch.tensor([7, 3]))
    assert torch.equal(robot.position, expected)
    robot.step(torch.zeros(2, 3))
    assert robot.contacts.shape == (2,)
