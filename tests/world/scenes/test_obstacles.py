from __future__ import annotations

import numpy as np

from romnav.world.solids import Shape


def _free_of_the_hall(scene) -> np.ndarray:
    """(S,) which solids are obstacles, not floor or wall."""
    solids = scene.tile.solids
    return ~solids.walkable & ~((solids.bottom < 0.0) & (solids.top >= 3.0))


def test_starts_and_goals_are_the_same_in_all_three(obstacles) -> None:
    scenes, world = obstacles
    for area in ("start", "goal"):
        places = [
            grid.position[getattr(scene, area).contains(grid.position)]
            for scene, grid in zip(scenes, world.grids, strict=True)
        ]
        assert len(places[0]) > 50
        assert all(np.array_equal(places[0], other) for other in places[1:])


def test_the_three_sets_are_what_they_are_called(obstacles) -> None:
    plain, ladders, tubes = (scene.tile.solids[_free_of_the_hall(scene)] for scene in obstacles[0])
    assert (plain.bottom == 0.0).all()
    assert (plain.half.min(axis=1) >= 0.25).all()
    assert len(plain) >= 5
    assert (ladders.half.min(axis=1) < 0.05).all()
    assert (np.abs(ladders.slope_top) > 1.0).sum() == 8  # two rails on two sides of two ladders
    assert (tubes.half.min(axis=1) <= 0.025).all()
    assert (tubes.bottom >= 0.9).all()
    assert (tubes.bottom < 1.32).all()
    assert (tubes.shape == Shape.CYLINDER).any()
    assert (tubes.shape == Shape.BOX).any()


def test_obstacles_stand_in_the_way_of_most_trials_and_block_none(obstacles) -> None:
    scenes, world = obstacles
    for k, scene in enumerate(scenes):
        grid = world.grids[k]
        start = np.flatnonzero(scene.start.contains(grid.position))
        goals = world.goal[world.goal_start[k] : world.goal_start[k + 1]].numpy() - int(world.node_start[k])
        across = np.flatnonzero(scene.goal.contains(grid.position[goals]))
        walked = np.stack([world.field(int(world.goal_start[k]) + g).numpy()[start] for g in across]) / 256
        straight = np.linalg.norm(grid.position[goals[across], None, :2] - grid.position[None, start, :2], axis=2)
        assert walked.max() < 14.0
        assert (walked > straight + 0.02).mean() > 0.5
