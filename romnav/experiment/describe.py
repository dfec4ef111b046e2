"""The terrain of an experiment, told before hours are spent on it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from romnav.errors import RomnavError
from romnav.evaluation.difficulty import Difficulty, measure, tally
from romnav.experiment.scales import Scale
from romnav.experiment.workspace import Workspace
from romnav.progress import Progress
from romnav.world.build import build
from romnav.world.spec import SamplerSpec


@dataclass(frozen=True)
class Description:
    """A world, and what the samplers of an experiment make of it."""

    difficulty: Difficulty
    terrain: dict[str, Any]
    """`romnav.evaluation.difficulty.tally` of the world."""

    def plain(self) -> dict[str, Any]:
        """As plain data: shares from 0 to 1, success in percent, m, s, MB."""
        return {
            "samplers": {name: goals.shares() for name, goals in self.difficulty.goals.items()},
            "oracle_t2g": self.difficulty.oracle_t2g,
            "straight_sr_120_same": self.difficulty.straight_sr_120_same,
            **self.terrain,
        }


def describe_world(work: Workspace, experiment: str, progress: Progress | None = None) -> Description:
    """Builds the training terrain of an experiment and measures it with every sampler that differs, by arm.

    Raises:
        RomnavError: There is no such experiment, or its arms are trained on terrain of their own.
    """
    samplers: dict[str, SamplerSpec] = {}
    shared: Scale | None = None
    for arm in work.project.experiment(experiment).arms:
        settings = work.arm_settings(arm)
        shared = shared or settings
        if settings.ground != shared.ground:
            raise RomnavError(
                f"{work.project.file(experiment)}: arms.{arm} has another terrain (world, navigation.tiles) than the "
                "first arm; describe an experiment whose arms share one world"
            )
        if settings.navigation.env.sampler not in samplers.values():
            samplers[arm] = settings.navigation.env.sampler
    if shared is None:
        raise RomnavError(f"{work.project.file(experiment)}: key arms is empty")
    world = build(shared.ground, work.project.worlds, progress)
    return Description(measure(world, samplers, shared.navigation.env, shared.evaluation), tally(world))
