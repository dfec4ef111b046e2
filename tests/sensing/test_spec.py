"""Whatever the settings of sensors and encoders say: refused by a key, or the first gradient step runs."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from romnav.config import Config
from romnav.sensing.depth import DepthCamera
from romnav.sensing.lidar import Lidar
from romnav.sensing.pretrain import pretrain
from romnav.sensing.spec import DepthPretrainSpec, DepthSpec, LidarSpec, PretrainSpec
from romnav.world.build import build
from romnav.world.spec import WorldSpec
from romnav.world.world import World
from tests.fuzz import FILE, stop, try_settings

ENCODER = {"widths": [8, 8], "strides": [[2, 4], [2, 2]], "latent": 4}
TINY = {
    "lidar": {"rows": 6, "columns": 16},
    "depth": {"rows": 6, "columns": 8},
    "pretrain": {"images": 64, "epochs": 1, "batch": 4, "encoder": ENCODER},
    "pretrain_depth": {"images": 64, "epochs": 1, "batch": 4, "encoder": ENCODER},
}
WITHIN = 5.0
"""For an answer, s of processor time."""


class Sensors(Config):
    """The sections of a scale that make encoders."""

    lidar: LidarSpec
    depth: DepthSpec
    pretrain: PretrainSpec
    pretrain_depth: DepthPretrainSpec


@pytest.fixture(scope="module")
def world() -> World:
    return build(WorldSpec(tiles=1, side=12.0, classes=("building",), max_storeys=1, goals_per_tile=4))


@settings(deadline=None, max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data(), camera=st.booleans())
def test_any_settings_are_refused_by_a_key_or_their_first_step_runs(
    world: World, tmp_path: Path, data: st.DataObject, camera: bool
) -> None:
    solids = [tile.solids for tile in world.tiles]
    tiles = list(zip(world.tiles, world.grids, strict=True))

    def begin(spec: Sensors) -> None:
        sensor = DepthCamera(solids, spec.depth) if camera else Lidar(solids, spec.lidar)
        training = spec.pretrain_depth if camera else spec.pretrain
        pretrain(training, tiles, sensor, sensor.spec.height, tmp_path, progress=stop, resume=False)

    begun = time.process_time()
    message = try_settings(Sensors, TINY, begin, data.draw)
    assert not message or message.startswith((f"{FILE}: ", str(tmp_path), "pretrain"))
    assert "\n" not in message
    assert time.process_time() - begun < WITHIN
