"""Judges policies for choices: on more goals than `dev` has, all across levels, where the gap is.

    python tools/choose.py rom-5x rom-6x                      # arms of the cpu scale
    python tools/choose.py rom-6x --file kept/000768.pt       # another policy of its folder
    python tools/choose.py rom-6x --factor 1 1.2 --act mean mode --forget 15

2,048 goals across levels on `dev`'s terrain, another draw with other sensor noise: about one point of standard error
for the difference of two policies. The log of experiments (docs/experiments.md) says what was chosen by it.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from torch import Tensor

from romnav.errors import RomnavError
from romnav.evaluation.episodes import draw, load, terrain
from romnav.evaluation.paired.run import run
from romnav.evaluation.rollout import Policy, View
from romnav.evaluation.spec import EpisodeSetSpec
from romnav.experiment.kinds.policy import perception, policy
from romnav.experiment.project import Project
from romnav.experiment.workspace import Workspace
from romnav.navigation import checkpoint
from romnav.navigation.env import to_command

ROOT = Path(__file__).parents[1]
DEV = ROOT / "experiments" / "episodes" / "dev.json"
SEED, NOISE = 4242, 7
"""Of the draw and of the sensors' noise."""


class Altered(Policy):
    """A policy that acts in another way than it is evaluated in, or forgets."""

    act, factor, forget = "mean", 1.0, float("inf")

    def command(self, view: View) -> Tensor:
        """(A, 3) velocity command."""
        # episodes all begin at once, so one clock does for all memories
        clock = view.step * view.env.period
        if clock // self.forget > (clock - view.env.period) // self.forget >= 0:
            self.actor.reset()
        alpha, beta = (parameters.float() for parameters in self.actor.beta(self.observe(view)).unbind(-2))
        if self.act == "mode":
            alpha, beta = alpha - 1.0, beta - 1.0
        low, high = self.actor.distribution.action_range
        action = low + (high - low) * alpha / (alpha + beta)
        return to_command(self.factor * action, view.env.command)


def positive(text: str) -> float:
    """A number above 0, for argparse."""
    if (number := float(text)) > 0.0:
        return number
    raise argparse.ArgumentTypeError(f"{text} is not above 0")


def main() -> None:
    """Print a row for every policy and way of acting."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("arms", nargs="+", help="trained arms")
    parser.add_argument("--file", default="policy.pt", help="policy in the arm's folder")
    parser.add_argument("--scale", default="cpu")
    parser.add_argument("--act", nargs="+", choices=("mean", "mode"), default=["mean"], help="of the Betas")
    parser.add_argument("--factor", nargs="+", type=positive, default=[1.0], help="on actions, before they are cut")
    parser.add_argument("--forget", nargs="+", type=positive, default=[float("inf")], help="all memory every so many s")
    parser.add_argument("--goals", type=positive, default=2048)
    chosen = parser.parse_args()

    dev = load(DEV)
    work = Workspace(Project(ROOT, ROOT / "results"), chosen.scale)
    world = terrain(dev, DEV, work.project.worlds)
    count = max(round(chosen.goals), 1)
    spec = EpisodeSetSpec(world=dev.world, episodes=count, cross=count, seed=SEED)
    episodes = draw("choose", spec, world)
    for arm in chosen.arms:
        trained, settings = policy(work, arm, 0), work.arm_settings(arm)
        seen = perception(work, trained, settings, world, noise=NOISE, device="cpu")
        for act in chosen.act:
            for factor in chosen.factor:
                for forget in chosen.forget:
                    driver = Altered(checkpoint.load_actor(trained.folder / chosen.file, seen.encoder), seen)
                    driver.act, driver.factor, driver.forget = act, factor, forget
                    out = run(driver, world, episodes, settings.navigation.env, settings.evaluation)
                    time, path = out["success_time"], out["path_length"]
                    there = np.isfinite(time)
                    print(
                        f"{arm} {chosen.file}, {act} x {factor:g}, forgets every {forget:g} s: "
                        f"SR@45 {100 * np.mean(time <= 45.0):.1f}, SR@120 {100 * there.mean():.1f}, "
                        f"T2G {time[there].mean():.1f} s, {path[there].sum() / time[there].sum():.3f} m/s",
                        flush=True,
                    )


if __name__ == "__main__":
    try:
        main()
    except RomnavError as error:
        sys.exit(f"error: {error}")
