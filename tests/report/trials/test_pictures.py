from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from romnav.report.pictures import COLOURS, project, render
from romnav.report.trials import pictures as trial_pictures
from romnav.world.scenes.deployments import deployment_scenes
from romnav.world.scenes.obstacles import obstacle_scenes
from romnav.world.solids import Label, SolidsBuilder
from romnav.world.tile import Tile, TileClass


def test_points_are_projected_to_where_the_image_shows_them() -> None:
    solids = SolidsBuilder()
    solids.box((5.0, 5.0), (8.0, 8.0), (-0.1, 0.0), label=Label.GROUND, layers=(0, 0))
    places = np.array([[2.0, 3.0, 0.6], [7.0, 4.0, 0.6], [4.0, 7.5, 0.6]])
    for x, y, z in places:
        solids.box((x, y), (0.3, 0.3), (0.0, z), label=Label.STAIR)
    tile = Tile(TileClass.ROOM, 0, 10.0, solids.build(), (0.0,), (0,), ())
    image = render(tile, -50.0, 40.0, pixels=400)
    red, green, blue = (int(COLOURS[Label.STAIR][k : k + 2], 16) for k in (1, 3, 5))
    for column, row in project(tile, places, -50.0, 40.0, pixels=400):
        seen = 255 * image[round(row), round(column)]
        assert seen / seen.max() == pytest.approx(np.array([red, green, blue]) / red, abs=0.02)


@pytest.mark.slow
def test_figures_show_tracks_and_collisions(trial_run, tmp_path: Path) -> None:
    run = trial_run("rom", n=16)
    trial_pictures.draw_safety(run, obstacle_scenes(), tmp_path / "safety.png")
    trial_pictures.draw_safety(trial_run("rom", n=4), obstacle_scenes(), tmp_path / "few.png")  # fewer than are shown
    assert imread(tmp_path / "few.png").ndim == 3
    scenes = deployment_scenes()
    trial_pictures.draw_deployments(
        trial_run("rom", n=4, scenes=[scene.name for scene in scenes]), scenes, tmp_path / "deploy.png"
    )
    for name in ("safety", "deploy"):
        image = np.round(255 * imread(tmp_path / f"{name}.png")[..., :3]).astype(int)
        for colour in (trial_pictures.OFF, trial_pictures.ON, trial_pictures.HIT):
            wanted = [int(colour[k : k + 2], 16) for k in (1, 3, 5)]
            assert (np.abs(image - wanted).max(axis=2) < 12).any()
