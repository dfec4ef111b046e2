"""How hard a world is for each sampler: how far goals lie, how high, how often across levels (paper, Sec. III-D)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from romnav.world.geodesic import UNIT
from romnav.world.spawns import is_cross_level, sample
from romnav.world.spec import SamplerSpec
from romnav.world.world import World

STOREY, TWO_STOREYS = 3.5, 7.5
"""Least climb that counts as one storey and as two, m."""


@dataclass(frozen=True)
class Goals:
    """``n`` draws of one sampler, with spawns uniform over free cells whatever its share of stair spawns."""

    geodesic: NDArray[np.float64]
    """(n,) shortest path, m."""
    climb: NDArray[np.float64]
    """(n,) height between start and goal, m."""
    cross: NDArray[np.bool_]
    """(n,) whether they lie on different levels."""
    on_connector: NDArray[np.bool_]
    """(n,) whether the start lies on a stair or ramp, or at its mouth."""

    def shares(self) -> dict[str, float]:
        """What tells worlds apart: mean path, m, and shares from 0 to 1.

        All but ``cross_share`` and ``on_connector`` are shares of the goals across levels.
        """

        def share(chosen: NDArray[np.bool_]) -> float:
            return float(chosen.mean()) if len(chosen) else 0.0

        climb, geodesic = self.climb[self.cross], self.geodesic[self.cross]
        return {
            "mean_geodesic": float(self.geodesic.mean()),
            "cross_share": share(self.cross),
            "storey_share": share(climb >= STOREY),
            "two_storey_share": share(climb >= TWO_STOREYS),
            "beyond_30": share(geodesic > 30.0),
            "beyond_45": share(geodesic > 45.0),
            "on_connector": share(self.on_connector),
        }


def draw_goals(world: World, sampler: SamplerSpec, count: int, seed: int = 0) -> Goals:
    """``count`` draws on the tiles of ``world`` in turn."""
    draw = torch.arange(count)
    spec = sampler.model_copy(update={"stair_probability": 0.0})
    start = sample(world, spec, seed, draw % len(world.tiles), draw, torch.zeros_like(draw))
    node = world.node_at(start.tile, start.layer, start.xy)
    goal = world.goal[start.goal]
    offset = world.field_start[start.goal] + node - world.node_start[start.tile]
    z = world.position[node, 2], world.position[goal, 2]
    return Goals(
        geodesic=world.fields[offset].to(torch.float64).numpy() * UNIT,
        climb=(z[0] - z[1]).abs().double().numpy(),
        cross=is_cross_level(*z).numpy(),
        on_connector=torch.isin(node, world.spawn).numpy(),
    )
