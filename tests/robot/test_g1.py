"""The G1 as a MuJoCo model, and batches of it."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from romnav.robot.g1 import FOOT_LENGTH, JOINTS, SOLE, Humanoids, build_spec
from romnav.robot.spec import RobotSpec
from romnav.robot.statics import NOTHING, Geoms
from romnav.robot.tiles import geoms
from romnav.world.solids import SolidsBuilder

PLANE = NOTHING
BLOCK = Geoms.boxes(np.array([[0.0, 0.0, 0.25]]), np.array([[3.0, 3.0, 0.25]]), np.array([[1.0, 0.0, 0.0, 0.0]]))


def stand(robots: Humanoids, height: float) -> None:
    qpos = torch.zeros(robots.count, 22)
    qpos[:, 2], qpos[:, 3] = height, 1.0
    robots.set_state(torch.arange(robots.count), qpos, torch.zeros(robots.count, 21))


def test_fifteen_joints_in_order_with_the_published_mass() -> None:
    model = build_spec(RobotSpec(), PLANE).compile()
    assert [model.joint(i).name.removesuffix("_joint") for i in range(1, model.njnt)] == list(JOINTS)
    assert [model.actuator(i).name.removesuffix("_joint") for i in range(model.nu)] == list(JOINTS)
    free = build_spec(RobotSpec(weld_arms=False), PLANE).compile()
    assert free.nu == 29
    assert model.body_subtreemass[1] == pytest.approx(free.body_subtreemass[1])
    assert model.body_subtreemass[1] == pytest.approx(33.3, abs=0.1)


def test_welded_arms_are_where_the_joints_would_put_them() -> None:
    spec = RobotSpec()
    welded, free = (build_spec(spec.model_copy(update={"weld_arms": w}), PLANE).compile() for w in (True, False))
    data, arms = mujoco.MjData(welded), mujoco.MjData(free)
    for side, sign in (("left", 1), ("right", -1)):
        for joint, angle in (("shoulder_pitch", 0.2), ("shoulder_roll", 0.2 * sign), ("elbow", spec.elbow)):
            arms.qpos[free.joint(f"{side}_{joint}_joint").qposadr[0]] = angle
    mujoco.mj_kinematics(welded, data)
    mujoco.mj_kinematics(free, arms)
    for side in ("left", "right"):
        hand = f"{side}_wrist_yaw_link"
        assert data.body(hand).xpos == pytest.approx(arms.body(hand).xpos, abs=1e-9)
        assert data.body(hand).xmat == pytest.approx(arms.body(hand).xmat, abs=1e-9)


@pytest.mark.parametrize(("ground", "top"), [(PLANE, 0.0), (BLOCK, 0.5)])
def test_the_ground_carries_the_robot_and_soles_do_not_sink(ground: Geoms, top: float) -> None:
    """A fall of 5 cm on straight legs: both kinds of ground hold, the feet alone touch, the forces are the weight."""
    robots = Humanoids(RobotSpec(), [ground], 1, threads=1)
    stand(robots, top + 0.793 + 0.05)
    lowest = []
    for _ in range(40):
        robots.step(torch.zeros(1, 15))
        lowest.append(robots.ankle[0, :, 2].min().item() - 0.035 - top)
    assert min(lowest) > -0.012
    assert abs(lowest[-1]) < 0.003
    assert robots.touch[0].nonzero()[:, 0].tolist() == sorted(robots.feet)
    data = robots.batch.get_data(0)
    model = robots.batch.get_model(0)
    mujoco.mj_forward(model, data)
    force, total = np.zeros(6), 0.0
    for k in range(data.ncon):
        mujoco.mj_contactForce(model, data, k, force)
        total += force[0]
    assert total == pytest.approx(robots.mass * 9.81, rel=0.1)


def test_states_do_not_depend_on_threads_and_continue_from_a_saved_state() -> None:
    torch.manual_seed(0)
    actions = 0.2 * torch.randn(12, 3, 15)
    a, b, c = (Humanoids(RobotSpec(), [BLOCK], 3, threads=k) for k in (1, 2, 1))
    for robots in (a, b):
        stand(robots, 1.28)
    for k, action in enumerate(actions):
        a.step(action)
        b.step(action)
        if k == 5:
            saved = a.state_dict()
    c.load_state_dict(saved)
    for action in actions[6:]:
        c.step(action)
    for name in ("qpos", "qvel"):
        assert np.array_equal(getattr(a.batch, name), getattr(b.batch, name))
        assert np.array_equal(getattr(a.batch, name), getattr(c.batch, name))


def test_heavier_robots_sag_more_and_slippery_soles_slide() -> None:
    robots = Humanoids(RobotSpec(), [PLANE], 3, threads=1)
    robots.randomize(torch.tensor([0.8, 0.8, 0.05]), torch.tensor([0.0, 10.0, 0.0]))
    bent = torch.tensor([-0.3, 0, 0, 0.6, -0.3, 0] * 2 + [0.0] * 3).expand(3, -1)
    qpos = torch.cat([torch.tensor([[0.0, 0, 0.75, 1, 0, 0, 0]]).expand(3, -1), bent], dim=1)
    qvel = torch.zeros(3, 21)
    robots.set_state(torch.arange(3), qpos, qvel)
    for _ in range(20):
        robots.step(bent)
    assert robots.pelvis[1, 2] < robots.pelvis[0, 2] - 0.002
    robots.push(torch.tensor([0, 2]), torch.tensor([[0.0, 0.3], [0.0, 0.3]]))
    before = robots.ankle[:, :, 1].mean(1)
    for _ in range(10):
        robots.step(bent)
    moved = robots.ankle[:, :, 1].mean(1) - before
    assert moved[2] > moved[0] + 0.01


@pytest.mark.parametrize("obstacle", [True, False])
def test_a_foot_kicks_an_obstacle_but_not_the_ground_that_it_walks_on(obstacle: bool) -> None:
    """A slab lower than the shin, with its upright face in the left toes: a sill, or the next step of a stair."""
    free = Humanoids(RobotSpec(), [PLANE], 1, threads=1)
    stand(free, 0.793)
    toes = free.ankle[0, 0] + torch.tensor([SOLE[0] + FOOT_LENGTH / 2, 0.0, 0.0])
    builder, deep, layers = SolidsBuilder(), 0.004, (-1, -1) if obstacle else (0, 0)
    builder.box((float(toes[0]) - deep + 0.5, float(toes[1])), (1.0, 0.15), (0.0, 0.08), layers=layers)
    robots = Humanoids(RobotSpec(), [geoms(builder.build())], 1, threads=1)
    stand(robots, 0.793)
    for _ in range(3):
        robots.step(torch.zeros(1, 15))
    assert robots.touch[0, robots.feet].all()
    assert robots.kicks[0].tolist() == [obstacle, False]
    assert robots.touch.sum() == 2
