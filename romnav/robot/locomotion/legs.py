"""Kinematics of the G1's legs, batched: forward, and inverse by damped Gauss-Newton."""

from __future__ import annotations

import mujoco
import torch
from torch import Tensor

from romnav.kernels import wp
from romnav.robot.g1 import LEG, SIDES
from romnav.robot.locomotion.inverse import Six, gauss_newton

STRAIGHT = 0.15
"""Knee angle of the longest leg that the inverse kinematics asks for, rad: short of the singularity."""


def rotation(axis: int, angle: Tensor) -> Tensor:
    """Rotation matrices (..., 3, 3) about coordinate axis 0, 1 or 2."""
    c, s = torch.cos(angle), torch.sin(angle)
    matrix = torch.zeros(*angle.shape, 3, 3, dtype=angle.dtype)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix[..., axis, axis] = 1.0
    matrix[..., i, i], matrix[..., i, j] = c, -s
    matrix[..., j, i], matrix[..., j, j] = s, c
    return matrix


class Legs:
    """Both legs from the pelvis to the ankle-roll bodies, with the geometry of a compiled model.

    Joint angles are (n, 2, 6), left and right, in the order of `romnav.robot.g1.LEG`; poses are in the pelvis
    frame, metres.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        offset, fixed, limits = [], [], []
        axes: list[int] = []
        for side in SIDES:
            bodies = [model.body(f"{side}_{'knee_link' if j == 'knee' else j + '_link'}") for j in LEG]
            joints = [model.joint(f"{side}_{j}_joint") for j in LEG]
            offset.append([b.pos.tolist() for b in bodies])
            matrices = torch.zeros(6, 9, dtype=torch.float64)
            for matrix, body in zip(matrices.numpy(), bodies, strict=True):
                mujoco.mju_quat2Mat(matrix, body.quat)
            fixed.append(matrices.reshape(6, 3, 3))
            limits.append([j.range.tolist() for j in joints])
            axes = [int(j.axis.argmax()) for j in joints]
        # Each joint's transform is fixed + sin(q) first + (1 - cos(q)) second (Rodrigues), from parent to child.
        cross = torch.zeros(6, 3, 3)
        for k, axis in enumerate(axes):
            i, j = (axis + 1) % 3, (axis + 2) % 3
            cross[k, i, j], cross[k, j, i] = -1.0, 1.0
        turn = torch.stack(fixed).float()
        self._fixed = torch.eye(4).repeat(2, 6, 1, 1)
        self._fixed[..., :3, :3] = turn
        self._fixed[..., :3, 3] = torch.tensor(offset, dtype=torch.float32)
        self._first, self._second = torch.zeros(2, 6, 4, 4), torch.zeros(2, 6, 4, 4)
        self._first[..., :3, :3] = turn @ cross
        self._second[..., :3, :3] = turn @ cross @ cross
        self._axis = torch.eye(4)[axes][..., None]
        self.limits = torch.tensor(limits, dtype=torch.float32)
        straight = torch.tensor([0.0, 0.0, 0.0, STRAIGHT, 0.0, 0.0]).expand(1, 2, 6)
        reach = (self.forward(straight)[0] - self._fixed[:, 0, :3, 3]).norm(dim=-1)[0]
        self._chain = [
            wp.from_torch(self._fixed, dtype=wp.mat44),
            wp.from_torch(torch.tensor(axes, dtype=torch.int32)),
            wp.from_torch(self.limits, dtype=wp.vec2),
            wp.from_torch(reach),
        ]

    def forward(self, joints: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Ankle position (n, 2, 3), rotation (n, 2, 3, 3) and the Jacobian (n, 2, 6, 6) of (position, rotation)."""
        s, c = torch.sin(joints)[..., None, None], torch.cos(joints)[..., None, None]
        local = self._fixed + s * self._first + (1.0 - c) * self._second
        frames = [local[:, :, 0]]
        for k in range(1, 6):
            frames.append(frames[-1] @ local[:, :, k])
        chain = torch.stack(frames, dim=2)
        # A joint turns about its own axis: the child's frame has the axis where the parent's has it.
        axes = (chain @ self._axis)[..., :3, 0]
        anchors, end = chain[..., :3, 3], chain[:, :, -1, :3, 3]
        jacobian = torch.cat([torch.linalg.cross(axes, end[:, :, None] - anchors), axes], dim=-1)
        return end, chain[:, :, -1, :3, :3], jacobian.transpose(-1, -2)

    def inverse(
        self, position: Tensor, turn: Tensor, start: Tensor, *, iterations: int = 2, damping: float = 2e-4
    ) -> Tensor:
        """Joint angles that bring the ankles to a pose, within the joint limits.

        Args:
            position: (n, 2, 3).
            turn: (n, 2, 3, 3).
            start: (n, 2, 6) first guess; from the last control step two iterations are exact to a millimetre.
            iterations: Gauss-Newton steps.
            damping: Levenberg weight.
        """
        joints = start.clone(memory_format=torch.contiguous_format)
        inputs = [
            wp.from_torch(position.contiguous(), dtype=wp.vec3),
            wp.from_torch(turn.contiguous(), dtype=wp.mat33),
            *self._chain,
            iterations,
            damping,
        ]
        wp.launch(gauss_newton, joints.shape[:2], inputs, [wp.from_torch(joints, dtype=Six)], device="cpu")
        return joints
