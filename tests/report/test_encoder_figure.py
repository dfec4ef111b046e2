"""The encoder's figure is drawn for both sensors and every class of tile."""

from __future__ import annotations

from pathlib import Path

import matplotlib.image
import pytest

from romnav.report.encoder_figure import TITLES, draw_encoder
from romnav.sensing.depth import DepthCamera
from romnav.sensing.encoder import Autoencoder
from romnav.sensing.lidar import Lidar
from romnav.sensing.spec import CorruptionSpec, DepthEncoderSpec, DepthSpec, EncoderSpec, LidarSpec
from romnav.world.grids import rasterise
from romnav.world.solids import Label, SolidsBuilder
from romnav.world.spec import GridSpec
from romnav.world.tile import Tile, TileClass


@pytest.mark.parametrize("sensor_name", ["lidar", "depth"])
def test_a_row_of_panels_per_tile_class_and_share(sensor_name: str, tmp_path: Path) -> None:
    tiles = []
    for k, kind in enumerate((TileClass.OUTDOOR, TileClass.ROOM)):
        b = SolidsBuilder()
        b.box((3, 3), (6, 6), (-0.2, 0.0), label=Label.GROUND, layers=(0, 0))
        b.box((3, 5), (1, 1), (0.0, 1.0 + k))
        tile = Tile(kind, k, 6.0, b.build(), (0.0,), (0,), ())
        tiles.append((tile, rasterise(tile, GridSpec())))
    solids = [tile.solids for tile, _ in tiles]
    if sensor_name == "lidar":
        sensor, spec = Lidar(solids, LidarSpec(rows=15, columns=55)), EncoderSpec()
    else:
        sensor, spec = DepthCamera(solids, DepthSpec()), DepthEncoderSpec()
    path = tmp_path / "encoder.png"
    draw_encoder(Autoencoder(spec, sensor.directions), tiles, sensor, 1.2, CorruptionSpec(), path)
    height, width, _ = matplotlib.image.imread(path).shape
    assert width > 200 * len(TITLES)
    assert height > 200
