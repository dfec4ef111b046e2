"""How hard a world is: how far and how high its goals lie, how often across levels, what scripted arms make of them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from romnav.evaluation import episodes
from romnav.evaluation.paired.run import run
from romnav.evaluation.rollout import SCRIPTED
from romnav.evaluation.spec import EvaluationSpec
from romnav.navigation.spec import EnvSpec
from romnav.world.spawns import Start, is_cross_level, sample
from romnav.world.spec import SamplerSpec
from romnav.world.world import STOREY, TWO_STOREYS, World

DRAWS, EPISODES = 20_000, 512
"""Draws of each sampler, and episodes of each scripted arm: shares are within a percent, rates within some."""


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


@dataclass(frozen=True)
class Difficulty:
    """What there is to learn in a world."""

    goals: dict[str, Goals]
    """Draws by sampler."""
    oracle_t2g: float | None
    """Mean time in which the oracle reaches goals of the first sampler, s; None if it reaches none."""
    straight_sr_120_same: float | None
    """Share of its goals on one level that walking straight towards them reaches, percent; None if there are none."""


def measure(world: World, samplers: Mapping[str, SamplerSpec], env: EnvSpec, spec: EvaluationSpec) -> Difficulty:
    """Draw from every sampler, and let the scripted arms walk episodes of the first on the reduced-order model."""
    first = next(iter(samplers.values()))
    walked = episodes.of("difficulty", world, _draw(world, first, EPISODES))
    oracle, straight = (run(SCRIPTED[k](), world, walked, env, spec) for k in ("oracle", "straight"))
    time, same = oracle["success_time"], straight["outcome"][~walked.cross] == "success"
    return Difficulty(
        goals={name: draw_goals(world, sampler, DRAWS) for name, sampler in samplers.items()},
        oracle_t2g=None if np.isnan(time).all() else float(np.nanmean(time)),
        straight_sr_120_same=float(100.0 * same.mean()) if len(same) else None,
    )


def draw_goals(world: World, sampler: SamplerSpec, count: int, seed: int = 0) -> Goals:
    """``count`` draws on the tiles of ``world`` in turn."""
    start = _draw(world, sampler, count, seed)
    node = world.node_at(start.tile, start.layer, start.xy)
    z = world.position[node, 2], world.position[world.goal[start.goal], 2]
    return Goals(
        geodesic=episodes.geodesic(world, start).numpy(),
        climb=(z[0] - z[1]).abs().double().numpy(),
        cross=is_cross_level(*z).numpy(),
        on_connector=torch.isin(node, world.spawn).numpy(),
    )


def tally(world: World) -> dict[str, Any]:
    """What a world consists of, and what it took: seconds, and megabytes of its tensors."""
    return {
        "tiles": dict(Counter(str(tile.kind) for tile in world.tiles)),
        "solids": sum(len(tile.solids) for tile in world.tiles),
        "nodes": len(world.position),
        "goals": len(world.goal),
        "draws_per_tile": sum(tile.draws for tile in world.tiles) / len(world.tiles),
        "build_s": world.seconds,
        "memory_mb": sum(v.nbytes for v in vars(world).values() if isinstance(v, torch.Tensor)) / 1e6,
    }


def _draw(world: World, sampler: SamplerSpec, count: int, seed: int = 0) -> Start:
    draw = torch.arange(count)
    spec = sampler.model_copy(update={"stair_probability": 0.0})
    return sample(world, spec, seed, draw % len(world.tiles), draw, torch.zeros_like(draw))
