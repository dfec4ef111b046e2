"""The viewer in a browser."""

from __future__ import annotations

import io

import numpy as np
import pytest
from PIL import Image

from romnav.evaluation.paired.replay import replay
from romnav.evaluation.rollout import Oracle
from romnav.evaluation.spec import EvaluationSpec
from romnav.navigation.spec import EnvSpec
from romnav.report.paired.gallery import EpisodeGallery
from romnav.robot.spec import RobotSpec
from tests.report.browser import chromium, watch

pytestmark = pytest.mark.slow
pytest.importorskip("viser", reason="the extra view is not installed")

from romnav.report.replay.viewer import Seen, Viewer  # noqa: E402
from tests.report.replay.test_viewer import free_port  # noqa: E402

TIMEOUT = 200_000
"""Software draws WebGL slowly, ms."""


def test_the_robot_moves(galleries: dict[str, EpisodeGallery]) -> None:
    first = galleries["oracle"]

    def drive(name: str, episode: int) -> Seen:
        return Seen(replay(Oracle(), first.world, first.episodes, episode, EnvSpec(), EvaluationSpec()), None)

    longest = int(np.argmax(np.diff(first.tracks.first)))
    port = free_port()
    with chromium() as browser:
        viewer = Viewer(galleries, [longest], drive, RobotSpec(), port=port)
        viewer._playing.value = False
        try:
            page = browser.new_page(viewport={"width": 640, "height": 480})
            errors, asked = watch(page)
            page.goto(f"http://127.0.0.1:{port}", timeout=TIMEOUT)
            page.get_by_text("climb").wait_for(timeout=TIMEOUT)
            seen = []
            for step in (0, len(first.tracks.position[first.tracks.of(longest)]) - 1):
                viewer._show(step)
                page.wait_for_timeout(8000)
                picture = Image.open(io.BytesIO(page.screenshot(timeout=TIMEOUT))).convert("RGB")
                seen.append(np.asarray(picture)[:, :320].astype(int))
        finally:
            viewer.stop()
    assert (np.abs(seen[1] - seen[0]).max(axis=2) > 20).sum() > 50
    assert errors == []
    assert [url for url in asked if not url.startswith((f"http://127.0.0.1:{port}", "blob:", "data:"))] == []
