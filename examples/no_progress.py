"""A reward term: every step that comes no nearer to the goal than the episode ever was costs something."""

from __future__ import annotations

from torch import Tensor

from romnav.navigation.rewards import Transition


def no_progress(transition: Transition) -> Tensor:
    """1 where the geodesic distance is no new best, else 0; (E,)."""
    return (transition.geodesic >= transition.best_geodesic).float()
