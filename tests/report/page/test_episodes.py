from __future__ import annotations

import base64
import copy
import io
import itertools
import zlib

import numpy as np
import pytest
from PIL import Image

from romnav.report.page import episodes
from romnav.report.paired.gallery import EpisodeGallery


@pytest.fixture(scope="module")
def content(galleries: dict[str, EpisodeGallery]) -> dict:
    return episodes.content(galleries)


def unpack(packed: dict) -> dict[str, np.ndarray]:
    """What the page's script does."""
    steps = np.frombuffer(zlib.decompress(base64.b64decode(packed["steps"])), "<i2")
    return dict(zip(packed["columns"], steps.reshape(len(packed["columns"]), -1).cumsum(axis=1) / 100, strict=True))


def test_packed_ways_are_the_tracks(content: dict, galleries: dict[str, EpisodeGallery]) -> None:
    for name, gallery in galleries.items():
        packed = content["ways"][name]
        way = unpack(packed)
        assert packed["first"] == gallery.tracks.first.tolist()
        found = np.stack([way[axis] for axis in "xyz"], axis=1)
        np.testing.assert_allclose(found, gallery.tracks.position, atol=1e-4)
        np.testing.assert_allclose(way["yaw"], gallery.tracks.yaw, atol=1e-4)
        np.testing.assert_array_equal(way["contact"] > 0, gallery.tracks.contact)


def test_shortest_paths_lead_from_start_to_goal_and_are_as_long_as_the_geodesic(content: dict) -> None:
    first, way = content["ways"]["shortest"]["first"], unpack(content["ways"]["shortest"])
    points = np.stack([way[axis] for axis in "xyz"], axis=1)
    shown = content["episodes"]
    for k, (begin, end) in enumerate(itertools.pairwise(first)):
        path = points[begin:end]
        np.testing.assert_allclose(path[0], shown["start"][k], atol=0.02)
        assert np.linalg.norm(path[-1] - shown["goal"][k]) < 0.3
        length = np.hypot(*np.diff(path[:, :2], axis=0).T).sum()
        assert length == pytest.approx(shown["geodesic"][k], abs=0.5)


def test_bins_count_every_episode_once(content: dict, galleries: dict[str, EpisodeGallery]) -> None:
    for bins in content["bins"]:
        for name, cells in bins["runs"].items():
            assert sum(cell["n"] for cell in cells) == len(galleries[name].table)
            hits = sum(cell["n"] * cell["rate"] / 100 for cell in cells if cell["n"])
            assert hits == pytest.approx((galleries[name].table.outcome == "success").sum())
            assert all(cell["lo"] - 1e-9 <= cell["rate"] <= cell["hi"] + 1e-9 for cell in cells if cell["n"])


def test_maps_show_the_grids_north_up(content: dict, galleries: dict[str, EpisodeGallery]) -> None:
    world = galleries["oracle"].world
    for index, tile in content["tiles"].items():
        grids = world.grids[index]
        assert len(tile["images"]) == len(tile["names"]) == len(tile["layers"]) == len(grids.free)
        for layer, text in enumerate(tile["images"]):
            image = np.array(Image.open(io.BytesIO(base64.b64decode(text))).convert("RGBA"))
            occupied = (image == episodes.PALETTE["occupied"]).all(axis=2)
            expected = (grids.label[layer] >= 0) & ~grids.free[layer]
            np.testing.assert_array_equal(occupied, expected.T[::-1])


def test_every_run_is_replayed_with_its_own_period(galleries: dict[str, EpisodeGallery]) -> None:
    slow = copy.copy(galleries["straight"])
    slow.period = 0.4
    assert episodes.content(galleries | {"straight": slow})["periods"] == {"oracle": 0.2, "straight": 0.4}
