"""Driving robots through episodes: what a driver sees, and how episodes end."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict
from torch import Tensor

from romnav.evaluation.episodes import EpisodeSet
from romnav.evaluation.scripted import straight_direction, walk
from romnav.navigation.env import to_command
from romnav.navigation.observations import observe
from romnav.navigation.perception import Perception
from romnav.navigation.policy import NavigationActor
from romnav.navigation.spec import EnvSpec
from romnav.progress import Progress
from romnav.robot.dynamics import Dynamics
from romnav.robot.rom import ReducedOrderModel
from romnav.world.lookup import GeodesicLookup
from romnav.world.world import World


class Driver(Protocol):
    """What commands the robots of a rollout."""

    def command(self, view: View) -> Tensor:
        """(A, 3) velocity command of the ``A`` episodes still running."""
        ...

    def select(self, keep: Tensor) -> None:
        """Drop the memory of all but the rows ``keep``."""
        ...


class View:
    """What a driver may look at: the running episodes of a rollout, by row. Robots are reduced-order by default."""

    def __init__(self, world: World, episodes: EpisodeSet, env: EnvSpec, robot: Dynamics | None = None) -> None:
        device = str(world.node.device)
        start = episodes.start(device)
        count = len(episodes)
        self.env = env
        self.world = world
        self.episode = torch.arange(count, device=device)
        self.noise = self.episode
        """(A,) names the sensor noise of each row."""
        self.robot = robot or ReducedOrderModel(world, count, env.period)
        self.robot.reset(self.episode, start)
        self.goal = start.goal
        self.goal_position = world.position[world.goal[start.goal]]
        self.goal_yaw = start.goal_yaw
        self.previous = torch.zeros(count, 3, device=device)
        self.step = 0
        self._lookup = GeodesicLookup(world)

    def geodesic(self) -> tuple[Tensor, Tensor]:
        """Distance (A,) to the goal and direction (A, 2) of the shortest path."""
        r = self.robot
        return self._lookup(r.tile, r.layer, r.position[:, :2], self.goal)

    def counters(self) -> Tensor:
        """(A, 2) environment and step, which name the sensors' noise."""
        return torch.stack([self.noise, torch.full_like(self.noise, self.step)], dim=1)

    def select(self, keep: Tensor) -> None:
        """Keep only the rows ``keep``."""
        self.robot.select(keep)
        for name in ("episode", "noise", "goal", "goal_position", "goal_yaw", "previous"):
            setattr(self, name, getattr(self, name)[keep])


class Policy:
    """A trained policy, acting by the mean of its distributions."""

    def __init__(self, actor: NavigationActor, perception: Perception) -> None:
        self.actor = actor
        self.perception = perception
        perception.images = actor.encoder is not None
        actor.reset()

    def command(self, view: View) -> Tensor:
        """(A, 3) velocity command."""
        return to_command(self.actor(self.observe(view)), view.env.command)

    def observe(self, view: View) -> TensorDict:
        """What the policy knows of the ``A`` running episodes."""
        goal = view.goal_position, view.goal_yaw
        return observe(view.robot, *goal, view.previous, view.counters(), self.perception, view.env.max_goal_distance)

    def select(self, keep: Tensor) -> None:
        """Drop the memory of all but the rows ``keep``."""
        self.actor.select(keep)


class Oracle:
    """Descends the geodesic field; what remains of its failures is the world's, the dynamics' or the metric's."""

    def command(self, view: View) -> Tensor:
        """(A, 3) velocity command."""
        distance, direction = view.geodesic()
        return walk(direction, view.robot.yaw, distance, view.env.command, view.env.period)

    def select(self, keep: Tensor) -> None:
        """Nothing to drop."""


class Straight:
    """Turns to the goal and walks: what needs no perception."""

    def command(self, view: View) -> Tensor:
        """(A, 3) velocity command."""
        offset = (view.goal_position - view.robot.position)[:, :2]
        direction = straight_direction(view.robot.position, view.goal_position)
        distance = torch.linalg.vector_norm(offset, dim=1)
        return walk(direction, view.robot.yaw, distance, view.env.command, view.env.period)

    def select(self, keep: Tensor) -> None:
        """Nothing to drop."""


SCRIPTED: dict[str, type[Oracle] | type[Straight]] = {"oracle": Oracle, "straight": Straight}


def step_limit(duration: float, period: float) -> int:
    """Steps of ``period`` that fit into ``duration``, both in s."""
    return math.floor(duration / period + 1e-6)


class Outcomes:
    """How and when the episodes of a view end, and the way that they took."""

    def __init__(self, view: View, duration: float, reach: float) -> None:
        """Starts the count.

        Args:
            view: All episodes, none of them ended.
            duration: Longest episode, s.
            reach: Distance to the goal that is success, in 3D, m.
        """
        count, device = len(view.episode), view.goal.device
        self._view, self._reach = view, reach
        self._limit = step_limit(duration, view.env.period)
        self._success_time = torch.full((count,), torch.nan, dtype=torch.float64, device=device)
        self._time = torch.full((count,), duration, dtype=torch.float64, device=device)
        self._path = torch.zeros(count, dtype=torch.float64, device=device)
        self._final = torch.zeros(count, dtype=torch.float64, device=device)
        self._fell = torch.zeros(count, dtype=torch.bool, device=device)
        self._running = torch.ones(count, dtype=torch.bool, device=device)
        self.left = count
        """Episodes that still run."""

    def steps(self, progress: Progress | None) -> Iterator[int]:
        """Numbers of the steps, from 1, until no episode runs."""
        for step in range(1, self._limit + 1):
            yield step
            if progress:
                reached = float((~self._success_time.isnan()).double().mean())
                progress(step if self.left else self._limit, self._limit, f"reached {reached:.0%}, running {self.left}")
            if not self.left:
                return

    def alive(self) -> Tensor:
        """(A,) the episode of a row of the view still runs."""
        return self._running[self._view.episode]

    def add(self, before: Tensor) -> None:
        """Counts the step that the robots just made from ``before`` (A, 2), m."""
        view, robot, row, alive = self._view, self._view.robot, self._view.episode, self.alive()
        moved = torch.linalg.vector_norm(robot.position[:, :2] - before, dim=1).double()
        self._path[row] += torch.where(alive, moved, 0.0)
        distance = torch.linalg.vector_norm(view.goal_position - robot.position, dim=1)
        reached = (distance < self._reach) & alive & ~robot.fallen
        over = alive & robot.fallen
        now = view.step * view.env.period
        self._success_time[row[reached]] = now
        self._time[row[reached | over]] = now
        self._fell[row[over]] = True
        ended = reached | over | (alive & (view.step == self._limit))
        if ended.any():
            self._final[row[ended]] = view.geodesic()[0].double()[ended]
            self._running[row[ended]] = False
            self.left = int(self._running.sum())

    def columns(self) -> dict[str, NDArray]:
        """One array (n,) for each of outcome, success_time, time, path_length (planar, sampled once per period) and
        final_distance (geodesic)."""
        success = ~self._success_time.isnan().cpu().numpy()
        measured = {
            "success_time": self._success_time,
            "time": self._time,
            "path_length": self._path,
            "final_distance": self._final,
        }
        return {
            "outcome": np.where(success, "success", np.where(self._fell.cpu().numpy(), "fall", "timeout")),
            **{name: value.cpu().numpy() for name, value in measured.items()},
        }
