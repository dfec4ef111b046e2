"""The ways that robots went: one sample per control period of every episode, in files of a few hundred kilobytes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from romnav import files
from romnav.errors import RomnavError
from romnav.robot.dynamics import Dynamics

if TYPE_CHECKING:
    from romnav.evaluation.rollout import View

RESOLUTION = 0.01
"""Positions and headings are kept in whole steps of this, m and rad."""


@dataclass(frozen=True)
class Tracks:
    """Tracks of ``n`` episodes, one after the other, ``N`` samples in all.

    The first sample of an episode is its start, the others follow at the ends of control periods.
    """

    first: NDArray[np.int64]
    """(n + 1,) first sample of each episode, and ``N``."""
    position: NDArray[np.float32]
    """(N, 3) tile frame, m."""
    yaw: NDArray[np.float32]
    """(N,) rad."""
    contact: NDArray[np.bool_]
    """(N,) whether the robot touched something in the period that ends here."""

    def __len__(self) -> int:
        return len(self.first) - 1

    def of(self, episode: int) -> slice:
        """Samples of an episode."""
        return slice(int(self.first[episode]), int(self.first[episode + 1]))


class Recorder:
    """Collects the tracks of a rollout."""

    def __init__(self) -> None:
        self._parts: list[tuple[NDArray, NDArray]] = []

    def add(self, view: View, alive: Tensor) -> None:
        """Keep the present sample of the rows ``alive`` (A,)."""
        sample = torch.cat([column[alive].double() for column in self._columns(view.robot)], dim=1)
        self._parts.append((view.episode[alive].cpu().numpy(), sample.cpu().numpy()))

    def _columns(self, robot: Dynamics) -> list[Tensor]:
        """What is kept of the robots (A, ...)."""
        return [robot.position, robot.yaw[:, None], robot.contacts[:, None] > 0]

    def tracks(self, episodes: int) -> Tracks:
        """What was collected, episode by episode."""
        first, samples = self._sorted(episodes)
        return Tracks(first, _rounded(samples[:, :3]), _rounded(samples[:, 3]), samples[:, 4] > 0)

    def _sorted(self, episodes: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """First sample (n + 1,) of each episode, and the samples (N, C)."""
        episode, samples = (np.concatenate(column) for column in zip(*self._parts, strict=True))
        first = np.concatenate([[0], np.cumsum(np.bincount(episode, minlength=episodes))])
        return first, samples[np.argsort(episode, kind="stable")]


def _rounded(values: NDArray) -> NDArray[np.float32]:
    return (np.rint(values / RESOLUTION) * RESOLUTION).astype(np.float32)


def write(path: Path, tracks: Tracks, provenance: Mapping[str, str]) -> None:
    """Writes tracks as differences of whole centimetres, with where they come from."""
    values = np.column_stack([tracks.position, tracks.yaw]).astype(np.float64)
    steps = np.diff(np.rint(values / RESOLUTION), axis=0, prepend=0.0).astype(np.int16)
    with files.atomic(path) as file:
        np.savez_compressed(
            file,
            first=tracks.first,
            contact=np.packbits(tracks.contact),
            provenance=np.array(sorted(provenance.items()), dtype=np.str_),
            **dict(zip(("x", "y", "z", "yaw"), steps.T, strict=True)),
        )


def read(path: Path) -> tuple[Tracks, dict[str, str]]:
    """Reads tracks and where they come from.

    Raises:
        RomnavError: The file is missing, torn or holds no tracks.
    """
    again = "evaluate the arm again"
    try:
        with np.load(path, allow_pickle=False) as stored:
            content = {name: stored[name] for name in stored.files}
        values = np.cumsum(np.stack([content[name] for name in ("x", "y", "z", "yaw")], axis=1, dtype=np.int64), axis=0)
        first, contact = content["first"], np.unpackbits(content["contact"], count=len(values)).astype(bool)
        provenance = {str(key): str(value) for key, value in content["provenance"]}
    except FileNotFoundError:
        raise RomnavError(f"{path}: no such tracks; {again}") from None
    except Exception as error:
        # a damaged file can make the reader fail in any way; without pickles it runs nothing on it
        raise RomnavError(f"{path}: truncated or no tracks; {again}") from error
    if first[0] != 0 or first[-1] != len(values) or (np.diff(first) < 1).any():
        raise RomnavError(f"{path}: key 'first' does not fit the {len(values)} samples; {again}")
    metres = (values * RESOLUTION).astype(np.float32)
    return Tracks(first, metres[:, :3], metres[:, 3], contact), provenance
