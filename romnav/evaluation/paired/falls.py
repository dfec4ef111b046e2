"""Where the humanoid falls under navigation: falls per 100 m by place, the locomotion policy's test in the world."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from romnav.evaluation.episodes import EpisodeSet
from romnav.evaluation.paired.run import run
from romnav.evaluation.rollout import Driver
from romnav.evaluation.spec import EvaluationSpec
from romnav.navigation.spec import EnvSpec
from romnav.progress import Progress
from romnav.robot.dynamics import Body, Dynamics
from romnav.world.solids import Label
from romnav.world.spawns import Start
from romnav.world.world import LEVEL_GAP, World

PLACES = ("flat", "stair up", "stair down", "ramp", "at a wall", "on a landing")
"""Where a step of a command is made; later names win where several are true."""
NEAR_WALL = 2.0
"""Time for which a robot that touched something counts as at a wall, s."""


class Tally:
    """Robots whose way and falls are counted by place; otherwise those that `body` makes.

    Attributes:
        way: (places,) m.
        falls: (places,).
    """

    def __init__(self, body: Body, world: World, robots: int, period: float) -> None:
        self._robot: Dynamics = body(world, robots, period)
        self._world, self._memory = world, round(NEAR_WALL / period)
        self._landings = _landings(world)
        self._touched = torch.full((robots,), self._memory)
        self._height = torch.zeros(robots)
        self.way, self.falls = np.zeros(len(PLACES)), np.zeros(len(PLACES), int)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._robot, name)

    def reset(self, envs: Tensor, start: Start) -> None:
        """Put the robots ``envs`` (K,) at their starts."""
        self._robot.reset(envs, start)
        self._touched[envs] = self._memory
        self._height[envs] = self._robot.position[envs, 2]

    def select(self, envs: Tensor) -> None:
        """Keep only the robots ``envs`` (K,), in that order."""
        self._robot.select(envs)
        self._touched, self._height = self._touched[envs], self._height[envs]

    def step(self, command: Tensor) -> None:
        """Track the command (E, 3) for one period, and count it where it began."""
        r = self._robot
        before, fallen, place = r.position.clone(), r.fallen.clone(), self._place()
        r.step(command)
        # a body that lies at a wall touches it too: only contacts of those that stand are remembered
        self._touched = torch.where((r.contacts > 0) & ~r.fallen, 0, self._touched + 1)
        self._height = 0.8 * self._height + 0.2 * before[:, 2]
        way = torch.where(fallen, 0.0, torch.linalg.vector_norm(r.position[:, :2] - before[:, :2], dim=1))
        fell = r.fallen & ~fallen
        self.way += np.bincount(place.numpy(), way.double().numpy(), len(PLACES))
        self.falls += np.bincount(place[fell].numpy(), minlength=len(PLACES))

    def _place(self) -> Tensor:
        """(E,) index in `PLACES` of where robots are."""
        r, world = self._robot, self._world
        cell = world.index(r.position[:, :2])
        at = r.tile, r.layer, cell[:, 0], cell[:, 1]
        kind, landing = (grid[at] for grid in self._landings)
        place = torch.zeros_like(kind)
        rising = r.position[:, 2] >= self._height
        place = torch.where(kind == Label.STAIR, torch.where(rising, 1, 2), place)
        place = torch.where(kind == Label.RAMP, 3, place)
        place = torch.where(self._touched < self._memory, 4, place)
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
    made: list[Tally] = []

    def tallied(world: World, robots: int, period: float) -> Tally:
        made.append(Tally(body, world, robots, period))
        return made[0]

    columns = run(driver, world, episodes, env, spec, progress, tallied)
    (tally,) = made
    n = len(episodes)

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
