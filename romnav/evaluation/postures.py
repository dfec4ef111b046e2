"""How humanoids held themselves along their tracks, in a file beside the tracks', on request."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from romnav import files
from romnav.errors import RomnavError
from romnav.evaluation.tracks import Recorder, Tracks
from romnav.robot.dynamics import Dynamics

RESOLUTION = 0.001
"""Everything is kept in whole steps of this, m, rad or rad/s."""
FARTHEST = 32.7
"""What is beyond does not fit 16 bits; only physics that blew up gets there."""
TRACK_COLUMNS = 5


@dataclass(frozen=True)
class Postures:
    """Postures of humanoids at the ``N`` samples of `Tracks`."""

    joints: NDArray[np.float64]
    """(N, Q) generalised positions: of the pelvis, tile frame, m and wxyz; of the joints, rad."""
    felt: NDArray[np.float32]
    """(N, P) proprioception."""


class PostureRecorder(Recorder):
    """Collects the tracks and the postures of a rollout of bodies with joints."""

    def _columns(self, robot: Dynamics) -> list[Tensor]:
        assert robot.joints is not None
        self._joints = robot.joints.shape[1]
        return [*super()._columns(robot), robot.joints, robot.proprioception]

    def postures(self, episodes: int) -> Postures:
        """What was collected, sample by sample of the tracks."""
        _, samples = self._sorted(episodes)
        joints, felt = np.split(samples[:, TRACK_COLUMNS:], [self._joints], axis=1)
        return Postures(joints, felt.astype(np.float32))


def write(path: Path, postures: Postures, tracks: Tracks, provenance: Mapping[str, str]) -> None:
    """Writes postures as differences of whole millimetres and milliradians, with where they come from."""
    values = np.concatenate([postures.joints, postures.felt], axis=1)
    values[:, :3] -= tracks.position  # small numbers, wherever on a tile
    whole = np.rint(np.nan_to_num(values).clip(-FARTHEST, FARTHEST) / RESOLUTION).astype(np.int16)
    steps = np.diff(whole, axis=0, prepend=np.int16(0))  # may overflow; their sums overflow back
    with files.atomic(path) as file:
        np.savez_compressed(
            file,
            steps=np.ascontiguousarray(steps.T),
            joints=postures.joints.shape[1],
            way=_digest(tracks),
            provenance=np.array(sorted(provenance.items()), dtype=np.str_),
        )


def read(path: Path, tracks: Tracks) -> Postures:
    """Reads the postures of humanoids that went along ``tracks``.

    Raises:
        RomnavError: The file is missing, torn, holds no postures, or those of other tracks.
    """
    again = "evaluate the arm again with --joints"
    try:
        with np.load(path, allow_pickle=False) as stored:
            values = np.cumsum(stored["steps"].T, axis=0, dtype=np.int16) * RESOLUTION
            count, way = int(stored["joints"]), str(stored["way"])
        joints, felt = np.split(values, [count], axis=1)
    except FileNotFoundError:
        raise RomnavError(f"{path}: no such postures; {again}") from None
    except Exception as error:
        # a damaged file can make the reader fail in any way; without pickles it runs nothing on it
        raise RomnavError(f"{path}: truncated or no postures; {again}") from error
    if way != _digest(tracks) or len(joints) != len(tracks.position):
        raise RomnavError(f"{path}: of another evaluation than the tracks beside it; {again}")
    joints[:, :3] += tracks.position
    return Postures(joints, felt.astype(np.float32))


def _digest(tracks: Tracks) -> str:
    content = hashlib.sha256()
    for array in (tracks.first, tracks.position, tracks.yaw):
        content.update(array.tobytes())
    return content.hexdigest()[:16]
