"""The numbers that the paper states are those of the `paper` scale."""

from __future__ import annotations

from functools import reduce
from pathlib import Path
from typing import Any

import pytest

from romnav.evaluation.episodes import load
from romnav.evaluation.spec import HORIZONS
from romnav.experiment.project import Project
from romnav.experiment.workspace import Workspace
from tests.navigation.test_rewards import PAPER

ROOT = Path(__file__).parents[1]
STATED: dict[str, Any] = {
    # Sec. III-A
    "pretrain.images": 2_000_000,
    "pretrain.epochs": 10,
    "pretrain.corruption.dropout": (0.0, 0.8),
    # Sec. III-B
    "depth.rows": 26,
    "depth.columns": 30,
    "navigation.policy.queries": 4,
    # Sec. III-C
    "navigation.env.envs": 4096,
    "navigation.ppo.iterations": 2000,
    "navigation.ppo.minibatches": 8,
    "navigation.ppo.guidance": 0.0,
    # Sec. III-D
    "lidar.azimuth": 220.0,
    "lidar.columns": 220,
    "lidar.rows": 59,
    "world.grid.cell": 0.2,
    "navigation.env.period": 0.2,
    "navigation.env.duration": 45.0,
    "navigation.env.reach": 0.5,
    "navigation.env.command.forward": 1.0,
    "navigation.env.command.lateral": 0.25,
    "navigation.env.command.turn": 1.0,
    "navigation.env.sampler.stair_probability": 0.3,
    "navigation.env.sampler.max_distance": 30.0,
    "navigation.env.sampler.cap": "geodesic",
    **{f"navigation.env.reward.{term}": weight for term, weight in PAPER.items()},
    "navigation.env.reward.action_rate": (-0.01, -0.1),
    "navigation.env.reward.gate": 2.0,
    # Sec. III-E
    "safety.filter.filter.alpha": 0.75,
    "safety.filter.occupancy.cell": 0.05,
}


@pytest.fixture(scope="module")
def work() -> Workspace:
    return Workspace(Project(ROOT, ROOT / "results"), "paper")


def value(settings: Any, key: str) -> Any:
    return reduce(getattr, key.split("."), settings)


@pytest.mark.parametrize("key", STATED)
def test_the_paper_scale_has_the_papers_number(work: Workspace, key: str) -> None:
    assert value(work.settings, key) == STATED[key]
    assert value(work.arm_settings("rom"), key) == STATED[key]


def test_what_changes_along_a_run_does_so_at_the_papers_iteration(work: Workspace) -> None:
    navigation = work.settings.navigation
    assert navigation.env.reward.action_rate_switch * navigation.ppo.iterations == 1000
    assert work.arm_settings("unfrozen").navigation.encoder.unfreeze_at * navigation.ppo.iterations == 1000
    taught = work.arm_settings("rom-nav")
    assert taught.kickstart is not None
    weight, iterations = taught.kickstart.weight, taught.navigation.ppo.iterations
    for iteration, expected in ((0, 1.0), (100, 1.0), (600, 0.525), (1100, 0.05), (2000, 0.05)):
        assert weight(iteration / iterations) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("arm", "probability", "cap"),
    [
        ("rom", 0.3, "geodesic"),
        ("uniform", 0.0, "geodesic"),
        ("nocap", 0.3, "euclidean"),
        ("uniform-nocap", 0.0, "euclidean"),
    ],
)
def test_the_arms_of_spawns_and_goals(work: Workspace, arm: str, probability: float, cap: str) -> None:
    sampler = work.arm_settings(arm).navigation.env.sampler
    assert (sampler.stair_probability, sampler.cap) == (probability, cap)


def test_the_encoder_ablation_has_fewer_environments_and_more_minibatches(work: Workspace) -> None:
    for arm in ("frozen", "unfrozen", "scratch"):
        navigation = work.arm_settings(arm).navigation
        assert (navigation.env.envs, navigation.ppo.minibatches) == (3072, 16)
    assert work.project.experiment("pretrain").seeds == (0, 1, 2, 3, 4)


def test_single_stage_takes_as_many_iterations_as_both_stages(work: Workspace) -> None:
    ppo = work.arm_settings("single-stage").navigation.ppo
    assert ppo.stages * ppo.iterations == 4000


def test_evaluation_is_on_as_many_episodes_within_the_papers_times(work: Workspace) -> None:
    episodes = load(ROOT / "experiments" / "episodes" / f"{work.settings.evaluation.episodes}.json")
    assert len(episodes) == 1024
    assert HORIZONS == (45.0, 120.0)
    assert episodes.world.seed != work.settings.world.seed
