"""The encoder's stages on real parts: trained, then judged on tiles that it was not trained on."""

from __future__ import annotations

import json
from pathlib import Path

import matplotlib.image
import pytest
import torch

from romnav.errors import RomnavError
from romnav.experiment import store
from romnav.experiment.plan import Plan
from romnav.experiment.project import Project
from romnav.experiment.run import execute, pending
from romnav.experiment.scales import ScaleFile
from romnav.experiment.stages import Stages
from romnav.robot.gaits import GaitLibrary
from romnav.robot.humanoid import Humanoid
from romnav.sensing.encoder import load
from romnav.world.spawns import sample
from romnav.world.spec import SamplerSpec

SCALE = """
[world]
tiles = 3
goals_per_tile = 2
[lidar]
rows = 15
columns = 55
[pretrain]
images = 64
epochs = 1
[pretrain_depth]
images = 64
epochs = 1
[quality]
images = 32
tiles = 4
"""


def plan(root: Path, text: str) -> Plan:
    folder = root / "experiments" / "scales"
    folder.mkdir(parents=True)
    (folder / "tiny.toml").write_text(text)
    return Plan(Project(root, root / "results"), ScaleFile(folder, "tiny"))


def test_encoders_are_trained_and_judged(tmp_path: Path) -> None:
    here = plan(tmp_path, SCALE)
    for sensor, tokens in (("lidar", (8, 32)), ("depth", (4, 32))):
        stage = here.quality(sensor)
        execute(pending([stage]), Stages(here, "cpu").actions)
        assert pending([stage]) == []
        quality = json.loads((stage.folder / "quality.json").read_text())
        for part in (quality, quality["dropout_50"], *quality["tiles"].values()):
            assert set(part["iou"]) == {"ground", "obstacle", "stair", "ramp"}
            assert part["depth_mae_m"] > 0
        assert set(quality["tiles"]) == {"building", "outdoor", "room"}
        assert quality["images"] == 32
        assert quality["dead_dims"] <= quality["latent_dims"] == tokens[0] * tokens[1]
        assert matplotlib.image.imread(stage.folder / "encoder.png").ndim == 3
        encoder = load(stage.folder / "encoder.pt")
        assert encoder.token_shape == tokens
        record = store.read(here.encoder(sensor=sensor))
        assert record is not None
        assert record.facts == {"digest": encoder.digest()}


ARMS = """
kind = "ablation"
title = "t"
[arms.walked]
label = "Oracle on the G1"
policy = "oracle"
navigation.dynamics = "g1"
"""


def test_the_humanoid_walks_on_the_locomotion_policy_of_its_scale(tmp_path: Path) -> None:
    here = plan(
        tmp_path,
        "[world]\ntiles = 2\ngoals_per_tile = 2\n[locomotion]\niterations = 1\n"
        "[locomotion.task]\nrobots = 4\nshares = {flat = 1.0}\n[locomotion.ppo]\nsteps = 2\nminibatches = 1\n",
    )
    here.project.file("humanoid").write_text(ARMS)
    stages, stage = Stages(here, "cpu"), here.episodes("walked", 0)
    with pytest.raises(RomnavError, match=r"gaits\.pt: no gait library; record one with `romnav train gaits`"):
        stages._body(stage, 1)
    execute(pending([here.locomotion()]), stages.actions)
    GaitLibrary([]).save(here.gaits().folder / "gaits.pt")
    world = stages.world(here.scale.settings.world)
    robots = stages._body(stage, 1)(world, 2, 0.2)
    robots.reset(
        torch.arange(2), sample(world, SamplerSpec(), 0, torch.arange(2), torch.arange(2), torch.zeros(2).long())
    )
    robots.step(torch.zeros(2, 3))
    assert isinstance(robots, Humanoid)
    assert not robots.fallen.any()
    with pytest.raises(RomnavError, match="no physics engine on cuda"):
        Stages(here, "cuda")._body(stage, 1)


def test_an_encoder_is_not_judged_on_its_training_terrain(tmp_path: Path) -> None:
    here = plan(tmp_path, SCALE.replace("tiles = 4", "tiles = 4\nseed = 0"))
    with pytest.raises(RomnavError, match=r"quality\.seed: 0 is the training terrain's"):
        execute([here.quality("lidar")], Stages(here, "cpu").actions)
