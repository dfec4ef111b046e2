"""The reward table (paper, Table I), term by term."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Protocol

import torch
from torch import Tensor

from romnav.errors import RomnavError
from romnav.navigation.spec import REWARDS, RewardSpec


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


class Term(Protocol):
    """A reward term from outside."""

    def __call__(self, transition: Transition) -> Tensor:
        """Its unweighted value (E,)."""
        ...


def terms(t: Transition, spec: RewardSpec, period: float) -> dict[str, Tensor]:
    """Unweighted value of every term of the table and of those from outside, each (E,).

    Raises:
        RomnavError: One from outside gives something else.
    """
    gate = (t.geodesic < spec.gate).to(torch.float32)
    table = {
        "position": gate * (1.0 + torch.exp(-((t.planar / 0.5) ** 2)) + torch.exp(-((t.planar / 0.1) ** 2))),
        "heading": gate * torch.exp(-((t.heading_error / 0.5) ** 2)),
        "height": torch.exp(-((t.height_error / 2.5) ** 2)) + torch.exp(-((t.height_error / 0.5) ** 2)),
        "stand": gate * torch.exp(-t.command.square().sum(dim=1) / 0.1**2),
        "geodesic_progress": progress(t.best_geodesic, t.geodesic, spec.progress_speed * period, 0.8),
        "height_progress": progress(t.best_height_error, t.height_error, spec.climb_speed * period),
        "collision": t.contacts,
        "action_rate": (t.command - t.previous).square().sum(dim=1),
    }
    return table | {name: _outside(name, t) for name in spec.terms}


@cache
def _load(name: str) -> Term:
    term: Term = REWARDS.load(name)
    return term


def _outside(name: str, t: Transition) -> Tensor:
    value = _load(name)(t)
    if not isinstance(value, Tensor) or value.shape != t.planar.shape:
        given = f"shape {tuple(value.shape)}" if isinstance(value, Tensor) else type(value).__name__
        raise RomnavError(
            f"reward term {name}: gives {given}; it has to give a number for each of {len(t.planar)} robots"
        )
    return value.to(torch.float32)


def progress(best: Tensor, now: Tensor, full: float, share: float | None = None) -> Tensor:
    """Input-limited CLF progress (E,) in [0, 1]: pays only where ``now`` beats the episode's best.

    The full reward takes a decrease of ``full``, or of ``share`` of the remaining distance where that is less.
    """
    limit = full if share is None else (share * best).clamp(min=1e-6, max=full)
    return ((best - now) / limit).clamp(0.0, 1.0)


def weights(spec: RewardSpec, done: float) -> dict[str, float]:
    """Weight of every term once the share ``done`` of the run is behind, the common factor included."""
    late = done >= spec.action_rate_switch
    table = spec.model_dump() | {"action_rate": spec.action_rate[late]}
    if late and spec.collision_late is not None:
        table["collision"] = spec.collision_late
    named = {name: table[name] for name in TERMS} | spec.terms
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
