"""What the locomotion policy observes: one Warp kernel, a robot each thread."""

from __future__ import annotations

from romnav.kernels import wp
from romnav.robot.heights import Maps, highest
from romnav.robot.locomotion.lip import turned, wrap
from romnav.robot.locomotion.reference import Targets, xy, yaw_of

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


@wp.struct
class Row:
    """Where the observation of a robot goes.

    Attributes:
        seen: (n, d).
        index, sign: (d,) of the mirrored robot's observation.
        mirrored: whether to write that.
    """

    seen: wp.array2d(dtype=float)
    index: wp.array(dtype=wp.int64)
    sign: wp.array(dtype=float)
    mirrored: bool


@wp.func
def _put(row: Row, robot: int, column: int, value: float):
    """Write a number, and return the next column."""
    if row.mirrored:
        row.seen[robot, int(row.index[column])] = row.sign[column] * value
    else:
        row.seen[robot, column] = value
    return column + 1


@wp.func
def _put_vector(row: Row, robot: int, column: int, vector: wp.vec3):
    for i in range(3):
        column = _put(row, robot, column, vector[i])
    return column


@wp.func
def _from(vector: wp.vec3, yaw: float):
    """A vector in the heading frame."""
    flat = turned(xy(vector), -yaw)
    return wp.vec3(flat[0], flat[1], vector[2])


@wp.kernel
def observe(
    maps: Maps,
    targets: Targets,
    command: wp.array(dtype=wp.vec3),
    pelvis: wp.array(dtype=wp.vec3),
    body: wp.array(dtype=wp.mat33),
    spin: wp.array(dtype=wp.vec3),
    com_velocity: wp.array(dtype=wp.vec3),
    joints: wp.array2d(dtype=float),
    joint_velocity: wp.array2d(dtype=float),
    action: wp.array2d(dtype=float),
    asked: wp.array2d(dtype=float),
    rest: wp.array(dtype=float),
    scan: wp.array(dtype=wp.vec2),
    index: wp.array(dtype=wp.int64),
    sign: wp.array(dtype=float),
    seen: wp.array2d(dtype=float),
):
    robot = wp.tid()
    row = Row()
    row.seen = seen
    row.index = index
    row.sign = sign
    row.mirrored = targets.side[robot] < 0.0
    yaw = yaw_of(body[robot])
    at = pelvis[robot]

    c = _put_vector(row, robot, 0, command[robot])
    angle = wp.PI * (targets.phase[robot] + wp.where(row.mirrored, 1.0, 0.0))
    c = _put(row, robot, c, wp.sin(angle))
    c = _put(row, robot, c, wp.cos(angle))
    down = body[robot]
    c = _put_vector(row, robot, c, wp.vec3(down[2, 0], down[2, 1], down[2, 2]))
    c = _put_vector(row, robot, c, 0.25 * spin[robot])
    velocity = _from(com_velocity[robot], yaw)
    c = _put(row, robot, c, velocity[0])
    c = _put(row, robot, c, velocity[1])
    c = _put(row, robot, c, 5.0 * (at[2] - targets.height[robot]))
    c = _put(row, robot, c, wrap(targets.heading[robot] - yaw))
    for k in range(joints.shape[1]):
        c = _put(row, robot, c, joints[robot, k] - rest[k])
    for k in range(joints.shape[1]):
        c = _put(row, robot, c, 0.05 * joint_velocity[robot, k])
    for k in range(joints.shape[1]):
        c = _put(row, robot, c, action[robot, k])
    for k in range(asked.shape[1]):
        c = _put(row, robot, c, asked[robot, k] - rest[k])
    for i in range(2):
        c = _put_vector(row, robot, c, _from(targets.sole[robot, i] - at, yaw))
    for i in range(2):
        # the stance foot is where it is to be
        way = wp.vec3()
        if (i == 0) == row.mirrored:
            way = targets.foothold[robot] - targets.sole[robot, i]
        c = _put_vector(row, robot, c, _from(way, yaw))
    level = wp.min(targets.sole[robot, 0][2], targets.sole[robot, 1][2])
    for k in range(scan.shape[0]):
        height = highest(maps, robot, xy(at) + turned(scan[k], yaw), level + 0.8)
        c = _put(row, robot, c, wp.clamp(height - level, -1.0, 1.0))
