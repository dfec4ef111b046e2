"""The fixed test of a locomotion policy: does it cross flats, ramps and whole flights of stairs it never saw?"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from romnav.progress import Progress
from romnav.robot.g1 import Humanoids
from romnav.robot.locomotion.control import Controller, has_fallen
from romnav.robot.locomotion.planar import heading_of, turn_xy, wrap
from romnav.robot.locomotion.terrain import Ground, Lane, flat, ramp, stairs, steer, uturn
from romnav.robot.locomotion.train import load_policy
from romnav.robot.spec import LocomotionSpec

STOREY = 4.0
"""Height of a floor of the building tiles, m."""
ALLOWANCE = 1.5
"""A crossing may take this many times the commanded time."""


@dataclass(frozen=True)
class Row:
    """One row of the test: lanes, directions and speeds that its trials go through in turn.

    Attributes:
        terrain: name.
        command: the commands, for the reader.
        target: share of crossings to reach.
        lanes: of the ground.
        legs: (from, to) spawns of a lane: up is (0, 1), down (1, 2) or (1, 0).
        speed: range of the commanded speed, m/s.
    """

    terrain: str
    command: str
    target: float
    lanes: tuple[Lane, ...]
    legs: tuple[tuple[int, int], ...]
    speed: tuple[float, float]


def rows() -> list[Row]:
    """The test; none of its inclinations, risers and treads is among the training lanes."""
    both = ((0, 1), (1, 2))
    ramps = tuple(ramp(0, degrees, 5.0) for degrees in (5.0, 8.5, 12.0, 15.0))
    low = ((0.105, 0.30, 0.28), (0.125, 0.28, 0.30), (0.145, 0.29, 0.26))
    high = ((0.162, 0.28, 0.26), (0.178, 0.26, 0.29))
    flights = [tuple(stairs(0, *shape, steps=20) for shape in shapes) for shapes in (low, high)]
    storey = (uturn(0, STOREY / 24, 0.285, 12),)
    return [
        Row("flat", "corners of (-0.5..1, +-0.25, +-1) for 20 s", 0.99, (flat(),), (), (0.0, 0.0)),
        Row("ramp", "0.4-1.0 m/s up and down", 0.97, ramps, both, (0.4, 1.0)),
        Row("stairs-low", "0.4-0.8 m/s up and down", 0.95, flights[0], both, (0.4, 0.8)),
        Row("stairs-high", "0.4-0.6 m/s up and down", 0.90, flights[1], both, (0.4, 0.6)),
        Row("u-stair", "0.4-0.6 m/s one floor up and down", 0.90, storey, ((0, 2), (2, 0)), (0.4, 0.6)),
    ]


class Cycles:
    """Mean velocity of robots over whole gait cycles, and how far they got along their commands."""

    def __init__(self, robots: Humanoids, ticks: int, dt: float) -> None:
        n = robots.count
        self._robots, self._ticks, self._dt = robots, ticks, dt
        self._from, self._yaw = robots.pelvis[:, :2].clone(), heading_of(robots.orientation)
        self._asked, self._turned, self._ticked = torch.zeros(n, 3), torch.zeros(n), 0
        self._last = self._yaw.clone()
        self.error, self.turn_error, self.count = torch.zeros(n), torch.zeros(n), torch.zeros(n)
        self.covered, self.wanted = torch.zeros(n, 2), torch.zeros(n, 2)

    def add(self, command: Tensor, alive: Tensor) -> None:
        """Record one control step under `command` (n, 3); robots not `alive` (n,) are left out."""
        yaw = heading_of(self._robots.orientation)
        self._turned += wrap(yaw - self._last)
        self._asked += command * self._dt
        self._last = yaw
        self._ticked += 1
        if self._ticked % self._ticks:
            return
        time = self._ticks * self._dt
        # A command that turns moves along an arc: compare with its chord's direction, at the mean heading.
        move = turn_xy(self._robots.pelvis[:, :2] - self._from, -(self._yaw + self._turned / 2))
        self.error += alive * (move - self._asked[:, :2]).norm(dim=1) / time
        self.turn_error += alive * (self._turned - self._asked[:, 2]).abs() / time
        self.count += alive
        length = self._asked[:, :2].norm(dim=1)
        along = (move * self._asked[:, :2]).sum(1) / length.clamp(min=1e-6)
        self.covered += alive[:, None] * torch.stack([along, self._turned * self._asked[:, 2].sign()], dim=1)
        self.wanted += alive[:, None] * torch.stack([length, self._asked[:, 2].abs()], dim=1)
        self._from, self._yaw = self._robots.pelvis[:, :2].clone(), yaw
        self._asked, self._turned = torch.zeros_like(self._asked), torch.zeros_like(self._turned)


def run_row(
    row: Row, spec: LocomotionSpec, policy: Callable[[Tensor], Tensor], trials: int, seed: int, threads: int = 0
) -> dict[str, Any]:
    """Run the trials of one row; see `evaluate`."""
    random = torch.Generator().manual_seed(seed)
    ground = Ground(list(row.lanes))
    robots = Humanoids(spec.robot.model_copy(update={"friction": 0.8}), [ground.geoms], trials, threads=threads)
    control = Controller(spec, robots)
    index = torch.arange(trials)
    lane = index % len(row.lanes)
    level = row.terrain == "flat"
    speed = row.speed[0] + (row.speed[1] - row.speed[0]) * torch.rand(trials, generator=random)
    corners = torch.cartesian_prod(
        torch.tensor(spec.task.forward), *(torch.tensor([-x, x]) for x in (spec.task.lateral, spec.task.turn))
    )
    if level:
        start = goal = torch.zeros(trials)
        command = corners[index % len(corners)]
        limit = torch.full((trials,), round(20.0 / control.dt))
    else:
        legs = torch.tensor(row.legs)[(index // len(row.lanes)) % len(row.legs)]
        start, goal = ground.spawn[lane, legs[:, 0]], ground.spawn[lane, legs[:, 1]]
        command = torch.stack([speed, torch.zeros(trials), torch.zeros(trials)], dim=1)
        limit = (ALLOWANCE * (goal - start).abs() / speed / control.dt).long()
    forward = torch.where(goal >= start, 1.0, -1.0)
    arc = start.clone()
    at, ahead = ground.at(lane, start), ground.at(lane, start + 0.1 * forward)
    heading = torch.atan2(*(ahead - at).flip(1).unbind(1)) + 0.1 * (2 * torch.rand(trials, generator=random) - 1)
    clock = torch.randint(0, 2, (trials,), generator=random) * spec.gait.step_ticks
    z = ground.map(at, torch.full((trials,), 99.0))
    control.stand(index, torch.cat([at, z[:, None]], dim=1), heading, clock, command)

    alive, fell = torch.ones(trials, dtype=torch.bool), torch.zeros(trials, dtype=torch.bool)
    arrived = torch.zeros_like(fell)
    cycles = Cycles(robots, 2 * spec.gait.step_ticks, control.dt)
    for tick in range(int(limit.max())):
        xy = robots.pelvis[:, :2]
        if not level:
            arc = ground.project(lane, xy, arc)
            command = steer(ground, lane, arc, forward, xy, heading_of(robots.orientation), speed)
        control.refer(command, ground.map, torch.full((trials,), tick == 0))
        control.act(policy(control.observe(command, ground.map)), alive.nonzero()[:, 0])
        fell |= alive & has_fallen(robots)
        if not level:
            near = (robots.pelvis[:, :2] - ground.at(lane, goal)).norm(dim=1) < 0.5
            arrived |= alive & ~fell & near
        alive &= ~fell & ~arrived & (tick + 1 < limit)
        cycles.add(command, alive)
        if not alive.any():
            break
    if level:
        enough = cycles.covered >= 0.8 * cycles.wanted
        arrived = ~fell & enough.all(1) & (cycles.covered[:, 1] <= 1.25 * cycles.wanted[:, 1])
    whole = cycles.count.clamp(min=1)
    return {
        "terrain": row.terrain,
        "command": row.command,
        "trials": trials,
        "crossed": arrived.double().mean().item(),
        "fell": fell.double().mean().item(),
        "target": row.target,
        "velocity_error": (cycles.error / whole)[cycles.count > 0].mean().item(),
        "yaw_error": (cycles.turn_error / whole)[cycles.count > 0].mean().item(),
    }


def evaluate(
    checkpoint: Path,
    *,
    trials: int = 200,
    seed: int = 0,
    threads: int = 0,
    only: tuple[str, ...] = (),
    progress: Progress | None = None,
) -> list[dict[str, Any]]:
    """Test a checkpoint: deterministic policy, no pushes, friction 0.8, no payload.

    A trial starts on its feet on level ground, beginning a step. It is *crossed* when the pelvis comes within
    0.5 m of the middle of the far landing without a fall, within 1.5 times the commanded time; on the flat,
    when 20 s pass without a fall and the net displacements of the gait cycles add up to at least 80 % of the
    command, and the turn to 80-125 % of it.

    Args:
        checkpoint: written by `train`.
        trials: per row.
        seed: of speeds, headings and first feet.
        threads: of the physics; they do not change the result.
        only: terrains to run; all when empty.
        progress: told the rows done, their number, and the terrain.

    Returns:
        Rows of `terrain`, `command`, `trials`, `crossed`, `fell`, `target` (shares from 0 to 1),
        `velocity_error`, m/s, and `yaw_error`, rad/s (means over whole gait cycles).
    """
    spec, policy, _ = load_policy(checkpoint)
    chosen = [row for row in rows() if not only or row.terrain in only]
    results = []
    for row in chosen:
        results.append(run_row(row, spec, policy, trials, seed, threads))
        if progress:
            progress(len(results), len(chosen), row.terrain)
    return results
