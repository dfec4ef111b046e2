from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from romnav.errors import RomnavError
from romnav.report.replay import opengl, video

FILM = """
import dataclasses
import sys
from pathlib import Path
import numpy as np
from romnav.report.replay import opengl
opengl.choose()
from romnav.evaluation import episodes
from romnav.evaluation.paired.replay import replay
from romnav.evaluation.rollout import Oracle
from romnav.evaluation.spec import EpisodeSetSpec, EvaluationSpec
from romnav.navigation.spec import EnvSpec
from romnav.report.paired.maps import shortest
from romnav.report.replay.video import Film, write
from romnav.robot.spec import RobotSpec
from romnav.world.build import build
from romnav.world.spec import SamplerSpec, WorldSpec
world = build(WorldSpec(tiles=1, seed=51, goals_per_tile=16))
spec = EpisodeSetSpec(world=world.spec, episodes=4, cross=1, sampler=SamplerSpec(stair_probability=0.0))
paired = episodes.draw("test", spec, world)
again = replay(Oracle(), world, paired, 0, EnvSpec(), EvaluationSpec(duration=4.0))
if sys.argv[2] == "humanoid":  # stands on its way
    joints = np.zeros((len(again.position), 22))
    joints[:, :3], joints[:, 3] = again.position + np.array([0.0, 0.0, 0.75]), 1.0
    again = dataclasses.replace(again, joints=joints)
(route,) = shortest(world, paired, [0])
film = Film(world.tiles[0], again, route[-1], route, RobotSpec(), size=96)
write(Path(sys.argv[1]), film.frames(4.0, 0.2))
"""


def pictures(count: int = 4) -> Iterator[np.ndarray]:
    for k in range(count):
        picture = np.zeros((32, 64, 3), np.uint8)
        picture[:, 8 * k : 8 * k + 8] = (200, 40, 40)
        yield picture


def test_a_gif_shows_every_picture_and_runs_for_ever(tmp_path: Path) -> None:
    video.write(tmp_path / "deep" / "film.gif", pictures())
    with Image.open(tmp_path / "deep" / "film.gif") as film:
        assert film.n_frames == 4
        assert film.info["loop"] == 0
        film.seek(2)
        assert film.convert("RGB").getpixel((20, 5))[0] > 150


def test_other_suffixes_and_a_missing_encoder_are_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(RomnavError, match=r"a video is \.mp4 or \.gif"):
        video.write(tmp_path / "film.avi", pictures())
    monkeypatch.setattr(video, "find_spec", lambda name: None)
    with pytest.raises(RomnavError, match=r"pip install 'romnav\[video\]'"):
        video.write(tmp_path / "film.mp4", pictures())


def test_mp4(tmp_path: Path) -> None:
    reader = pytest.importorskip("imageio_ffmpeg", reason="the extra video is not installed")
    video.write(tmp_path / "film.mp4", pictures())
    assert reader.count_frames_and_secs(str(tmp_path / "film.mp4"))[0] == 4


def test_without_a_library_to_draw_with_the_message_tells_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(opengl, "find_library", lambda name: None)
    with pytest.raises(RomnavError, match="apt-get install"):
        opengl.choose()


@pytest.mark.slow
@pytest.mark.parametrize("body", ["cylinder", "humanoid"])
def test_a_film_shows_the_robot_from_behind_and_from_above(tmp_path: Path, body: str) -> None:
    path = tmp_path / "film.gif"
    done = subprocess.run([sys.executable, "-c", FILM, path, body], capture_output=True, text=True)
    if "no OpenGL to draw with" in done.stderr:
        pytest.skip(done.stderr.splitlines()[-1])
    assert done.returncode == 0, done.stderr
    with Image.open(path) as film:
        assert film.size == (192, 96)
        film.seek(film.n_frames // 2)
        picture = np.asarray(film.convert("RGB")).astype(int)
    if body == "humanoid":  # white and dark, before grey ground
        parts = picture[38:60, 43:53].max(axis=2)
        assert parts.max() > 160
        assert parts.min() < 110
        return
    blue = (picture[..., 2] > picture[..., 0] + 40) & (picture[..., 2] > 80)
    for half in (blue[:, :96], blue[:, 96:]):
        assert half[30:70, 30:66].any()
