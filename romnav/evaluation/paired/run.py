"""Every arm walks the same episodes, one row each (paper, Sec. IV-A)."""

from __future__ import annotations

import torch
from numpy.typing import NDArray

from romnav.evaluation.episodes import EpisodeSet
from romnav.evaluation.rollout import Driver, Outcomes, View
from romnav.evaluation.spec import EvaluationSpec
from romnav.evaluation.tracks import Recorder
from romnav.navigation.spec import EnvSpec
from romnav.progress import Progress
from romnav.robot.dynamics import Body
from romnav.robot.rom import ReducedOrderModel
from romnav.threads import torch_threads
from romnav.world.world import World

BUSY = 0.75
"""Share of the rows that run at least: dropping the others costs copies, so it is not done at once."""


@torch.inference_mode()
def run(
    driver: Driver,
    world: World,
    episodes: EpisodeSet,
    env: EnvSpec,
    spec: EvaluationSpec,
    progress: Progress | None = None,
    body: Body = ReducedOrderModel,
    recorder: Recorder | None = None,
) -> dict[str, NDArray]:
    """Drive all ``episodes`` once on robots that ``body`` makes, and let ``recorder`` keep their tracks.

    An episode ends at success, at a fall or after ``spec.duration``.

    Returns:
        One array (n,) per column of the episode rows that a rollout measures: those of `Outcomes` and collisions.
    """
    with torch_threads(spec.threads):
        return _run(driver, world, episodes, env, spec, progress, body, recorder)


def _run(
    driver: Driver,
    world: World,
    episodes: EpisodeSet,
    env: EnvSpec,
    spec: EvaluationSpec,
    progress: Progress | None,
    body: Body,
    recorder: Recorder | None,
) -> dict[str, NDArray]:
    view = View(world, episodes, env, body(world, len(episodes), env.period))
    outcomes = Outcomes(view, spec.duration, spec.reach)
    collisions = torch.zeros(len(episodes), dtype=torch.int64, device=view.goal.device)
    if recorder:
        recorder.add(view, outcomes.alive())
    for step in outcomes.steps(progress):
        robot = view.robot
        command = driver.command(view)
        before = robot.position[:, :2]
        robot.step(command)
        view.previous = command
        view.step = step
        collisions[view.episode] += ((robot.contacts > 0) & outcomes.alive()).long()
        if recorder:
            recorder.add(view, outcomes.alive())
        outcomes.add(before)
        if 0 < outcomes.left < BUSY * len(view.episode):
            keep = outcomes.alive().nonzero()[:, 0]
            view.select(keep)
            driver.select(keep)
    return {**outcomes.columns(), "collisions": collisions.cpu().numpy()}
