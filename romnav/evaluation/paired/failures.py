"""Why episodes fail: where the robot got to, and what it did in the end.

The end is the last `WINDOW` seconds, and what it did is the first that holds: it fell; it touched something for half of
the time (pressed); it stayed within `STANDING` (stood); it walked `ROUNDS` times the diagonal of what it covered
(circled); anything else (roamed).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from romnav.evaluation.tracks import Tracks
from romnav.world.solids import Label
from romnav.world.world import LEVEL_GAP, World

WINDOW = 20.0
"""Time before the end that is looked at, s."""
STANDING = 1.0
"""A robot that stays within a box with this diagonal stood, m."""
ROUNDS = 3.0
"""Length of the way over the diagonal of its bounding box from which on it counts as circling."""


def classify(tracks: Tracks, rows: Mapping[str, NDArray], world: World, period: float) -> tuple[NDArray, NDArray]:
    """Classes of the failed episodes.

    Args:
        tracks: Of the ``n`` episodes.
        rows: Columns of their rows.
        world: The terrain.
        period: Time between samples, s.

    Returns:
        Where and how, each (n,) strings of `rows.WHERE` and `rows.HOW`; empty where the goal was reached.
    """
    where = np.full(len(tracks), "", dtype=object)
    how = where.copy()
    for episode in np.flatnonzero(rows["outcome"] != "success"):
        samples = tracks.of(int(episode))
        position, contact = tracks.position[samples].astype(np.float64), tracks.contact[samples]
        if rows["level"][episode] == "same":
            where[episode] = "same level"
        else:
            floor = np.abs(position[:, 2] - rows["goal_z"][episode]) <= LEVEL_GAP
            climbed = on_connector(world, int(rows["tile"][episode]), position).any()
            where[episode] = "on the goal's level" if floor.any() else "on a stair" if climbed else "never on a stair"
        how[episode] = "fell" if rows["outcome"][episode] == "fall" else _how(position[:, :2], contact, period)
    return where, how


def _how(xy: NDArray, contact: NDArray, period: float) -> str:
    last = slice(-round(WINDOW / period) - 1, None)
    xy, contact = xy[last], contact[last]
    diagonal = float(np.hypot(*np.ptp(xy, axis=0)))
    length = float(np.hypot(*np.diff(xy, axis=0).T).sum())
    if contact[1:].mean() >= 0.5:
        return "pressed"
    if diagonal < STANDING:
        return "stood"
    return "circled" if length >= ROUNDS * diagonal else "roamed"


def on_connector(world: World, tile: int, position: NDArray) -> NDArray[np.bool_]:
    """(N,) whether positions (N, 3) of a tile, m, stand on a stair or ramp: on the layer nearest in height."""
    grids = world.grids[tile]
    cell = np.clip(np.floor(position[:, :2] / grids.cell).astype(int), 0, grids.height.shape[1] - 1)
    height = grids.height[:, cell[:, 0], cell[:, 1]]
    off = np.where(np.isnan(height), np.inf, np.abs(height - position[:, 2]))
    label = grids.label[off.argmin(axis=0), cell[:, 0], cell[:, 1]]
    return np.isin(label, (Label.STAIR, Label.RAMP)) & np.isfinite(off.min(axis=0))
