"""Trials in scenes: the same starts and goals with the safety filter off and on, collisions on true geometry.

What the paper does on hardware (Sec. IV-C, IV-D), with as many trials as an interval takes. Both halves run in one
batch and meet the same sensor noise, so that a trial with the filter on is the one with it off until the filter acts.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from romnav import random
from romnav.evaluation.episodes import EpisodeSet
from romnav.evaluation.rollout import Driver, Outcomes, View, step_limit
from romnav.evaluation.shield import Shield
from romnav.evaluation.spec import TrialSpec
from romnav.navigation.spec import EnvSpec
from romnav.progress import Progress
from romnav.robot.body import BodyModel
from romnav.robot.dynamics import Dynamics
from romnav.robot.spec import RobotSpec
from romnav.safety.barrier import Status
from romnav.threads import torch_threads
from romnav.world.geodesic import UNIT
from romnav.world.lookup import GeodesicLookup
from romnav.world.scenes.scene import Scene
from romnav.world.world import World

APART = 1.0
"""Contacts this long apart are two collisions, s."""
HELD = 0.05, 0.2
"""The filter holds the robot where it leaves less than the first of more than the second speed, m/s."""
STUCK = 10.0, 0.5
"""A robot is stuck that in so long a time, s, came no further than so far, m."""

_NODE, _INSIDE_X, _INSIDE_Y, _GOAL, _HEADING, _GOAL_YAW = range(6)


def draw(scenes: Sequence[Scene], world: World, spec: TrialSpec) -> EpisodeSet:
    """``spec.trials`` starts and goals for every scene of ``world``, scene after scene.

    A draw names the same place in scenes whose areas have the same free cells. Robots start heading along the shortest
    path to their goal, give or take ``spec.heading``; the heading to arrive with is any.
    """
    trial = torch.arange(spec.trials)
    parts = []
    for index, (scene, grid) in enumerate(zip(scenes, world.grids, strict=True)):
        nodes = [torch.from_numpy(np.flatnonzero(a.contains(grid.position))) for a in (scene.start, scene.goal)]
        first = int(world.node_start[index])
        goals = world.goal[world.goal_start[index] : world.goal_start[index + 1]] - first
        back = (trial % 2).bool() if scene.both_ways else torch.zeros_like(trial, dtype=torch.bool)

        def pick(from_: Tensor, draw: int) -> Tensor:
            return from_[random.integers(len(from_), spec.seed, trial, draw)]

        spawn = torch.where(back, pick(nodes[1], _NODE), pick(nodes[0], _NODE)) + first
        ends = [torch.isin(goals, n).nonzero()[:, 0] for n in reversed(nodes)]
        goal = pick(ends[0], _GOAL)
        if scene.both_ways:
            goal = torch.where(back, pick(ends[1], _GOAL), goal)
        inside = torch.stack([random.uniform(spec.seed, trial, k) for k in (_INSIDE_X, _INSIDE_Y)], dim=1) - 0.5
        xy = world.position[spawn, :2] + 0.98 * world.cell * inside
        parts.append((torch.full_like(trial, index), spawn, xy, goal + world.goal_start[index]))
    tile, spawn, xy, goal = (torch.cat(part) for part in zip(*parts, strict=True))
    layer = world.layer[spawn]
    _, along = GeodesicLookup(world)(tile, layer, xy, goal)
    number = trial.repeat(len(scenes))
    turn = (2.0 * random.uniform(spec.seed, number, _HEADING) - 1.0) * spec.heading
    length = world.fields[world.field_start[goal] + spawn - world.node_start[tile]].to(torch.float64) * UNIT
    start, end = world.position[spawn], world.position[world.goal[goal]]
    columns = {
        "tile": tile,
        "layer": layer,
        **{f"spawn_{axis}": column for axis, column in zip("xyz", (*xy.T, start[:, 2]), strict=True)},
        "spawn_yaw": torch.atan2(along[:, 1], along[:, 0]) + turn,
        "goal": goal,
        **{f"goal_{axis}": column for axis, column in zip("xyz", end.T, strict=True)},
        "goal_yaw": 2.0 * torch.pi * random.uniform(spec.seed, number, _GOAL_YAW),
        "geodesic": length,
    }
    name = "+".join(scene.name for scene in scenes)
    return EpisodeSet(name, world.spec, {key: value.numpy() for key, value in columns.items()})


class TrialRobot(Dynamics, Protocol):
    """A body for trials."""

    @property
    def brink(self) -> Tensor:
        """(E,) bool a drop-off stopped it in the last step, in place of a fall."""
        ...


TrialBody = Callable[[World, int, float], TrialRobot]
"""Makes the robots of a world, a number of them and a control period, s."""


@dataclass
class _Log:
    """What is recorded of ``R`` trials over at most ``K`` steps, on the CPU."""

    track: NDArray[np.int16]
    """(K + 1, R, 3) positions, cm."""
    contact: NDArray[np.bool_]
    """(K, R) a solid is touched."""
    brink: NDArray[np.bool_]
    """(K, R) a drop-off stops the robot."""
    acts: NDArray[np.bool_]
    """(K, R) the filter changes the command."""
    holds: NDArray[np.bool_]
    """(K, R) the filter leaves next to nothing of it, see `HELD`."""

    @classmethod
    def of(cls, steps: int, trials: int) -> _Log:
        flags = [np.zeros((steps, trials), bool) for _ in range(4)]
        return cls(np.zeros((steps + 1, trials, 3), np.int16), *flags)


@torch.inference_mode()
def run(
    driver: Driver,
    scenes: Sequence[Scene],
    world: World,
    env: EnvSpec,
    spec: TrialSpec,
    progress: Progress | None = None,
    body: TrialBody | None = None,
    arms: RobotSpec | None = None,
) -> dict[str, NDArray]:
    """Drive every trial of ``scenes`` with the filter off and on; a trial ends at success, at a fall or after
    ``spec.duration``. Robots are those that ``body`` makes, with the arms of ``arms``; by default cylinders.

    The driver's memory of its previous command is its own, not the filtered one.

    Returns:
        One array (2 x scenes x trials,) per column of `romnav.evaluation.trials.rows` that a run measures.
    """
    with torch_threads(spec.threads):
        episodes = draw(scenes, world, spec)
        twice = replace(episodes, columns={k: np.tile(v, 2) for k, v in episodes.columns.items()})
        count = len(twice)
        filtered = np.arange(count) >= len(episodes)
        names = np.array([scene.name for scene in scenes], object)
        kept = [name for name in twice.columns if name.startswith(("spawn_", "goal_")) or name == "geodesic"]
        robot = (body or partial(BodyModel, body=spec.body))(world, count, env.period)
        view = View(world, twice, env, robot)
        shield = Shield(world, int(filtered.sum()), spec, env, arms)
        measured, log = _drive(driver, view, robot, shield, torch.from_numpy(filtered), spec, progress)
        return {
            "scene": names[twice.columns["tile"]],
            "filter": filtered,
            "trial": np.tile(np.arange(spec.trials), 2 * len(scenes)),
            **{name: twice.columns[name].astype(np.float64) for name in kept},
            **measured,
            **_summarise(log, measured["time"], measured["outcome"], env.period),
        }


def _drive(
    driver: Driver,
    view: View,
    robot: TrialRobot,
    shield: Shield,
    filtered: Tensor,
    spec: TrialSpec,
    progress: Progress | None,
) -> tuple[dict[str, NDArray], _Log]:
    count, limit = len(view.episode), step_limit(spec.duration, view.env.period)
    view.noise = view.episode % (count // 2)
    filtered = filtered.to(view.episode.device)
    guarded = filtered.nonzero()[:, 0]
    outcomes = Outcomes(view, spec.duration, spec.reach)
    log = _Log.of(limit, count)
    log.track[0] = _centimetres(robot.position)
    for step in outcomes.steps(progress):
        command = driver.command(view)
        executed = command.clone()
        alive = outcomes.alive()
        if len(guarded):
            wanted = command[guarded, :2]
            safe = shield(robot, guarded, wanted, view.noise[guarded], step)
            executed[guarded, :2] = safe.velocity
            at = view.episode[guarded].cpu().numpy()
            live = alive[guarded]
            log.acts[step - 1, at] = ((safe.status != Status.UNCHANGED) & live).cpu().numpy()
            left, asked = (torch.linalg.vector_norm(v, dim=1) for v in (safe.velocity, wanted))
            log.holds[step - 1, at] = ((left < HELD[0]) & (asked > HELD[1]) & live).cpu().numpy()
        before = robot.position[:, :2]
        robot.step(executed)
        view.previous = command
        view.step = step
        at = view.episode.cpu().numpy()
        log.track[step, at] = _centimetres(robot.position)
        log.contact[step - 1, at] = ((robot.contacts > 0) & alive).cpu().numpy()
        log.brink[step - 1, at] = (robot.brink & alive).cpu().numpy()
        outcomes.add(before)
        if 0 < outcomes.left < 0.85 * len(view.episode):
            alive = outcomes.alive()
            keep, kept_guarded = (rows.nonzero()[:, 0] for rows in (alive, alive[guarded]))
            view.select(keep)
            driver.select(keep)
            if len(kept_guarded):
                shield.select(kept_guarded)
            guarded = filtered[view.episode].nonzero()[:, 0]
    return outcomes.columns(), log


def _centimetres(position: Tensor) -> NDArray[np.int16]:
    return (position * 100.0).round().to(torch.int16).cpu().numpy()


def _summarise(log: _Log, time: NDArray, outcome: NDArray, period: float) -> dict[str, NDArray]:
    """Columns of rows from what was recorded step by step."""
    count = len(time)
    steps = np.round(time / period).astype(int)
    apart, window = round(APART / period), round(STUCK[0] / period)
    hits = np.empty(count, object)
    tracks = np.empty(count, object)
    blocked = np.zeros(count, bool)
    for k in range(count):
        touching = np.flatnonzero(log.contact[:, k])
        hits[k] = touching[np.diff(touching, prepend=-apart - 1) > apart].astype(np.int16) + 1
        tracks[k] = log.track[: steps[k] + 1, k].ravel()
        if outcome[k] == "timeout" and steps[k] > window:
            came = log.track[steps[k], k].astype(float) - log.track[steps[k] - window, k]
            held = log.holds[steps[k] - window : steps[k], k].mean()
            blocked[k] = np.linalg.norm(came[:2]) < 100 * STUCK[1] and held >= 0.5
    return {
        "collisions": np.array([len(h) for h in hits]),
        "contact_time": log.contact.sum(axis=0) * period,
        "brink_time": log.brink.sum(axis=0) * period,
        "acting_time": log.acts.sum(axis=0) * period,
        "held_time": log.holds.sum(axis=0) * period,
        "blocked": blocked,
        "hits": hits,
        "track": tracks,
    }
