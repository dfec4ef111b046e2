"""Shared fixtures."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from romnav.evaluation import rows


def _episode_rows(
    arm: str = "rom", skill: float = 0.7, seed: int = 0, n: int = 64, draw: int = 0, **provenance: object
) -> rows.EpisodeRows:
    """Rows of an arm that solves an episode with probability `skill`, less across levels."""
    episode = np.random.default_rng(n)  # the episodes depend on their number alone, as in a paired set
    luck = np.random.default_rng([draw, seed, *arm.encode()])
    level = np.where(episode.random(n) < 0.5, "same", "cross")
    geodesic = episode.uniform(1, 30, n)
    poses = {name: episode.normal(size=n) for name in rows.SCHEMA.names if name.startswith(("spawn", "goal"))}
    solved = luck.random(n) < skill * np.where(level == "cross", 0.6, 1.0)
    time = np.minimum(geodesic * luck.uniform(1, 5, n), 120.0)
    outcome = np.where(solved, "success", np.where(luck.random(n) < 0.5, "fall", "timeout"))
    columns = {
        "arm": np.full(n, arm),
        "seed": np.full(n, seed),
        "episode": np.arange(n),
        "tile": np.arange(n) // 8,
        "tile_class": np.array(rows.TILE_CLASSES)[np.arange(n) % 3],
        "multi_story": np.arange(n) % 3 == 2,
        **poses,
        "geodesic": geodesic,
        "level": level,
        "success_time": np.where(solved, time, np.nan),
        "outcome": outcome,
        "time": np.where(outcome == "timeout", 120.0, time),
        "path_length": geodesic * luck.uniform(0.9, 2.0, n),
        "final_distance": np.where(solved, 0.3, geodesic * luck.uniform(0, 2, n)),
        "collisions": luck.poisson(1.0, n),
    }
    made = {
        "scale": "smoke",
        "commit": "0123456789abcdef",
        "spec_hash": "spec",
        "checkpoint_sha256": "f00d",
        "episode_set": "feedc0ffee123456",
        "version": "0.1.0",
        "steps": 1_500_000,
        "hours": 0.2,
        "machine": "2 cores",
    }
    return rows.make(columns, rows.Provenance(**{**made, **provenance}), source=f"{arm}/seed-{seed}")


@pytest.fixture(scope="session")
def episode_rows() -> Callable[..., rows.EpisodeRows]:
    """Factory of synthetic episode rows."""
    return _episode_rows
