"""What the own arms hide, against a robot that is tilted itself and looked at ray by ray."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from romnav.robot.arms import PITCH, ROLL, STEP, OwnArms
from romnav.robot.g1 import HEAD, build_spec
from romnav.robot.spec import RobotSpec
from romnav.robot.statics import NOTHING

AZIMUTH, ELEVATION = np.meshgrid(np.radians(np.linspace(110, -110, 23)), np.radians(np.linspace(0, -60, 9)))
RAYS = np.stack([np.cos(ELEVATION) * np.cos(AZIMUTH), np.cos(ELEVATION) * np.sin(AZIMUTH), np.sin(ELEVATION)], axis=-1)


def seen_by_a_tilted_robot(roll: float, pitch: float) -> np.ndarray:
    spec = build_spec(RobotSpec(), NOTHING, visual=True)
    for pair in list(spec.pairs):
        spec.delete(pair)
    for geom in list(spec.geoms):
        arm = any(part in geom.parent.name for part in ("shoulder", "elbow", "wrist"))
        if not arm or "collision" in geom.name:
            spec.delete(geom)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[2] = 5.0
    turn = Rotation.from_euler("ZYX", [0.0, pitch, roll])
    data.qpos[3:7] = turn.as_quat()[[3, 0, 1, 2]]
    mujoco.mj_forward(model, data)
    torso = data.body("torso_link")
    origin = torso.xpos + torso.xmat.reshape(3, 3) @ HEAD
    hit = np.zeros(1, np.int32)
    rays = RAYS.reshape(-1, 3)
    found = [mujoco.mj_ray(model, data, origin, ray, None, 1, -1, hit, None) >= 0 for ray in rays]
    return np.array(found).reshape(RAYS.shape[:2])


@pytest.mark.parametrize(
    ("roll", "pitch"), [(0.0, 0.0), (2 * STEP, 0.0), (0.0, -3 * STEP), (-STEP, 2 * STEP), (4 * STEP, 10 * STEP)]
)
def test_the_arms_hide_what_a_tilted_robot_would_not_see(roll: float, pitch: float) -> None:
    arms = OwnArms(RobotSpec(), torch.from_numpy(RAYS), levelled=True)
    tilt = torch.tensor([[roll + 0.3 * STEP, pitch - 0.3 * STEP]])
    expected = seen_by_a_tilted_robot(roll, pitch)
    assert 0.01 < expected.mean() < 0.3
    np.testing.assert_array_equal(arms(tilt)[0].numpy(), expected)


def test_tilts_beyond_the_table_take_its_edge_and_a_camera_sees_its_arms_at_rest() -> None:
    arms = OwnArms(RobotSpec(), torch.from_numpy(RAYS), levelled=True)
    assert torch.equal(arms(torch.tensor([[1.0, -1.0]])), arms(torch.tensor([[ROLL[1] * STEP, PITCH[0] * STEP]])))
    fixed = OwnArms(RobotSpec(), torch.from_numpy(RAYS), levelled=False)
    assert torch.equal(fixed(torch.tensor([[0.2, 0.1]])), arms(torch.zeros(1, 2)))
