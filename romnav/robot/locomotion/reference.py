"""The reference of a control step on terrain, from the pendulum: one Warp kernel, a robot each thread."""

# ruff: noqa: UP018 - in Warp, float() declares a variable that changes

from __future__ import annotations

from romnav.kernels import wp
from romnav.robot.g1 import FOOT_LENGTH, SOLE
from romnav.robot.heights import Maps, highest
from romnav.robot.locomotion.lip import (
    GRAVITY,
    Gait,
    capture_offset,
    integrate,
    orbit,
    orbit_velocity,
    smoothstep,
    turned,
    wrap,
)

TRIES = 7
"""Places to each side where a foothold may be moved to."""
_HALF = wp.constant(FOOT_LENGTH / 2)
_SOLE = wp.constant(wp.vec3(*SOLE))
_X = wp.constant(wp.vec3(1.0, 0.0, 0.0))
_Y = wp.constant(wp.vec3(0.0, 1.0, 0.0))
_Z = wp.constant(wp.vec3(0.0, 0.0, 1.0))

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


@wp.struct
class State:
    """What a `romnav.robot.locomotion.walker.Walker` remembers of (n,) robots besides their joints."""

    clock: wp.array(dtype=wp.int64)
    lift: wp.array(dtype=wp.vec3)
    foothold: wp.array(dtype=wp.vec3)
    planted: wp.array(dtype=wp.vec3)
    landed: wp.array(dtype=wp.bool)
    base: wp.array(dtype=float)
    heading: wp.array(dtype=float)
    command: wp.array(dtype=wp.vec3)
    integral: wp.array(dtype=wp.vec2)


@wp.struct
class Targets:
    """A `romnav.robot.locomotion.walker.Reference` but for its joints, and the poses of the ankles in the frame of the
    pelvis that those are for."""

    side: wp.array(dtype=float)
    phase: wp.array(dtype=float)
    torque: wp.array3d(dtype=float)
    com: wp.array(dtype=wp.vec2)
    com_velocity: wp.array(dtype=wp.vec2)
    height: wp.array(dtype=float)
    heading: wp.array(dtype=float)
    swing: wp.array(dtype=wp.vec3)
    foothold: wp.array(dtype=wp.vec3)
    sole: wp.array2d(dtype=wp.vec3)
    ground: wp.array(dtype=float)
    ankle: wp.array2d(dtype=wp.vec3)
    ankle_rotation: wp.array2d(dtype=wp.mat33)


@wp.func
def xy(vector: wp.vec3):
    """The horizontal part of a vector."""
    return wp.vec2(vector[0], vector[1])


@wp.func
def _about(axis: wp.vec3, angle: float):
    return wp.quat_to_matrix(wp.quat_from_axis_angle(axis, angle))


@wp.func
def yaw_of(rotation: wp.mat33):
    """Heading, rad."""
    return wp.atan2(rotation[1, 0], rotation[0, 0])


