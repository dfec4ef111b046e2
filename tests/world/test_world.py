from __future__ import annotations

import numpy as np
import pytest
import torch

from romnav.world.build import build
from romnav.world.geodesic import fields
from romnav.world.spec import WorldSpec
from romnav.world.world import World

SPEC = WorldSpec(tiles=3, seed=31, goals_per_tile=5)


@pytest.fixture(scope="module")
def world() -> World:
    return build(SPEC)


def test_packed_arrays_say_what_the_tiles_say(world: World) -> None:
    for t, grids in enumerate(world.grids):
        start = int(world.node_start[t])
        layers = len(grids.node)
        packed = world.node[t, :layers].numpy()
        assert np.array_equal(np.where(packed >= 0, packed - start, -1), grids.node)
        assert (world.node[t, layers:] == -1).all()
        assert np.array_equal(world.height[t, :layers].numpy(), grids.height, equal_nan=True)
        goals = world.goal[world.goal_start[t] : world.goal_start[t + 1]] - start
        assert not grids.connector[goals].any()
        expected = fields(grids, goals.numpy())
        for k, row in enumerate(expected):
            offset = int(world.field_start[int(world.goal_start[t]) + k])
            assert np.array_equal(world.fields[offset : offset + len(row)].numpy(), row)


def test_position_and_cell_agree_at_every_node(world: World) -> None:
    tile = torch.repeat_interleave(torch.arange(3), world.node_start.diff())
    assert torch.equal(world.node_at(tile, world.layer, world.position[:, :2]), torch.arange(len(world.position)))
    assert torch.equal(world.surface(tile, world.layer, world.position[:, :2]), world.position[:, 2])


def test_outside_the_tile_is_occupied(world: World) -> None:
    xy = torch.tensor([[-0.01, 5.0], [SPEC.side, 5.0], [5.0, -3.0], [5.0, SPEC.side + 5.0]])
    zero = torch.zeros(4, dtype=torch.int64)
    assert (world.node_at(zero, zero, xy) == -1).all()
