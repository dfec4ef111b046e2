"""Left-right symmetry: observations, actions and what the critic knows, as the mirrored robot has them."""

from __future__ import annotations

import torch
from torch import Tensor

_LEG = ((0, 1), (1, -1), (2, -1), (3, 1), (4, 1), (5, -1))


def _legs_mirror() -> list[tuple[int, int]]:
    return [(6 + i, s) for i, s in _LEG] + [(i, s) for i, s in _LEG]


def _joints_mirror() -> list[tuple[int, int]]:
    return [*_legs_mirror(), (12, -1), (13, -1), (14, 1)]


def _mirror(*blocks: list[tuple[int, int]]) -> tuple[Tensor, Tensor]:
    index, sign, start = [], [], 0
    for block in blocks:
        index += [start + i for i, _ in block]
        sign += [s for _, s in block]
        start += len(block)
    return torch.tensor(index), torch.tensor(sign, dtype=torch.float32)


_FEET = [(3, 1), (4, -1), (5, 1), (0, 1), (1, -1), (2, 1)]
_SCAN_MIRROR = [(15 + i, 1) for i in range(15)] + [(i, 1) for i in range(15)]
_POLICY = (
    [(0, 1), (1, -1), (2, -1)], [(0, -1), (1, -1)], [(0, 1), (1, -1), (2, 1)], [(0, -1), (1, 1), (2, -1)],
    [(0, 1), (1, -1)], [(0, 1)], [(0, -1)], _joints_mirror(), _joints_mirror(), _joints_mirror(), _legs_mirror(),
    _FEET, _FEET, _SCAN_MIRROR,
)  # fmt: skip
MIRROR = _mirror(*_POLICY)
"""Index and sign of the observation of the mirrored state."""
ACTION_MIRROR = _mirror(_joints_mirror())
# Privileged: contacts of both feet, friction, payload, averaged velocity (3), V, unsigned outputs are left out.
PRIVILEGED_MIRROR = _mirror([(1, 1), (0, 1)], [(0, 1), (1, 1)], [(0, 1), (1, -1), (2, -1)], [(0, 1)])


def reflect(values: Tensor, table: tuple[Tensor, Tensor], side: Tensor) -> Tensor:
    """Rows of values (n, d) mirrored where `side` (n,) is negative."""
    index, sign = table
    return torch.where(side[:, None] < 0, values[:, index] * sign, values)
