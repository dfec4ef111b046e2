from __future__ import annotations

from pathlib import Path

import matplotlib.image
import numpy as np

from romnav.report.pictures import COLOURS, draw_tile, render
from romnav.world.solids import Label, SolidsBuilder
from romnav.world.spec import WorldSpec
from romnav.world.tile import Tile, TileClass
from romnav.world.tiles import generate


def hue(image: np.ndarray, label: Label) -> np.ndarray:
    """Pixels whose colour is a shade of a label's colour."""
    colour = np.array(matplotlib.colors.to_rgb(COLOURS[label]))
    strength = image.sum(axis=2, keepdims=True) / colour.sum()
    return (np.abs(image - strength * colour) < 0.01).all(axis=2) & (strength[..., 0] < 1.05)


def test_what_is_in_front_hides_what_is_behind() -> None:
    def seen(stair_y: float) -> int:
        builder = SolidsBuilder()
        builder.box((5.0, 5.0), (10.0, 10.0), (-0.2, 0.0), label=Label.GROUND, layers=(0, 0))
        builder.box((5.0, stair_y), (2.0, 1.0), (0.0, 1.0), label=Label.STAIR, layers=(0, 0))
        builder.box((5.0, 5.0), (4.0, 1.0), (0.0, 3.0))
        tile = Tile(TileClass.ROOM, 0, 10.0, builder.build(), (0.0,), (0,), ())
        return int(hue(render(tile, azimuth=-90.0, elevation=20.0, pixels=200), Label.STAIR).sum())

    assert seen(stair_y=2.0) > 500  # nearer to the viewer, who looks along +y
    assert seen(stair_y=7.0) == 0


def test_a_tile_is_drawn(tmp_path: Path) -> None:
    tile, grids = generate(WorldSpec(classes=("building",)), 1)
    draw_tile(tile, grids, tmp_path / "tile.png")
    image = matplotlib.image.imread(tmp_path / "tile.png")[..., :3]
    assert hue(image, Label.STAIR).mean() > 1e-3
    assert (image < 0.99).any(axis=2).mean() > 0.1
