from __future__ import annotations

import mujoco
import numpy as np

from romnav.report.paired.gallery import EpisodeGallery
from romnav.report.replay.parts import Figure, Motion, parts, storeys
from romnav.robot.spec import RobotSpec
from romnav.world.mesh import triangulate


def test_parts_are_the_whole_tile_and_each_solid_stands_on_its_storey(galleries: dict[str, EpisodeGallery]) -> None:
    for tile in galleries["oracle"].world.tiles:
        made = parts(tile)
        assert sum(len(part.triangles) for part in made) == len(triangulate(tile.solids, segments=20).triangles)
        floors = np.array([tile.layers[layer] for layer in tile.storeys])
        on = storeys(tile)
        assert (tile.solids.bottom >= floors[on] - 0.5).sum() >= (on > 0).sum()
        slab = tile.solids.walkable & np.isin(tile.solids.layers[:, 0], tile.storeys) & (tile.solids.label == 0)
        for k in np.flatnonzero(slab & (tile.solids.bottom > 0.5)):
            assert tile.storeys[on[k]] == tile.solids.layers[k, 0]


def test_meshes_of_the_humanoid_are_where_its_bodies_are() -> None:
    figure = Figure(RobotSpec())
    joints = np.zeros(figure.model.nq)
    joints[:7] = 3.0, 4.0, 0.8, 1.0, 0.0, 0.0, 0.0
    at, turns = figure.place(joints)
    assert len(figure.meshes()) == len(at) == len(turns) > 20
    np.testing.assert_allclose(np.linalg.norm(turns, axis=1), 1.0, atol=1e-6)
    data = mujoco.MjData(figure.model)
    data.qpos[:] = joints
    mujoco.mj_forward(figure.model, data)
    pelvis = data.body("pelvis").xpos
    assert np.linalg.norm(at[:, :2] - pelvis[:2], axis=1).max() < 0.6
    assert (at[:, 2] > -0.1).all()
    assert (at[:, 2] < 1.5).all()


def test_between_its_samples_the_humanoid_moves_smoothly_and_the_short_way_around() -> None:
    time = np.arange(20) * 0.2
    turn = 1.2 * time
    joints = np.zeros((20, 8))
    joints[:, 3], joints[:, 6] = np.cos(turn / 2), np.sin(turn / 2)
    joints[:, 7] = 0.4 * np.sin(2 * np.pi * time / 0.8)
    joints[::3, 3:7] *= -1  # the same orientations
    motion = Motion(joints)
    for at in np.linspace(2, 17, 40):
        between = motion(at)
        heading = 2 * np.arctan2(between[6], between[3])
        assert abs(np.angle(np.exp(1j * (heading - 1.2 * 0.2 * at)))) < 1e-3
        assert abs(between[7] - 0.4 * np.sin(2 * np.pi * 0.2 * at / 0.8)) < 0.06
