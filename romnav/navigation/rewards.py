"""The reward table (paper, Table I), term by term."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from romnav.navigation.spec import RewardSpec


@dataclass(frozen=True)
class Transition:
    """Quantities of one step that the rewards read, each (E,) unless said; metres, radians, seconds."""

    planar: Tensor
    """d_xy: planar distance to the goal."""
    geodesic: Tensor
    """d_geo: geodesic distance to the goal."""
    best_geodesic: Tensor
    """Least d_geo of the episode before this step."""
    heading_error: Tensor
    """e_psi: goal heading minus heading, wrapped."""
    height_error: Tensor
    """|z_e|: vertical distance to the goal."""
    best_height_error: Tensor
    """Least |z_e| of the episode before this step."""
    command: Tensor
    """(E, 3) a_t: commanded velocity."""
    previous: Tensor
    """(E, 3) a_{t-1}."""
    contacts: Tensor
    """Bodies in contact."""


def terms(t: Transition, spec: RewardSpec, period: float) -> dict[str, Tensor]:
    """Unweighted value of every term of the table, each (E,)."""
    gate = (t.geodesic < spec.gate).to(torch.float32)
    return {
        "position": gate * (1.0 + torch.exp(-((t.planar / 0.5) ** 2)) + torch.exp(-((t.planar / 0.1) ** 2))),
        "heading": gate * torch.exp(-((t.heading_error / 0.5) ** 2)),
        "height": torch.exp(-((t.height_error / 2.5) ** 2)) + torch.exp(-((t.height_error / 0.5) ** 2)),
        "stand": gate * torch.exp(-t.command.square().sum(dim=1) / 0.1**2),
        "geodesic_progress": progress(t.best_geodesic, t.geodesic, spec.progress_speed * period, 0.8),
        "height_progress": progress(t.best_height_error, t.height_error, spec.climb_speed * period),
        "collision": t.contacts,
        "action_rate": (t.command - t.previous).square().sum(dim=1),
    }


def progress(best: Tensor, now: Tensor, full: float, share: float | None = None) -> Tensor:
    """Input-limited CLF progress (E,) in [0, 1]: pays only where ``now`` beats the episode's best.

    The full reward takes a decrease of ``full``, or of ``share`` of the remaining distance where that is less.
    """
    limit = full if share is None else (share * best).clamp(min=1e-6, max=full)
    return ((best - now) / limit).clamp(0.0, 1.0)


def weights(spec: RewardSpec, done: float) -> dict[str, float]:
    """Weight of every term once the share ``done`` of the run is behind, the common factor included."""
    before, after = spec.action_rate
    table = spec.model_dump()
    named = {name: table[name] for name in TERMS if name != "action_rate"}
    named["action_rate"] = after if done >= spec.action_rate_switch else before
    return {name: spec.scale * weight for name, weight in named.items()}


TERMS = (
    "position",
    "heading",
    "height",
    "stand",
    "geodesic_progress",
    "height_progress",
    "collision",
    "action_rate",
)
