"""Trials of the stairwell and outdoors from other starts on the way: where does a policy lose it?

    python tools/on_the_way.py rom-7x
    python tools/on_the_way.py rom-far --file kept/000384.pt --trials 16

Each start has as many trials without the safety filter and with it; the log of experiments (docs/experiments.md) says
what was found by it.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from romnav.errors import RomnavError
from romnav.evaluation.rollout import Policy
from romnav.evaluation.spec import DeploymentSpec
from romnav.evaluation.trials.run import run
from romnav.experiment.kinds.policy import perception, policy
from romnav.experiment.project import Project
from romnav.experiment.workspace import Workspace
from romnav.navigation import checkpoint
from romnav.world.scenes.deployments import deployment_scenes
from romnav.world.scenes.scene import Area, Scene, scene_world
from romnav.world.tiles.site import Frame

ROOT = Path(__file__).parents[1]


def starts() -> list[Scene]:
    """The stairwell and outdoors, from their own starts and from others."""
    _, stairwell, _, outdoors = deployment_scenes()
    hall = Frame(18.0, 22.0)
    areas = {
        "stairwell, hall": Area(hall.sub(13.0, 6.0), (2.0, 2.0)),
        "stairwell, foot of the stairs": Area(hall.sub(15.2, 4.2), (1.4, 1.4)),
        "stairwell, floor between": Area(hall.sub(13.0, 6.0), (2.0, 2.0), 3.5),
        "stairwell, goal's floor": Area(hall.sub(13.0, 6.0), (2.0, 2.0), 7.0),
    }
    above = replace(stairwell, name="stairwell, goal above the stairs", goal=Area(hall.sub(23.5, 8.5), (1.0, 1.0), 7.0))
    others = [replace(stairwell, name=name, start=area) for name, area in areas.items()]
    return [stairwell, *others, above, outdoors]


def main() -> None:
    """Print a row for every start."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("arm", help="trained arm on the reduced-order model")
    parser.add_argument("--file", default="policy.pt", help="policy in the arm's folder")
    parser.add_argument("--scale", default="cpu")
    parser.add_argument("--trials", type=int, default=16)
    chosen = parser.parse_args()

    work = Workspace(Project(ROOT, ROOT / "results"), chosen.scale)
    scenes = starts()
    world = scene_world(scenes)
    trained, settings = policy(work, chosen.arm, 0), work.arm_settings(chosen.arm)
    seen = perception(work, trained, settings, world, noise=0, device="cpu")
    driver = Policy(checkpoint.load_actor(trained.folder / chosen.file, seen.encoder), seen)
    columns = run(driver, scenes, world, settings.navigation.env, DeploymentSpec(trials=max(chosen.trials, 1)))
    for scene in scenes:
        of = columns["scene"] == scene.name
        arrived = (columns["outcome"][of] == "success").sum()
        highest = [np.asarray(track).reshape(-1, 3)[:, 2].max() / 100 for track in columns["track"][of]]
        print(
            f"{scene.name}: {columns['geodesic'][of].mean():.0f} m, arrived {arrived} of {of.sum()}, "
            f"above 3 m {sum(z > 3.0 for z in highest)}, above 6.5 m {sum(z > 6.5 for z in highest)}"
        )


if __name__ == "__main__":
    try:
        main()
    except RomnavError as error:
        sys.exit(f"error: {error}")
