from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from romnav.errors import RomnavError
from romnav.evaluation import postures
from romnav.evaluation.postures import PostureRecorder, Postures
from romnav.evaluation.tracks import Tracks

EPISODES, STEPS = 3, 40


def robots(step: int, count: int) -> Any:
    """Bodies with 22 generalised positions that are functions of episode and step."""
    luck = np.random.default_rng(step)
    place = torch.tensor([[30.0 * k, -20.0 + 0.2 * step, 4.0] for k in range(count)])
    joints = torch.from_numpy(luck.uniform(-1.5, 1.5, (count, 22)))
    joints[:, :3] = place + 0.5
    return SimpleNamespace(
        position=place, yaw=place[:, 1] / 10, contacts=torch.zeros(count), joints=joints, proprioception=joints[:, 7:15]
    )


@pytest.fixture(scope="module")
def recorded() -> tuple[Tracks, Postures]:
    recorder = PostureRecorder()
    for step in range(STEPS):
        view: Any = SimpleNamespace(robot=robots(step, EPISODES), episode=torch.arange(EPISODES))
        recorder.add(view, torch.arange(EPISODES) * 10 < STEPS - step)
    return recorder.tracks(EPISODES), recorder.postures(EPISODES)


def test_postures_are_kept_sample_by_sample_of_the_tracks(recorded: tuple[Tracks, Postures]) -> None:
    tracks, kept = recorded
    for episode in range(EPISODES):
        samples = range(*tracks.of(episode).indices(len(kept.joints)))
        assert len(samples) == STEPS - 10 * episode
        for step, sample in enumerate(samples):
            robot = robots(step, EPISODES)
            np.testing.assert_allclose(kept.joints[sample], robot.joints[episode], atol=1e-6)
            np.testing.assert_allclose(kept.felt[sample], robot.proprioception[episode], atol=1e-6)


def test_files_hold_postures_to_the_millimetre(recorded: tuple[Tracks, Postures], tmp_path: Path) -> None:
    tracks, kept = recorded
    postures.write(tmp_path / "postures.npz", kept, tracks, {"arm": "oracle-hum"})
    again = postures.read(tmp_path / "postures.npz", tracks)
    np.testing.assert_allclose(again.joints, kept.joints, atol=0.00051)
    np.testing.assert_allclose(again.felt, kept.felt, atol=0.00051)


def test_physics_that_blew_up_does_no_harm_to_what_comes_after(
    recorded: tuple[Tracks, Postures], tmp_path: Path
) -> None:
    tracks, kept = recorded
    joints = kept.joints.copy()
    joints[5, 3:], joints[6, :3] = np.nan, 1e9
    postures.write(tmp_path / "postures.npz", Postures(joints, kept.felt), tracks, {})
    again = postures.read(tmp_path / "postures.npz", tracks)
    assert np.isfinite(again.joints).all()
    np.testing.assert_allclose(again.joints[7:], kept.joints[7:], atol=0.00051)


@pytest.mark.parametrize("damage", ["missing", "torn", "text", "other"])
def test_damaged_files_and_those_of_other_tracks_are_refused(
    recorded: tuple[Tracks, Postures], tmp_path: Path, damage: str
) -> None:
    tracks, kept = recorded
    path = tmp_path / "postures.npz"
    postures.write(path, kept, tracks, {})
    match damage:
        case "missing":
            path.unlink()
        case "torn":
            path.write_bytes(path.read_bytes()[:-300])
        case "text":
            path.write_text("no postures")
        case "other":
            tracks = Tracks(tracks.first, tracks.position + 0.01, tracks.yaw, tracks.contact)
    with pytest.raises(RomnavError, match=r"postures\.npz: .*evaluate the arm again with --joints"):
        postures.read(path, tracks)
