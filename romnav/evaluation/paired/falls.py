"""Where the humanoid falls under navigation: falls per 100 m by place, the locomotion policy's test in the world."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from romnav.evaluation.episodes import EpisodeSet
from romnav.evaluation.paired.run import run
from romnav.evaluation.rollout import Driver, View
from romnav.evaluation.spec import EvaluationSpec
from romnav.evaluation.tracks import Recorder
from romnav.navigation.spec import EnvSpec
from romnav.progress import Progress
from romnav.robot.dynamics import Body, Dynamics
from romnav.world.solids import Label
from romnav.world.world import LEVEL_GAP, World

PLACES = ("flat", "stair up", "stair down", "ramp", "at a wall", "on a landing")
"""Where a step of a command is made; later names win where several are true."""
NEAR_WALL = 2.0
"""Time for which a robot that touched something counts as at a wall, s."""


class Tally(Recorder):
    """Counts way and falls of running episodes by the place where a command began.

    Attributes:
        way: (places,) m.
        falls: (places,).
    """

    def __init__(self, world: World, episodes: int, period: float) -> None:
        super().__init__()
        self._world, self._memory = world, round(NEAR_WALL / period)
        self._landings = _landings(world)
        self._touched = torch.full((episodes,), self._memory)
        self._height = torch.zeros(episodes)
        self._position = torch.zeros(episodes, 3)
        self._fallen = torch.zeros(episodes, dtype=torch.bool)
        self._at = torch.zeros(episodes, dtype=torch.long)
        self.way, self.falls = np.zeros(len(PLACES)), np.zeros(len(PLACES), int)

    def add(self, view: View, alive: Tensor) -> None:
        """Count the period that ends here, of the rows ``alive`` (A,)."""
        robot, e = view.robot, view.episode
        if view.step == 0:
            self._height[e] = robot.position[:, 2]
        else:
            before, fallen, place = self._position[e], self._fallen[e], self._at[e]
            # a body that lies at a wall touches it too: only contacts of those that stand are remembered
            self._touched[e] = torch.where((robot.contacts > 0) & ~robot.fallen, 0, self._touched[e] + 1)
            self._height[e] = 0.8 * self._height[e] + 0.2 * before[:, 2]
            way = torch.linalg.vector_norm(robot.position[:, :2] - before[:, :2], dim=1)
            walked, fell = alive & ~fallen, alive & robot.fallen & ~fallen
            self.way += np.bincount(place[walked].numpy(), way[walked].double().numpy(), len(PLACES))
            self.falls += np.bincount(place[fell].numpy(), minlength=len(PLACES))
        self._position[e], self._fallen[e] = robot.position, robot.fallen
        self._at[e] = self._place(robot, e)

    def _place(self, robot: Dynamics, episode: Tensor) -> Tensor:
        """(A,) index in `PLACES` of where the robots of episodes (A,) are."""
        cell = self._world.index(robot.position[:, :2])
        at = robot.tile, robot.layer, cell[:, 0], cell[:, 1]
        kind, landing = (grid[at] for grid in self._landings)
        place = torch.zeros_like(kind)
        rising = robot.position[:, 2] >= self._height[episode]
        place = torch.where(kind == Label.STAIR, torch.where(rising, 1, 2), place)
        place = torch.where(kind == Label.RAMP, 3, place)
        place = torch.where(self._touched[episode] < self._memory, 4, place)
        return torch.where(landing & (place == 0), 5, place)


def _landings(world: World) -> tuple[Tensor, Tensor]:
    """(T, L, N, N) labels of the walking surface, and whether a cell is level ground between or above flights: within
    a metre of the upper end of a stair."""
    shape = world.node.shape
    label = torch.full(shape, -1, dtype=torch.long)
    landing = torch.zeros(shape, dtype=torch.bool)
    for t, (tile, grid) in enumerate(zip(world.tiles, world.grids, strict=True)):
        label[t, : len(grid.label)] = torch.from_numpy(grid.label.astype(np.int64))
        centre = (np.arange(shape[-1]) + 0.5) * world.cell
        for connector in tile.connectors:
            rise = np.diff(connector.path[:, 2])
            for k in range(1, len(connector.path)):
                if rise[k - 1] <= 0:
                    continue
                x, y, z = connector.path[k]
                near = np.hypot(centre[:, None] - x, centre[None] - y) < 1.0
                level = np.abs(grid.height - z) < LEVEL_GAP / 2
                landing[t, : len(grid.label)] |= torch.from_numpy(near & level)
    return label, landing


def count(
    name: str,
    driver: Driver,
    world: World,
    episodes: EpisodeSet,
    env: EnvSpec,
    spec: EvaluationSpec,
    body: Body,
    progress: Progress | None = None,
) -> list[dict[str, Any]]:
    """Drive `episodes` once and count by place.

    Returns:
        A row for each place, and one for "all": `driver`, `place`, `episodes`, `fell` (falls there over episodes),
        `falls_per_100m` (null where nobody went), `way`, m; "all" has `sr_45` and `sr_120`, shares.
    """
    n = len(episodes)
    tally = Tally(world, n, env.period)
    columns = run(driver, world, episodes, env, spec, progress, body, tally)

    def row(place: str, falls: int, way: float) -> dict[str, Any]:
        rate = 100.0 * falls / way if way > 0 else None
        return {
            "driver": name,
            "place": place,
            "episodes": n,
            "fell": falls / n,
            "falls_per_100m": rate,
            "way": way,
        }

    rows = [row(p, int(f), float(w)) for p, f, w in zip(PLACES, tally.falls, tally.way, strict=True)]
    time = columns["success_time"]
    rates = {f"sr_{limit}": float((time <= limit).mean()) for limit in (45, 120)}
    return [row("all", int((columns["outcome"] == "fall").sum()), float(columns["path_length"].sum())) | rates, *rows]
