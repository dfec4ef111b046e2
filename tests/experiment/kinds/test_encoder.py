"""The encoder's stages on real parts: trained, then judged on tiles that it was not trained on."""

from __future__ import annotations

import errno
import json
import os
from pathlib import Path

import matplotlib.image
import pytest

from romnav.errors import RomnavError
from romnav.experiment.graph import records
from romnav.experiment.graph.run import execute, pending
from romnav.experiment.graph.stage import Session
from romnav.experiment.kinds.encoder import encoder, quality
from romnav.sensing.encoder import load
from romnav.world.build import build
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


def test_a_full_disk_under_the_cache_is_not_blamed_on_the_results(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = workspace(tmp_path, SCALE)
    cache, sync = here.project.worlds, os.fsync

    def full(file: int) -> None:
        if Path(os.readlink(f"/proc/self/fd/{file}")).is_relative_to(cache):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        sync(file)

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(RomnavError) as caught:
        execute([encoder(here, "lidar")], Session())
    file, reason = str(caught.value).split(": cannot be written ")
    assert Path(file).parent == cache
    assert reason == (
        f"(no space left on device); free some disk space. {cache} is a cache: empty it, or make it a link to a folder "
        "elsewhere"
    )
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    cache.rmdir()
    cache.symlink_to(elsewhere)
    build(here.settings.world, cache)
    assert [path.suffix for path in elsewhere.iterdir()] == [".safetensors"]


def test_an_encoder_is_not_judged_on_its_training_terrain(tmp_path: Path) -> None:
    here = workspace(tmp_path, SCALE.replace("tiles = 4", "tiles = 4\nseed = 0"))
    with pytest.raises(RomnavError, match=r"quality\.seed: 0 is the training terrain's"):
        execute([quality(here, "lidar")], Session())
