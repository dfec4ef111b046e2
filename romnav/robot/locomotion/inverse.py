"""Inverse kinematics of the legs by damped Gauss-Newton steps, one Warp kernel for all of them."""

from __future__ import annotations

from romnav.kernels import wp

Six = wp.types.vector(length=6, dtype=float)
Square = wp.types.matrix(shape=(6, 6), dtype=float)
Rows = wp.types.matrix(shape=(6, 3), dtype=float)

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


@wp.func
def _solve(matrix: Square, right: Six):
    """Solution of a symmetric positive definite system, by Cholesky's decomposition."""
    low = Square()
    for i in range(6):
        for j in range(i + 1):
            part = matrix[i, j]
            for k in range(j):
                part -= low[i, k] * low[j, k]
            if i == j:
                low[i, i] = wp.sqrt(part)
            else:
                low[i, j] = part / low[j, j]
    x = Six()
    for i in range(6):
        part = right[i]
        for k in range(i):
            part -= low[i, k] * x[k]
        x[i] = part / low[i, i]
    for back in range(6):
        i = 5 - back
        part = x[i]
        for k in range(i + 1, 6):
            part -= low[k, i] * x[k]
        x[i] = part / low[i, i]
    return x


@wp.kernel
def gauss_newton(
    position: wp.array2d(dtype=wp.vec3),
    turn: wp.array2d(dtype=wp.mat33),
    fixed: wp.array2d(dtype=wp.mat44),
    axes: wp.array(dtype=int),
    limits: wp.array2d(dtype=wp.vec2),
    reach: wp.array(dtype=float),
    iterations: int,
    damping: float,
    joints: wp.array2d(dtype=Six),
):
    robot, side = wp.tid()
    wanted = turn[robot, side]
    # Beyond the reach of the leg Gauss-Newton swings to and fro: shorten the way to the hip first.
    first = fixed[side, 0]
    hip = wp.vec3(first[0, 3], first[1, 3], first[2, 3])
    leg = position[robot, side] - hip
    target = hip + leg * wp.min(reach[side] / wp.length(leg), 1.0)
    q = joints[robot, side]
    for _ in range(iterations):
        at = wp.vec3()
        frame = wp.identity(n=3, dtype=float)
        anchors = Rows()
        directions = Rows()
        for k in range(6):
            local = fixed[side, k]
            at += frame * wp.vec3(local[0, 3], local[1, 3], local[2, 3])
            unit = wp.vec3()
            unit[axes[k]] = 1.0
            mount = wp.mat33(
                local[0, 0], local[0, 1], local[0, 2], local[1, 0], local[1, 1], local[1, 2],
                local[2, 0], local[2, 1], local[2, 2],
            )  # fmt: skip
            frame = frame * mount * wp.quat_to_matrix(wp.quat_from_axis_angle(unit, q[k]))
            # A joint turns about its own axis: the child's frame has the axis where the parent's has it.
            direction = frame * unit
            for i in range(3):
                anchors[k, i] = at[i]
                directions[k, i] = direction[i]
        # Rotation error as a vector: half the sum of the cross products of the axes.
        twist = wp.vec3()
        for i in range(3):
            mine = wp.vec3(frame[0, i], frame[1, i], frame[2, i])
            twist += 0.5 * wp.cross(mine, wp.vec3(wanted[0, i], wanted[1, i], wanted[2, i]))
        error = Six()
        for i in range(3):
            error[i] = target[i] - at[i]
            error[3 + i] = twist[i]
        jacobian = Square()
        for k in range(6):
            direction = wp.vec3(directions[k, 0], directions[k, 1], directions[k, 2])
            lever = at - wp.vec3(anchors[k, 0], anchors[k, 1], anchors[k, 2])
            moves = wp.cross(direction, lever)
            for i in range(3):
                jacobian[i, k] = moves[i]
                jacobian[3 + i, k] = direction[i]
        transposed = wp.transpose(jacobian)
        normal = transposed * jacobian
        for i in range(6):
            normal[i, i] = normal[i, i] + damping
        step = _solve(normal, transposed * error)
        for i in range(6):
            limit = limits[side, i]
            q[i] = wp.clamp(q[i] + wp.clamp(step[i], -0.5, 0.5), limit[0], limit[1])
    joints[robot, side] = q
