"""Configuration of evaluation."""

from __future__ import annotations

import math
from typing import Self

from pydantic import Field, model_validator

from romnav.config import Config, Count, Name, Positive, Seed, Threads
from romnav.parts import Kind
from romnav.robot.spec import BodySpec
from romnav.safety.spec import SafetySpec
from romnav.sensing.spec import CorruptionSpec, LidarSpec
from romnav.world.spec import SamplerSpec, WorldSpec

ROWS_VERSION = 2
"""Of the schema of episode rows; rows of an earlier one are out of date."""
HORIZONS = (45, 120)
"""Evaluation horizons, s (paper, Sec. IV-A): the training budget, and the end of an episode."""
METRICS = Kind("metric", "romnav.metrics", "romnav.evaluation.paired.metrics:Measure")


class EpisodeSetSpec(Config):
    """How a set of paired episodes is drawn (paper, Sec. IV-A)."""

    world: WorldSpec = WorldSpec(tiles=64, seed=3000, goals_per_tile=32)
    """Evaluation terrain, of another seed than training (P)."""
    episodes: Count = 1024
    """Initial conditions, shared by all arms (P)."""
    cross: int = 488
    """Of them across levels (P, derived: the paper's contrasts and totals fit no other share)."""
    sampler: SamplerSpec = SamplerSpec(stair_probability=0.0)
    """Spawns uniform over free cells off stairs and mouths, where a humanoid can stand; goals as in training (A)."""
    seed: Seed = 3000
    """Seed of the draw."""

    @model_validator(mode="after")
    def _part_of_the_episodes(self) -> Self:
        if not 0 <= self.cross <= self.episodes:
            raise ValueError(f"cross: {self.cross} of {self.episodes} episodes; set it between 0 and 'episodes'")
        return self


class EvaluationSpec(Config):
    """Evaluation of one arm."""

    episodes: Name = "paired-2"
    """Episode set, a file under experiments/episodes/."""
    duration: float = Field(default=120.0, gt=0.0, le=HORIZONS[-1])
    """Longest episode, s (P); success within 45 s is read off the same episode."""
    reach: Positive = 0.5
    """Distance to the goal that is success, m (P; A: in 3D, or a goal would be reached from another floor)."""
    threads: Threads = 1
    """PyTorch threads (A: another number gives other bits)."""


class TrialSpec(Config):
    """Trials of one arm in scenes, with the safety filter off and on."""

    trials: Count = 256
    """Starts and goals in each scene, shared by all arms (A: an interval of a few percent)."""
    duration: Positive = 60.0
    """Longest trial, s (A: several times what the paper's trials took)."""
    reach: Positive = 0.5
    """Distance to the goal that is success, m (P; A: in 3D, or a goal would be reached from another floor)."""
    heading: float = Field(default=math.pi / 4, ge=0.0, le=math.pi)
    """Largest angle at the start between heading and shortest path, rad (A)."""
    seed: Seed = 1000
    """Seed of starts, goals and sensor noise."""
    body: BodySpec = BodySpec()
    """Of arms on the reduced-order model; those on the humanoid have its own."""
    filter: SafetySpec = SafetySpec()
    sensor: LidarSpec = LidarSpec()
    """What the filter sees, at the paper's resolution whatever the policy's; the mount is the robot's."""
    corruption: CorruptionSpec = CorruptionSpec(dropout=(0.0, 0.1))
    """What is done to the filter's range images (A: as to the policy's)."""
    threads: Threads = 1
    """PyTorch threads (A: another number gives other bits)."""


class DeploymentSpec(TrialSpec):
    """Trials in the deployments."""

    trials: Count = 64
    """Starts in each deployment, shared by all arms (A)."""
    duration: Positive = 240.0
    """Longest trial, s (A: at half of the top speed, 100 m take 200 s)."""