@wp.func
def clear_of_edges(gait: Gait, maps: Maps, robot: int, point: wp.vec2, heading: float, reach: float, level: float):
    """Move a foothold along the heading to where the ground under the sole is nearest to a plane and no riser is
    close to it, not more than a riser from the ``level`` of the stance foot.

    The shin leans over the toes into the next riser's nose, and on the way down the heel catches on the last
    one's; a drop beside the sole does no harm.
    """
    ahead = turned(wp.vec2(1.0, 0.0), heading)
    best = float(wp.inf)
    place = point
    for k in range(2 * TRIES + 1):
        # from the middle outwards, until moving costs more than the best place
        moved = gait.edge_search * float((k + 1) // 2) / float(TRIES)
        if moved >= best:
            break
        there = point + (moved if k % 2 == 0 else -moved) * ahead
        heel = highest(maps, robot, there - _HALF * ahead, reach)
        toe = highest(maps, robot, there + _HALF * ahead, reach)
        slope = (toe - heel) / (2.0 * _HALF)
        top = wp.max(heel, toe)
        bump = float(0.0)
        for i in range(1, 6):
            along = _HALF * (float(i) / 3.0 - 1.0)
            height = highest(maps, robot, there + along * ahead, reach)
            top = wp.max(top, height)
            bump = wp.max(bump, wp.abs(height - heel - slope * (along + _HALF)))
        riser = float(0.0)
        for i in range(1, 3):
            beyond = _HALF + gait.edge_margin * float(i) / 2.0
            before = highest(maps, robot, there + beyond * ahead, reach)
            behind = highest(maps, robot, there - beyond * ahead, reach)
            riser = wp.max(riser, before - heel - slope * (beyond + _HALF))
            riser = wp.max(riser, behind - heel - slope * (_HALF - beyond))
        cost = moved + 8.0 * wp.max(bump - 0.015, 0.0) + 4.0 * wp.max(riser - 0.015, 0.0)
        cost += 20.0 * wp.max(wp.abs(top - level) - gait.climb, 0.0)
        if cost < best:
            best = cost
            place = there
    return place


@wp.func
def swing_sole(gait: Gait, maps: Maps, robot: int, lift: wp.vec3, foothold: wp.vec3, phase: float, reach: float):
    """The swing sole: up over the highest ground on the way, then across, then down."""
    t = phase / gait.swing_end
    way = foothold - lift
    apex = lift[2]
    for k in range(9):
        apex = wp.max(apex, highest(maps, robot, xy(lift + (1.4 * float(k) / 8.0 - 0.1) * way), reach))
    apex += gait.clearance
    across = xy(lift) + xy(way) * smoothstep((t - 0.1) / (gait.swing_across - 0.1))
    height = lift[2] + (apex - lift[2]) * smoothstep(t / 0.45)
    if t >= 0.5:
        height = apex + (foothold[2] - apex) * smoothstep((t - 0.55) / 0.45)
    return wp.vec3(across[0], across[1], height)


@wp.func
def lying(maps: Maps, robot: int, centre: wp.vec2, yaw: float, reach: float):
    """Orientation of a sole that lies along the ground where that is a plane, level where it is an edge."""
    ahead = turned(wp.vec2(_HALF, 0.0), yaw)
    toe = highest(maps, robot, centre + ahead, reach)
    middle = highest(maps, robot, centre, reach)
    heel = highest(maps, robot, centre - ahead, reach)
    pitch = float(0.0)
    if wp.abs((toe + heel) / 2.0 - middle) < 0.012 and wp.abs(toe - heel) < 0.13:
        pitch = -wp.atan2(toe - heel, 2.0 * _HALF)
    return _about(_Z, yaw) * _about(_Y, pitch)


@wp.func
def ground_force(gait: Gait, weight: float, lean: wp.vec3):
    """Force of the ground that holds a share of the weight, N, along the pendulum."""
    across = wp.vec2(wp.clamp(lean[0], -0.3, 0.3), wp.clamp(lean[1], -0.3, 0.3)) / gait.pendulum
    return weight * wp.vec3(across[0], across[1], 1.0)


@wp.kernel
def refer(
    gait: Gait,
    maps: Maps,
    wanted: wp.array(dtype=wp.vec3),
    fresh: wp.array(dtype=wp.bool),
    mass: float,
    pelvis: wp.array(dtype=wp.vec3),
    body: wp.array(dtype=wp.mat33),
    pelvis_velocity: wp.array(dtype=wp.vec3),
    com: wp.array(dtype=wp.vec3),
    com_velocity: wp.array(dtype=wp.vec3),
    ankle: wp.array2d(dtype=wp.vec3),
    ankle_rotation: wp.array2d(dtype=wp.mat33),
    anchor: wp.array2d(dtype=wp.vec3),
    axis: wp.array2d(dtype=wp.vec3),
    touch: wp.array2d(dtype=wp.bool),
    feet: wp.vec2i,
    state: State,
    targets: Targets,
):
    robot = wp.tid()
    clock = int(state.clock[robot])
    state.clock[robot] = wp.int64((clock + 1) % (2 * gait.step_ticks))
    tick = clock % gait.step_ticks
    stance = (clock // gait.step_ticks) % 2
    on = 1.0 if stance == 0 else -1.0
    done = float(tick) / float(gait.step_ticks)
    start = tick == 0 or fresh[robot]

    for i in range(2):
        targets.sole[robot, i] = ankle[robot, i] + ankle_rotation[robot, i] * _SOLE

    # A foot that is late keeps aiming at its foothold until it touches the ground.
    landed = touch[robot, feet[stance]] or fresh[robot]
    if start:
        state.planted[robot] = targets.sole[robot, stance] if fresh[robot] else state.foothold[robot]
        state.lift[robot] = targets.sole[robot, 1 - stance]
    elif state.landed[robot]:
        landed = True
    state.landed[robot] = landed
    stand = targets.sole[robot, stance] if landed else state.planted[robot]
    reach = stand[2] + 0.5
    under = highest(maps, robot, xy(targets.sole[robot, stance]), reach)
    under_swing = highest(maps, robot, xy(targets.sole[robot, 1 - stance]), reach)
    mean = (under + under_swing) / 2.0
    if start:
        state.base[robot] = mean
    base = state.base[robot]

    rotation = body[robot]
    yaw = yaw_of(rotation)
    rate = xy(com_velocity[robot])
    velocity = turned(rate, -yaw)
    last = state.foothold[robot]
    level = wp.max(wp.abs(last[2] - base), wp.abs(under - under_swing)) < gait.level or fresh[robot]
    # Who is held by a wall would lean into it ever more.
    told = wanted[robot]
    fastest = wp.max(velocity[0], 0.0) + gait.ahead
    held = level and told[0] > fastest
    if held:
        told[0] = fastest
    slew = gait.acceleration * gait.dt
    command = state.command[robot]
    command += wp.max(wp.min(told - command, slew), -slew)
    state.command[robot] = command
    facing = wrap(yaw + wp.clamp(wrap(state.heading[robot] + command[2] * gait.dt - yaw), -0.35, 0.35))
    state.heading[robot] = facing

    # The pendulum knows neither the body's lag nor turning frames: their constant errors are integrated away,
    # but not where the integral would wind up: held by a wall, and on stairs, where treads bound the steps. There,
    # who loses its speed steps back down to regain it, and falls: it aims at a little more.
    integral = integrate(gait, state.integral[robot], xy(command) - velocity, level and not held)
    state.integral[robot] = integral
    speed = orbit_velocity(gait, xy(command), integral, level)

    # Foothold: the divergent component at touch-down, less the periodic gait's offset, within reach.
    left = (1.0 - done) * gait.duration - gait.early
    x = xy(com[robot]) - xy(stand)
    xi = (x + rate / gait.w) * wp.exp(gait.w * left)
    landing = facing + command[2] * left
    step = turned(xi, -landing) - capture_offset(gait, speed, -on)
    ahead = wp.clamp(step[0], gait.reach_forward[0], gait.reach_forward[1])
    beside = wp.clamp(-on * step[1], gait.reach_side[0], gait.reach_side[1])
    aim = xy(stand) + turned(wp.vec2(ahead, -on * beside), landing)
    aim = clear_of_edges(gait, maps, robot, aim, landing, reach, under)
    # Late corrections would drag the foot over an edge, early ones are noise amplified by exp(w t).
    blend = 1.0 if start else 0.4
    next = xy(last) + blend * (aim - xy(last))
    place = wp.vec3(next[0], next[1], highest(maps, robot, next, reach))
    state.foothold[robot] = place
    foot = swing_sole(gait, maps, robot, state.lift[robot], place, done, reach)

    # Pelvis: from the mean height of the feet at the start of the step to that at its end.
    rise = (under + place[2]) / 2.0 - base
    tall = gait.pelvis + base + rise * smoothstep(done) - gait.sink * wp.abs(under - place[2])

    at, moving = orbit(gait, speed, on, done * gait.duration)
    away = turned(at + moving / gait.w, facing) - x - rate / gait.w
    tenth = wp.vec2(0.1, 0.1)
    pull = gait.pull * wp.min(wp.max(away, -tenth), tenth)

    # Legs: the swing foot placed from the pelvis as it is, the stance leg under the pelvis as wanted.
    along = pelvis_velocity[robot] * gait.dt
    is_at = pelvis[robot] + wp.vec3(along[0], along[1], 0.0)
    upright = gait.upright_gain * wp.vec2(rotation[2, 0], rotation[2, 1])
    for i in range(2):
        if i == stance:
            lies = lying(maps, robot, xy(stand), yaw_of(ankle_rotation[robot, i]), reach)
            frame = wp.transpose(_about(_Z, facing) * _about(_Y, upright[0]) * _about(_X, -upright[1]))
            hip = wp.vec3(is_at[0] + pull[0], is_at[1] + pull[1], tall)
            targets.ankle[robot, i] = frame * (stand - lies * _SOLE - hip)
            targets.ankle_rotation[robot, i] = frame * lies
        else:
            lies = lying(maps, robot, xy(place), landing, reach)
            frame = wp.transpose(rotation)
            targets.ankle[robot, i] = frame * (foot - lies * _SOLE - is_at)
            targets.ankle_rotation[robot, i] = frame * lies

    # Weight: the pendulum's ground force, which moves onto the stance foot within the first fifth of the step.
    share = wp.min(0.5 + 2.5 * done, 1.0)
    for i in range(2):
        weight = mass * GRAVITY * (share if i == stance else 1.0 - share)
        force = ground_force(gait, weight, com[robot] - targets.sole[robot, i])
        for k in range(6):
            arm = targets.sole[robot, i] - anchor[robot, 6 * i + k]
            targets.torque[robot, i, k] = -wp.dot(axis[robot, 6 * i + k], wp.cross(arm, force))

    targets.side[robot] = on
    targets.phase[robot] = done
    targets.com[robot] = at
    targets.com_velocity[robot] = moving
    targets.height[robot] = tall
    targets.heading[robot] = facing
    targets.swing[robot] = foot
    targets.foothold[robot] = place
    targets.ground[robot] = mean
