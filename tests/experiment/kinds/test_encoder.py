"""The encoder's stages on real parts: trained, then judged on tiles that it was not trained on."""

from __future__ import annotations

import json
from pathlib import Path

import matplotlib.image
import pytest

from romnav.errors import RomnavError
from romnav.experiment.graph import records
from romnav.experiment.graph.run import execute, pending
from romnav.experiment.graph.stage import Session
from romnav.experiment.kinds.encoder import encoder, quality
from romnav.sensing.encoder import load
from tests.experiment.conftest import workspace

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


def test_encoders_are_trained_and_judged(tmp_path: Path) -> None:
    here = workspace(tmp_path, SCALE)
    for sensor, tokens in (("lidar", (8, 32)), ("depth", (4, 32))):
        stage = quality(here, sensor)
        execute(pending([stage]), Session())
        assert pending([stage]) == []
        judged = json.loads((stage.folder / "quality.json").read_text())
        for part in (judged, judged["dropout_50"], *judged["tiles"].values()):
            assert set(part["iou"]) == {"ground", "obstacle", "stair", "ramp"}
            assert part["depth_mae_m"] > 0
        assert set(judged["tiles"]) == {"building", "outdoor", "room"}
        assert judged["images"] == 32
        assert judged["dead_dims"] <= judged["latent_dims"] == tokens[0] * tokens[1]
        assert matplotlib.image.imread(stage.folder / "encoder.png").ndim == 3
        trained = load(stage.folder / "encoder.pt")
        assert trained.token_shape == tokens
        record = records.read(encoder(here, sensor))
        assert record is not None
        assert record.facts == {"digest": trained.digest()}


def test_an_encoder_is_not_judged_on_its_training_terrain(tmp_path: Path) -> None:
    here = workspace(tmp_path, SCALE.replace("tiles = 4", "tiles = 4\nseed = 0"))
    with pytest.raises(RomnavError, match=r"quality\.seed: 0 is the training terrain's"):
        execute([quality(here, "lidar")], Session())
