"""Static geoms within reach against the whole tile in one model."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from romnav.robot.g1 import Humanoids, build_spec
from romnav.robot.spec import RobotSpec
from romnav.robot.statics import CUBE, REACH, Geoms
from romnav.robot.tiles import geoms
from romnav.world.spec import WorldSpec
from romnav.world.tiles import generate

POSES = 40


@pytest.fixture(scope="module")
def grounds() -> list[Geoms]:
    spec = WorldSpec(tiles=2, goals_per_tile=2, classes=("building", "outdoor"))
    return [geoms(generate(spec, k)[0].solids) for k in range(2)]


@pytest.fixture(scope="module")
def whole(grounds: list[Geoms]) -> list[mujoco.MjModel]:
    return [build_spec(RobotSpec(), ground).compile() for ground in grounds]


@pytest.fixture(scope="module")
def robots(grounds: list[Geoms]) -> Humanoids:
    made = Humanoids(RobotSpec(), grounds, POSES, threads=1)
    # masses of their own have MuJoCo measure bounding volumes anew, too: what is within reach stays in them
    made.randomize(torch.full((POSES,), 0.8), torch.ones(POSES))
    return made


def poses(rng: np.random.Generator, ground: Geoms, limits: np.ndarray) -> np.ndarray:
    """States (POSES, 22) about geoms of a ground, tumbled, with any joints."""
    pick = rng.integers(len(ground), size=POSES)
    away = np.minimum(ground.half[pick] + 0.7, 1.5)
    at = ground.position[pick] + rng.uniform(-1.0, 1.0, (POSES, 3)) * away
    quat = rng.normal(size=(POSES, 4))
    joints = rng.uniform(limits[:, 0], limits[:, 1], (POSES, len(limits)))
    return np.concatenate([at, quat / np.linalg.norm(quat, axis=1, keepdims=True), joints], axis=1)


def contacts(model: mujoco.MjModel, data: mujoco.MjData) -> list[tuple]:
    """Contacts with the ground: the robot's geom, kind and body of the other, place and depth."""
    found = []
    for contact in data.contact[: data.ncon]:
        mine, other = sorted(contact.geom, key=lambda g: model.body_weldid[model.geom_bodyid[g]] == 0)
        if model.body_weldid[model.geom_bodyid[other]] == 0:
            kind, body = int(model.geom_type[other]), model.body(model.geom_bodyid[other]).name
            found.append((model.geom(mine).name, kind, body, *contact.pos.round(7), round(contact.dist, 7)))
    return sorted(found)


@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 2**31), tile=st.integers(0, 1))
def test_contacts_are_those_of_the_whole_tile(
    seed: int, tile: int, grounds: list[Geoms], whole: list[mujoco.MjModel], robots: Humanoids
) -> None:
    ids = torch.arange(POSES)
    states = poses(np.random.default_rng(seed), grounds[tile], robots.model.jnt_range[1:])
    robots.stand_on(torch.full((POSES,), tile))
    robots.set_state(ids, torch.from_numpy(states), torch.zeros(POSES, 21))
    data, touched = mujoco.MjData(whole[tile]), 0
    for k, state in enumerate(states):
        data.qpos = state
        mujoco.mj_forward(whole[tile], data)
        expected = contacts(whole[tile], data)
        assert contacts(robots.batch.get_model(k), robots.batch.get_data(k)) == expected
        touched += len(expected)
    assert touched > POSES


def test_a_model_is_small_and_held_until_the_robot_leaves_its_cube(grounds: list[Geoms], robots: Humanoids) -> None:
    assert robots.model.ngeom < len(grounds[0]) / 4
    small = grounds[0].position[grounds[0].half.max(1).argmin()]
    cube = torch.from_numpy(np.floor(small / CUBE) * CUBE)
    states = torch.zeros(POSES, 22, dtype=torch.float64)
    states[:, 3] = 1.0
    robots.stand_on(torch.zeros(POSES, dtype=torch.long))
    held = []
    for part in (0.1, 0.9, 3.5):
        states[:, :3] = cube + part * CUBE
        robots.set_state(torch.arange(POSES), states, torch.zeros(POSES, 21))
        held.append(robots.batch.get_model(0).geom_pos.copy())
    assert np.array_equal(held[0], held[1])
    assert not np.array_equal(held[1], held[2])


def test_no_part_of_a_robot_is_beyond_its_reach(robots: Humanoids) -> None:
    """Spheres around its geoms, over corners and draws of all joints; the rest is what it moves in a control step."""
    model, rng = robots.model, np.random.default_rng(0)
    data, low, high = mujoco.MjData(model), *model.jnt_range[1:].T
    own = model.body_weldid[model.geom_bodyid] != 0
    furthest = 0.0
    for k in range(400):
        draw = rng.random(len(low))
        data.qpos[:3], data.qpos[7:] = 0.0, low + (high - low) * (draw.round() if k % 2 else draw)
        mujoco.mj_kinematics(model, data)
        furthest = max(furthest, (np.linalg.norm(data.geom_xpos, axis=1) + model.geom_rbound)[own].max())
    assert furthest < REACH - 0.1
