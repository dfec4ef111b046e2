"""Configuration of evaluation."""

from __future__ import annotations

from romnav.config import Config
from romnav.world.spec import SamplerSpec, WorldSpec


class EpisodeSetSpec(Config):
    """How a set of paired episodes is drawn (paper, Sec. IV-A)."""

    world: WorldSpec = WorldSpec(tiles=64, seed=1000, goals_per_tile=24)
    """Evaluation terrain, of another seed than training (P)."""
    episodes: int = 1024
    """Initial conditions, shared by all arms (P)."""
    sampler: SamplerSpec = SamplerSpec(stair_probability=0.0)
    """Spawns uniform over free cells off the stairs, where a humanoid can stand; goals as in training (A)."""
    seed: int = 1000
    """Seed of the draw."""


class EvaluationSpec(Config):
    """Evaluation of one arm."""

    episodes: str = "paired-1"
    """Episode set, a file under experiments/episodes/."""
    duration: float = 120.0
    """Longest episode, s (P); success within 45 s is read off the same episode."""
    reach: float = 0.5
    """Distance to the goal that is success, in 3D, m (P)."""
    threads: int = 1
    """PyTorch threads (A: another number gives other bits)."""
