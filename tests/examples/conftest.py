"""A project with the example of parts from outside."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from romnav.experiment.project import Project
from romnav.experiment.workspace import Workspace
from tests.deploy.conftest import exported as exported

ROOT = Path(__file__).parents[2]
SCALE = """
[world]
tiles = 2
side = 20.0
goals_per_tile = 8
[navigation.env]
envs = 8
duration = 4.0
[navigation.policy]
attention = 16
recurrent = 16
hidden = 16
critic = [16]
[navigation.ppo]
iterations = 1
steps = 4
epochs = 1
minibatches = 2
"""


@pytest.fixture(scope="session")
def work(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    root = tmp_path_factory.mktemp("parts")
    (root / "experiments" / "scales").mkdir(parents=True)
    (root / "experiments" / "scales" / "smoke.toml").write_text(SCALE)
    shutil.copy(ROOT / "examples" / "parts.toml", root / "experiments")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(ROOT)
        patch.chdir(root)
        return Workspace(Project.here(), "smoke")
