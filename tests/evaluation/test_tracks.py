from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from romnav.errors import RomnavError
from romnav.evaluation import episodes, tracks
from romnav.evaluation.paired.run import run
from romnav.evaluation.rollout import Oracle
from romnav.evaluation.spec import EpisodeSetSpec, EvaluationSpec
from romnav.navigation.spec import EnvSpec
from romnav.world.build import build
from romnav.world.spec import SamplerSpec, WorldSpec

SPEC = EpisodeSetSpec(
    world=WorldSpec(tiles=2, seed=52, goals_per_tile=16),
    episodes=24,
    cross=12,
    sampler=SamplerSpec(stair_probability=0.0),
)


@pytest.fixture(scope="module")
def recorded() -> tuple[tracks.Tracks, dict, episodes.EpisodeSet]:
    world = build(SPEC.world)
    paired = episodes.draw("test", SPEC, world)
    recorder = tracks.Recorder()
    out = run(Oracle(), world, paired, EnvSpec(), EvaluationSpec(duration=20.0), recorder=recorder)
    return recorder.tracks(len(paired)), out, paired


def test_tracks_tell_what_the_rows_tell(recorded: tuple) -> None:
    """Start, end, number of samples and length of the way, against what the rollout measures on its own."""
    kept, out, paired = recorded
    assert len(kept) == len(paired)
    c = paired.columns
    for episode in range(len(kept)):
        samples = kept.of(episode)
        position = kept.position[samples].astype(float)
        assert len(position) == round(out["time"][episode] / 0.2) + 1
        np.testing.assert_allclose(position[0], [c[f"spawn_{axis}"][episode] for axis in "xyz"], atol=0.006)
        goal = [c[f"goal_{axis}"][episode] for axis in "xyz"]
        reached = np.linalg.norm(position - goal, axis=1) < 0.5
        assert not reached[:-2].any()
        assert (out["outcome"][episode] == "success") == (np.linalg.norm(position[-1] - goal) < 0.51)
        length = np.hypot(*np.diff(position[:, :2], axis=0).T).sum()
        assert length == pytest.approx(out["path_length"][episode], abs=0.004 * len(position))
        assert kept.contact[samples].sum() == out["collisions"][episode]


def test_files_hold_tracks_and_stay_small(recorded: tuple, tmp_path: Path) -> None:
    kept, _, _ = recorded
    path = tmp_path / "tracks.npz"
    tracks.write(path, kept, {"arm": "oracle", "commit": "abc"})
    again, provenance = tracks.read(path)
    assert provenance == {"arm": "oracle", "commit": "abc"}
    for name in ("first", "position", "yaw", "contact"):
        np.testing.assert_array_equal(getattr(again, name), getattr(kept, name))
    assert path.stat().st_size < 6 * len(kept.yaw) + 2000


@pytest.mark.parametrize("damage", ["missing", "torn", "text", "pickle"])
def test_damaged_files_are_refused_and_run_nothing(recorded: tuple, tmp_path: Path, damage: str) -> None:
    path = tmp_path / "tracks.npz"
    tracks.write(path, recorded[0], {})
    match damage:
        case "missing":
            path.unlink()
        case "torn":
            path.write_bytes(path.read_bytes()[:-300])
        case "text":
            path.write_text("no tracks")
        case "pickle":
            torch.save({"first": [0]}, path)
    with pytest.raises(RomnavError, match=r"tracks\.npz.*evaluate the arm again"):
        tracks.read(path)


def test_a_flipped_bit_is_refused_or_does_no_harm(recorded: tuple, tmp_path: Path) -> None:
    path, luck = tmp_path / "tracks.npz", np.random.default_rng(0)
    tracks.write(path, recorded[0], {"arm": "oracle"})
    whole = path.read_bytes()
    refused = 0
    for where in luck.integers(len(whole), size=150):
        flipped = bytearray(whole)
        flipped[where] ^= 1 << int(luck.integers(8))
        path.write_bytes(flipped)
        try:
            read, about = tracks.read(path)
        except RomnavError:
            refused += 1
        else:
            assert np.array_equal(read.position, recorded[0].position)
            assert about == {"arm": "oracle"}
    assert refused > 100
