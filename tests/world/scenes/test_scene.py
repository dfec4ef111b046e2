from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from romnav.errors import RomnavError
from romnav.world.scenes.obstacles import obstacle_scenes
from romnav.world.scenes.scene import Area, scene_world, terrain_only
from romnav.world.tiles.site import Frame


def test_area_is_the_turned_rectangle_on_its_own_floor() -> None:
    area = Area(Frame(1.0, 2.0, np.pi / 6), (2.0, 0.6), z=4.0)
    points = np.random.default_rng(0).uniform((-1, 0, 3.5), (3, 4, 4.5), (4000, 3))
    turned = (points[:, 0] - 1.0 + 1j * (points[:, 1] - 2.0)) * np.exp(-1j * np.pi / 6)
    expected = (abs(turned.real) <= 1.0) & (abs(turned.imag) <= 0.3) & (abs(points[:, 2] - 4.0) <= 0.3)
    assert np.array_equal(area.contains(points), expected)
    assert 20 < expected.sum() < 1000


def test_goals_are_the_free_nodes_where_trials_end(obstacles, deployments) -> None:
    for scenes, world in (obstacles, deployments):
        for k, scene in enumerate(scenes):
            goals = world.goal[world.goal_start[k] : world.goal_start[k + 1]]
            position = world.position[goals].numpy()
            inside = scene.goal.contains(position)
            assert inside.any()
            assert np.array_equal(inside, ~scene.start.contains(position))
            assert scene.both_ways or inside.all()


def test_terrain_is_free_wherever_the_planning_grid_is_and_under_furniture(obstacles, deployments) -> None:
    for _, world in (obstacles, deployments):
        bare = terrain_only(world, 0.26)
        planned, open_ = world.node >= 0, bare.node >= 0
        assert bool((open_ | ~planned).all())
        assert int((open_ & ~planned).sum()) > 0.05 * int(planned.sum())
        assert torch.equal(bare.height.isnan(), world.height.isnan())


def test_mistakes_are_named() -> None:
    scene = obstacle_scenes()[0]
    other = replace(scene, tile=replace(scene.tile, side=20.0))
    with pytest.raises(RomnavError, match="of one size"):
        scene_world([scene, other])
    lost = replace(scene, goal=Area(Frame(0.1, 0.1), (0.2, 0.2)))
    with pytest.raises(RomnavError, match="in-distribution: its goal has no free cell"):
        scene_world([lost])
