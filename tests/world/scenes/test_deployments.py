from __future__ import annotations

import numpy as np
import pytest

from romnav.world.solids import Label

ROUTES = {"lab": (38.0, 0.0), "stairwell": (51.0, 7.0), "entrance": (51.0, 10.0), "outdoors": (100.0, -1.0)}
"""Length and climb that the paper gives, m."""


@pytest.mark.parametrize("name", ROUTES)
def test_routes_have_the_lengths_and_climbs_of_the_paper(deployments, name: str) -> None:
    scenes, world = deployments
    (k,) = [k for k, scene in enumerate(scenes) if scene.name == name]
    scene, grid = scenes[k], world.grids[k]
    length, climb = ROUTES[name]
    starts = np.flatnonzero(scene.start.contains(grid.position))
    walked = world.field(int(world.goal_start[k])).numpy()[starts] / 256
    assert np.median(walked) == pytest.approx(length, abs=0.6)
    assert np.ptp(walked) < 4.0
    goal = world.position[world.goal[world.goal_start[k]]]
    assert float(goal[2]) - grid.position[starts, 2] == pytest.approx(climb, abs=1e-4)
    assert world.goal_start[k + 1] - world.goal_start[k] == 1


def test_the_stairwell_leads_over_every_floor_and_landing(deployments) -> None:
    scenes, world = deployments
    stairwell, grid = scenes[1], world.grids[1]
    assert stairwell.tile.layers == (0.0, 1.75, 3.5, 5.25, 7.0)
    assert all((grid.layer == layer).sum() > 20 for layer in range(5))


def test_scenes_have_what_the_paper_names(deployments) -> None:
    solids = {scene.name: scene.tile.solids for scene in deployments[0]}
    wires = {name: ((2 * s.half[:, 1] < 0.03) & (s.top - s.bottom < 0.03)).sum() for name, s in solids.items()}
    assert wires["stairwell"] > 20
    assert wires["outdoors"] > 10
    assert (solids["stairwell"].label == Label.STAIR).sum() == 4 * 10
    assert (solids["entrance"].label == Label.STAIR).sum() == 2 * 29
    assert (solids["outdoors"].label == Label.STAIR).sum() == 6
    # a bare cliff edge: free cells with a drop beside them and no solid in between
    world = deployments[1]
    position = world.grids[3].position
    edge = position[(np.abs(position[:, 1] - 17.5) < 0.2) & (position[:, 2] > 0.5)]
    railings = solids["outdoors"]
    near = np.abs(railings.centre[:, 1] - 17.95) < 0.01
    covered = [(abs(railings.centre[near, 0] - x) <= railings.half[near, 0]).any() for x in edge[:, 0]]
    assert 0.2 < np.mean(covered) < 0.8


def test_terrain_labels_and_layers_agree(deployments) -> None:
    for scene in deployments[0]:
        solids = scene.tile.solids
        assert (solids.layers[solids.label == Label.OBSTACLE] < 0).all()
        assert (solids.layers[np.isin(solids.label, (Label.STAIR, Label.RAMP))] >= 0).all()
