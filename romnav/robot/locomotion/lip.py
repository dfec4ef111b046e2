"""The linear inverted pendulum: closed form, periodic walking and foot placement, as functions of kernels.

Between steps the centre of mass, relative to the stance foot, obeys x'' = w^2 x with w = sqrt(g / z). Foot
placement brings the divergent component of motion xi = x + x'/w, predicted at touch-down, onto the offset
that the periodic gait of the commanded velocity has there (capture-point control: Pratt et al. 2006,
Englsberger et al. 2015; H-LIP orbits: Xiong and Ames 2022).
"""

from __future__ import annotations

import math

from romnav.kernels import wp
from romnav.robot.spec import GaitSpec

GRAVITY = 9.81

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


@wp.struct
class Gait:
    """`GaitSpec` for kernels, and what follows from it.

    Attributes:
        dt: control step, s.
        duration: of a step, s.
        w: frequency of the pendulum, 1/s.
    """

    dt: float
    duration: float
    w: float
    step_ticks: int
    pelvis: float
    pendulum: float
    sink: float
    width: float
    clearance: float
    swing_end: float
    swing_across: float
    reach_forward: wp.vec2
    reach_side: wp.vec2
    edge_search: float
    edge_margin: float
    acceleration: wp.vec3
    ahead: float
    integral_gain: float
    integral_limit: float
    level: float
    integral_decay: float
    stair_speed: float
    pull: float
    early: float
    climb: float
    upright_gain: float


def gait_of(spec: GaitSpec, dt: float) -> Gait:
    """A specification at a control step ``dt``, s."""
    gait = Gait()
    for name, value in spec.model_dump().items():
        setattr(gait, name, value)
    gait.dt, gait.duration, gait.w = dt, spec.step_ticks * dt, math.sqrt(GRAVITY / spec.pendulum)
    return gait


@wp.func
def wrap(angle: float):
    """Angle in (-pi, pi]."""
    return wp.atan2(wp.sin(angle), wp.cos(angle))


@wp.func
def turned(vector: wp.vec2, angle: float):
    """A horizontal vector turned by an angle, rad."""
    c = wp.cos(angle)
    s = wp.sin(angle)
    return wp.vec2(c * vector[0] - s * vector[1], s * vector[0] + c * vector[1])


@wp.func
def smoothstep(t: float):
    """Minimum-jerk rise from 0 to 1 over t in [0, 1], clamped: 10 t^3 - 15 t^4 + 6 t^5."""
    t = wp.clamp(t, 0.0, 1.0)
    return t * t * t * (10.0 - 15.0 * t + 6.0 * t * t)


@wp.func
def orbit(gait: Gait, speed: wp.vec2, side: float, time: float):
    """Periodic gait of a velocity: the centre of mass from the stance foot, and its velocity.

    Forwards x = v T / 2 sinh(w t) / sinh(w T / 2) with t from the middle of the step, so that the body advances by
    v T in a step; sideways, besides, a sway of d / 2 cosh(w t) / cosh(w T / 2) away from the stance foot.

    Args:
        gait: with the duration T, width d between the feet and frequency w.
        speed: forward and lateral velocity v, m/s.
        side: +1 where the left foot stands, -1 where the right.
        time: since touch-down, s, in [0, T].

    Returns:
        Position, m, and velocity, m/s, in the heading frame.
    """
    half = gait.w * gait.duration / 2.0
    t = gait.w * time - half
    amplitude = speed * gait.duration / 2.0 / wp.sinh(half)
    sway = wp.vec2(0.0, -side * gait.width / 2.0 / wp.cosh(half))
    position = amplitude * wp.sinh(t) + sway * wp.cosh(t)
    velocity = (amplitude * wp.cosh(t) + sway * wp.sinh(t)) * gait.w
    return position, velocity


@wp.func
def capture_offset(gait: Gait, speed: wp.vec2, next_side: float):
    """Divergent component ahead of the new stance foot at touch-down of the periodic gait, m.

    v T / (exp(w T) - 1), and sideways d / (exp(w T) + 1) away from the foot that stands next, `next_side`.
    """
    grown = wp.exp(gait.w * gait.duration)
    return speed * gait.duration / (grown - 1.0) - wp.vec2(0.0, next_side * gait.width / (grown + 1.0))


@wp.func
def integrate(gait: Gait, integral: wp.vec2, error: wp.vec2, free: bool):
    """Integral of the velocity error after a control step, m/s; it decays where the robot is not free to go as told."""
    change = gait.integral_gain * error if free else -integral / gait.integral_decay
    limit = wp.vec2(gait.integral_limit, gait.integral_limit)
    return wp.min(wp.max(integral + gait.dt * change, -limit), limit)


@wp.func
def orbit_velocity(gait: Gait, command: wp.vec2, integral: wp.vec2, level: bool):
    """Velocity of the orbit for a commanded one, m/s: corrected, and a little faster up and down stairs."""
    faster = gait.stair_speed if not level and command[0] > gait.stair_speed else 0.0
    return command + integral + wp.vec2(faster, 0.0)
