"""A project with episodes for choices, and policies that were not trained."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

from romnav.evaluation import episodes
from romnav.evaluation.spec import EpisodeSetSpec
from romnav.experiment.workspace import Workspace
from romnav.navigation import checkpoint
from romnav.navigation.ppo import make_actor
from romnav.world.build import build
from romnav.world.spec import SamplerSpec, WorldSpec
from tests.experiment import conftest
from tests.navigation.conftest import TOKENS, FakePerception

ROOT = Path(__file__).parents[3]
SCALE = """
[world]
tiles = 4
[navigation.policy]
attention = 16
recurrent = 16
[evaluation]
duration = 4.0
"""


def policy(file: Path, work: Workspace, seed: int) -> None:
    torch.manual_seed(seed)
    navigation = work.arm_settings("rom").navigation
    obs = TensorDict({"lidar": torch.zeros(1, *TOKENS), "state": torch.zeros(1, 9)}, batch_size=[1])
    actor = make_actor(obs, navigation.policy)
    made = {"spec": navigation.model_dump_json(), "encoder": FakePerception().encoder.digest()}
    checkpoint.save(file, {**made, "actor": actor.state_dict(), "steps": 100 * seed, "hours": 0.1})


@pytest.fixture
def work(tmp_path: Path) -> Workspace:
    (tmp_path / "experiments" / "episodes").mkdir(parents=True)
    for name in ("spawn-goal", "deploy"):
        shutil.copy(ROOT / "experiments" / f"{name}.toml", tmp_path / "experiments")
    spec = EpisodeSetSpec(
        world=WorldSpec(tiles=2, seed=54, goals_per_tile=8),
        episodes=8,
        cross=4,
        sampler=SamplerSpec(stair_probability=0.0),
    )
    episodes.save(tmp_path / "experiments" / "episodes" / "dev.json", episodes.draw("dev", spec, build(spec.world)))
    return conftest.workspace(tmp_path, SCALE)
