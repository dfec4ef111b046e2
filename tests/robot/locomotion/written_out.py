"""The reference of one robot and control step, as docs/locomotion.md has it, in NumPy: what the kernel is to give."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from romnav.robot.g1 import FOOT_LENGTH, SOLE
from romnav.robot.spec import GaitSpec

Ground = Callable[[NDArray, float], NDArray]
"""Heights (k,) under points (k, 2) of the highest surfaces within a reach."""
HALF, SOLE_AT = FOOT_LENGTH / 2, np.array(SOLE)


def _turn(angle: float) -> NDArray:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def _yaw(rotation: NDArray) -> float:
    return float(np.arctan2(rotation[1, 0], rotation[0, 0]))


def _wrap(angle: float) -> float:
    return float(np.angle(np.exp(1j * angle)))


def _rise(t: float) -> float:
    t = min(max(t, 0.0), 1.0)
    return 10 * t**3 - 15 * t**4 + 6 * t**5


def _off_edges(s: GaitSpec, ground: Ground, aim: NDArray, heading: float, reach: float, level: float) -> NDArray:
    ahead = np.array([np.cos(heading), np.sin(heading)])
    sole = np.linspace(-HALF, HALF, 7)
    line = np.concatenate(
        [sole, HALF + s.edge_margin * np.array([0.5, 1.0]), -HALF - s.edge_margin * np.array([0.5, 1])]
    )
    moves = np.linspace(-1.0, 1.0, 15) * s.edge_search
    costs = []
    for move in moves:
        height = ground(aim + (move + line)[:, None] * ahead, reach)
        heel, toe = height[0], height[6]
        over = height - heel - (toe - heel) * (line + HALF) / FOOT_LENGTH
        bump, riser = np.abs(over[:7]).max(), over[7:].max()
        climb = abs(height[:7].max() - level)
        costs.append(
            abs(move) + 8 * max(bump - 0.015, 0) + 4 * max(riser - 0.015, 0) + 20 * max(climb - s.climb, 0)
        )  # fmt: skip
    return aim + moves[int(np.argmin(costs))] * ahead


def _sole(ground: Ground, centre: NDArray, yaw: float, reach: float) -> NDArray:
    ahead = HALF * np.array([np.cos(yaw), np.sin(yaw)])
    toe, middle, heel = ground(centre + np.array([[1], [0], [-1]]) * ahead, reach)
    plane = abs((toe + heel) / 2 - middle) < 0.012 and abs(toe - heel) < 0.13
    pitch = -np.arctan2(toe - heel, FOOT_LENGTH) if plane else 0.0
    return Rotation.from_euler("ZY", [yaw, pitch]).as_matrix()


def step(
    s: GaitSpec, dt: float, mass: float, state: dict[str, Any], robot: dict[str, Any], told: NDArray, fresh: bool,
    ground: Ground,
) -> tuple[dict[str, Any], dict[str, Any]]:  # fmt: skip
    """State and reference after a control step.

    Args:
        s: the gait.
        dt: control step, s.
        mass: kg.
        state: `Walker.STATE` but for the joints.
        robot: fields of `Robots`; `feet`, whether each touches.
        told: (3,) command.
        fresh: it was just placed.
        ground: what it walks on.

    Returns:
        The state, and the reference with `ankle` and `ankle_rotation`, the poses wanted in the frame of the pelvis.
    """
    t_step, w = s.step_ticks * dt, np.sqrt(9.81 / s.pendulum)
    tick, stance = state["clock"] % s.step_ticks, int(state["clock"] // s.step_ticks % 2)
    swing, side, phase = 1 - stance, 1.0 - 2.0 * stance, tick / s.step_ticks
    start = tick == 0 or fresh
    sole = robot["ankle"] + robot["ankle_rotation"] @ SOLE_AT
    planted = state["planted"]
    if start:
        planted = sole[stance] if fresh else state["foothold"]
    touches = bool(robot["feet"][stance]) or fresh
    landed = touches if start else bool(state["landed"]) or touches
    stand = sole[stance] if landed else planted
    reach = stand[2] + 0.5
    under = ground(sole[:, :2], reach)
    base = under.mean() if start else state["base"]
    lift = sole[swing] if start else state["lift"]

    flat = fresh or max(abs(state["foothold"][2] - base), abs(under[0] - under[1])) < s.level
    yaw, rate = _yaw(robot["orientation"]), robot["com_velocity"][:2]
    velocity = _turn(-yaw) @ rate
    fastest = max(velocity[0], 0.0) + s.ahead if flat else np.inf
    free = flat and told[0] <= fastest
    slew = np.array(s.acceleration) * dt
    command = state["command"] + np.clip(np.minimum(told, [fastest, np.inf, np.inf]) - state["command"], -slew, slew)
    heading = _wrap(yaw + np.clip(_wrap(state["heading"] + command[2] * dt - yaw), -0.35, 0.35))
    error = command[:2] - velocity
    change = s.integral_gain * error if free else -state["integral"] / s.integral_decay
    integral = np.clip(state["integral"] + dt * change, -s.integral_limit, s.integral_limit)
    speed = command[:2] + integral
    if not flat and command[0] > s.stair_speed:
        speed = speed + np.array([s.stair_speed, 0.0])

    left = (1 - phase) * t_step - s.early
    x = robot["com"][:2] - stand[:2]
    landing = heading + command[2] * left
    periodic = speed * t_step / (np.exp(w * t_step) - 1) + np.array([0, side * s.width / (np.exp(w * t_step) + 1)])
    ahead, beside = _turn(-landing) @ (x + rate / w) * np.exp(w * left) - periodic
    reached = np.array([np.clip(ahead, *s.reach_forward), -side * np.clip(-side * beside, *s.reach_side)])
    aim = _off_edges(s, ground, stand[:2] + _turn(landing) @ reached, landing, reach, under[stance])
    place = state["foothold"][:2] + (1.0 if start else 0.4) * (aim - state["foothold"][:2])
    foothold = np.array([*place, *ground(place[None], reach)])

    t, way = phase / s.swing_end, foothold - lift
    passed = ground(lift[:2] + np.linspace(-0.1, 1.3, 9)[:, None] * way[:2], reach)
    apex = max(passed.max(), lift[2]) + s.clearance
    up, down = _rise(t / 0.45), _rise((t - 0.55) / 0.45)
    height = lift[2] + (apex - lift[2]) * up if t < 0.5 else apex + (foothold[2] - apex) * down
    foot = np.array([*(lift[:2] + way[:2] * _rise((t - 0.1) / (s.swing_across - 0.1))), height])

    apart = under[stance] - foothold[2]
    pelvis = s.pelvis + base + ((under[stance] + foothold[2]) / 2 - base) * _rise(phase) - s.sink * abs(apart)

    time = w * (phase - 0.5) * t_step
    amplitude, sway = speed * t_step / 2 / np.sinh(w * t_step / 2), -side * s.width / 2 / np.cosh(w * t_step / 2)
    com = amplitude * np.sinh(time) + np.array([0, sway * np.cosh(time)])
    com_velocity = w * (amplitude * np.cosh(time) + np.array([0, sway * np.sinh(time)]))
    pull = s.pull * np.clip(_turn(heading) @ (com + com_velocity / w) - x - rate / w, -0.1, 0.1)

    at = robot["pelvis"] + np.array([*robot["velocity"][:2] * dt, 0.0])
    tilt = s.upright_gain * robot["orientation"][2]
    upright = Rotation.from_euler("ZYX", [heading, tilt[0], -tilt[1]]).as_matrix()
    ankle, turn = np.zeros((2, 3)), np.zeros((2, 3, 3))
    for foot_at, hip, frame, lies, k in (
        (stand, np.array([*(at[:2] + pull), pelvis]), upright,
         _sole(ground, stand[:2], _yaw(robot["ankle_rotation"][stance]), reach), stance),
        (foot, at, robot["orientation"], _sole(ground, foothold[:2], landing, reach), swing),
    ):  # fmt: skip
        ankle[k], turn[k] = frame.T @ (foot_at - lies @ SOLE_AT - hip), frame.T @ lies

    share = np.zeros(2)
    share[stance] = min(0.5 + 2.5 * phase, 1.0)
    share[swing] = 1 - share[stance]
    lean = np.clip(robot["com"][:2] - sole[:, :2], -0.3, 0.3) / s.pendulum
    force = mass * 9.81 * share[:, None] * np.column_stack([lean, [1.0, 1.0]])
    anchor, axis = robot["anchor"][:12].reshape(2, 6, 3), robot["axis"][:12].reshape(2, 6, 3)
    torque = -(axis * np.cross(sole[:, None] - anchor, force[:, None])).sum(-1)
    now = {
        "clock": (state["clock"] + 1) % (2 * s.step_ticks), "lift": lift, "foothold": foothold, "planted": planted,
        "landed": landed, "base": base, "heading": heading, "command": command, "integral": integral,
    }  # fmt: skip
    return now, {
        "side": side, "phase": phase, "torque": torque, "com": com, "com_velocity": com_velocity, "height": pelvis,
        "heading": heading, "swing": foot, "foothold": foothold, "sole": sole, "ground": under.mean(), "ankle": ankle,
        "ankle_rotation": turn,
    }  # fmt: skip
