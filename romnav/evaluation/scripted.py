"""Scripted arms that bound every table from both sides."""

from __future__ import annotations

import torch
from torch import Tensor

from romnav.navigation.observations import rotate, wrap
from romnav.navigation.spec import CommandSpec

TURN_GAIN = 4.0
"""Turn rate per heading error, 1/s."""


def walk(direction: Tensor, yaw: Tensor, distance: Tensor, spec: CommandSpec, period: float) -> Tensor:
    """Command (E, 3) that walks along ``direction`` (E, 2; tile frame, unit) and turns to face it.

    ``distance`` (E,) left, m: the last step does not overshoot.
    """
    local = rotate(direction, yaw)
    error = wrap(torch.atan2(direction[:, 1], direction[:, 0]) - yaw)
    speed = torch.clamp(distance / period, max=spec.forward)
    forward = (local[:, 0] * speed).clamp(-spec.reverse, spec.forward)
    # the path bends sideways by no more than the lateral limit: turn on the spot where it would
    forward = torch.where(error.abs() > 0.7, torch.zeros_like(forward), forward)
    lateral = (local[:, 1] * speed).clamp(-spec.lateral, spec.lateral)
    turn = (TURN_GAIN * error).clamp(-spec.turn, spec.turn)
    return torch.stack([forward, lateral, turn], dim=1)


def straight_direction(position: Tensor, goal: Tensor) -> Tensor:
    """(E, 2) unit direction from ``position`` to ``goal``, both (E, 3), as if there were no obstacles."""
    return torch.nn.functional.normalize((goal - position)[:, :2], dim=1)
