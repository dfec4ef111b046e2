from __future__ import annotations

import copy
import socket
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from romnav.errors import RomnavError
from romnav.evaluation.paired.replay import replay
from romnav.evaluation.postures import Postures
from romnav.evaluation.rollout import Oracle
from romnav.evaluation.spec import EvaluationSpec
from romnav.navigation.spec import EnvSpec
from romnav.report.paired.gallery import EpisodeGallery
from romnav.robot.spec import RobotSpec

pytest.importorskip("viser", reason="the extra view is not installed")

from romnav.report.replay.viewer import HEIGHT, Seen, Viewer


def free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


@pytest.fixture(scope="module")
def viewer(galleries: dict[str, EpisodeGallery]) -> Iterator[Viewer]:
    first = galleries["oracle"]

    def drive(name: str, episode: int) -> Seen:
        return Seen(replay(Oracle(), first.world, first.episodes, episode, EnvSpec(), EvaluationSpec()), None)

    made = Viewer(galleries, [3, 5], drive, RobotSpec(), port=free_port())
    made._playing.value = False
    yield made
    made.stop()


def test_robots_stand_where_their_tracks_are_and_stay_where_they_end(viewer: Viewer) -> None:
    for step in (0, 7, 10_000):
        viewer._show(step)
        for name, gallery in viewer._galleries.items():
            way = gallery.tracks.position[gallery.tracks.of(3)]
            expected = way[min(step, len(way) - 1)] + [0, 0, HEIGHT / 2]
            np.testing.assert_allclose(viewer._bodies[name].position, expected, atol=1e-5)


def test_a_humanoid_walks_with_its_meshes_as_it_was_recorded(
    viewer: Viewer, galleries: dict[str, EpisodeGallery]
) -> None:
    gallery = viewer._galleries["oracle"]
    joints = np.zeros((len(gallery.tracks.position), 22))
    joints[:, :3] = gallery.tracks.position + np.array([0, 0, 0.75])
    joints[:, 3] = 1.0
    gallery.postures = Postures(joints, np.zeros((len(joints), 8), np.float32))
    viewer._open(3)
    try:
        meshes, way = viewer._joints["oracle"], gallery.tracks.position[gallery.tracks.of(3)]
        assert "straight" not in viewer._joints
        for step in (0, 7):
            viewer._show(step)
            at = np.array([mesh.position for mesh in meshes]) - way[min(step, len(way) - 1)]
            assert np.hypot(at[:, 0], at[:, 1]).max() < 0.6
            assert -0.1 < at[:, 2].min() < at[:, 2].max() < 1.5
            assert not viewer._bodies["oracle"].visible
    finally:
        gallery.postures = None
        viewer._open(3)
    assert viewer._joints == {}


def test_storeys_above_those_to_show_are_hidden(viewer: Viewer) -> None:
    viewer._follow.value = False
    for last in (1, 2):
        viewer._storeys.value = last
        viewer._show(0)
        assert all(mesh.visible == (storey < last) for storey, mesh in viewer._walls)
    viewer._follow.value = True


def test_what_an_arm_decided_is_told_when_it_is_looked_through(viewer: Viewer) -> None:
    viewer._eyes.value = "oracle"
    viewer._look()
    assert "m/s ahead" in viewer._decided.content
    viewer._eyes.value = "none"
    viewer._look()
    assert viewer._decided.content == ""


def test_another_episode_replaces_the_one_before(viewer: Viewer) -> None:
    viewer._open(5)
    row = viewer._table.loc[5]
    assert f"{row.geodesic:.1f} m" in viewer._told.content
    assert viewer._time.max >= 1
    viewer._open(3)


@pytest.fixture
def slow(galleries: dict[str, EpisodeGallery]) -> Iterator[Viewer]:
    """A viewer of arms that take steps of 0.4 and 0.8 s, the first of them looked through."""
    made = {name: copy.copy(gallery) for name, gallery in galleries.items()}
    made["oracle"].period, made["straight"].period = 0.4, 0.8
    first, env = galleries["oracle"], EnvSpec(period=0.4)

    def drive(name: str, episode: int) -> Seen:
        again = replay(Oracle(), first.world, first.episodes, episode, env, EvaluationSpec())
        return Seen(replace(again, value=np.arange(len(again.command), dtype=float)), None)

    viewer = Viewer(made, [3], drive, RobotSpec(), port=free_port())
    viewer._playing.value = False
    yield viewer
    viewer.stop()


def test_arms_with_periods_of_their_own_are_shown_at_the_same_time(slow: Viewer) -> None:
    ways = {name: slow._way(name) for name in ("oracle", "straight")}
    assert slow._time.max == max(len(ways["oracle"]) - 1, 2 * (len(ways["straight"]) - 1))
    for step in (0, 6, slow._time.max):
        slow._show(step)
        for name, sample in (("oracle", step), ("straight", step // 2)):
            expected = ways[name][min(sample, len(ways[name]) - 1)] + [0, 0, HEIGHT / 2]
            np.testing.assert_allclose(slow._bodies[name].position, expected, atol=1e-5)
    slow._eyes.value = "oracle"
    slow._look()
    slow._show(6)
    np.testing.assert_allclose(slow._along.data[0], 0.4 * np.arange(7))


def test_a_replay_is_no_faster_than_its_speed(slow: Viewer) -> None:
    began = time.monotonic()
    slow._speed.value = "4"
    slow._playing.value = True
    time.sleep(1.0)
    slow._playing.value = False
    step, spent = slow._step, time.monotonic() - began
    assert 0 < 0.4 * step <= 4 * spent


def test_it_listens_on_the_loopback_alone_and_a_taken_port_is_one_line(
    viewer: Viewer, galleries: dict[str, EpisodeGallery]
) -> None:
    assert viewer.server.get_host() == "127.0.0.1"
    with pytest.raises(RomnavError, match="--port"):
        Viewer(galleries, [3], viewer._drive, RobotSpec(), port=viewer.server.get_port())
