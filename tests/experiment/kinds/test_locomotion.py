"""Robots walk on the locomotion policy of their scale."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from romnav.errors import RomnavError
from romnav.experiment.graph.run import execute, pending
from romnav.experiment.graph.stage import Session
from romnav.experiment.kinds.episodes import episodes
from romnav.experiment.kinds.locomotion import body, gaits, locomotion
from romnav.experiment.scales import Scale
from romnav.robot.gaits import GaitLibrary
from romnav.robot.humanoid import Humanoid
from romnav.world.build import build
from romnav.world.spawns import sample
from romnav.world.spec import SamplerSpec
from tests.experiment.conftest import workspace

ARMS = """
kind = "ablation"
title = "t"
[arms.walked]
label = "Oracle on the G1"
policy = "oracle"
navigation.dynamics = "g1"
"""


def test_the_humanoid_walks_on_the_locomotion_policy_of_its_scale(tmp_path: Path) -> None:
    here = workspace(
        tmp_path,
        "[world]\ntiles = 2\ngoals_per_tile = 2\n[locomotion]\niterations = 1\n"
        "[locomotion.task]\nrobots = 4\nshares = {flat = 1.0}\n[locomotion.ppo]\nsteps = 2\nminibatches = 1\n",
    )
    here.project.file("humanoid").write_text(ARMS)
    settings = episodes(here, "walked", 0).settings
    assert isinstance(settings, Scale)
    with pytest.raises(RomnavError, match=r"gaits\.pt: no such gait library; record one with `romnav train gaits`"):
        body(here, settings, 0, "cpu", 1)
    execute(pending([locomotion(here)]), Session())
    GaitLibrary([]).save(gaits(here).folder / "gaits.pt")
    world = build(here.settings.world)
    robots = body(here, settings, 0, "cpu", 1)(world, 2, 0.2)
    robots.reset(
        torch.arange(2), sample(world, SamplerSpec(), 0, torch.arange(2), torch.arange(2), torch.zeros(2).long())
    )
    robots.step(torch.zeros(2, 3))
    assert isinstance(robots, Humanoid)
    assert not robots.fallen.any()
    with pytest.raises(RomnavError, match="no physics engine on cuda"):
        body(here, settings, 0, "cuda", 1)
