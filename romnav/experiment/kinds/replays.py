"""Single episodes of an arm again, for everything that evaluation does not keep."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from romnav.errors import RomnavError
from romnav.experiment.kinds._driven import Driven
from romnav.experiment.kinds.encoder import encoder
from romnav.experiment.kinds.episodes import episode_set, ground, paired_set, read_ways
from romnav.experiment.workspace import Workspace
from romnav.progress import Progress, bar

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from romnav.evaluation.episodes import EpisodeSet
    from romnav.evaluation.paired.replay import Replay, Sight
    from romnav.evaluation.postures import Postures
    from romnav.evaluation.rollout import Driver
    from romnav.evaluation.tracks import Tracks
    from romnav.navigation.ppo import PrivilegedCritic
    from romnav.world.world import World


class Again:
    """An arm, trained or scripted, on the episodes that tables are made of."""

    def __init__(self, work: Workspace, arm: str, seed: int) -> None:
        self._driven = Driven.by(work, arm, seed)
        self.settings = self._driven.settings

    @cached_property
    def ground(self) -> tuple[EpisodeSet, World]:
        """The episodes and their terrain."""
        work = self._driven.work
        return ground(paired_set(work), work.project.worlds)

    @cached_property
    def _ways(self) -> tuple[Tracks | None, Postures | None]:
        """Tracks of the evaluation, if it was on these episodes, and postures, if they were kept."""
        if not (self._driven.folder / "tracks.npz").exists():
            return None, None
        tracks, postures, provenance = read_ways(self._driven.folder)
        return (tracks, postures) if provenance["episode_set"] == self.ground[0].digest else (None, None)

    @cached_property
    def _critic(self) -> PrivilegedCritic | None:
        """Of the policy, if its file has one."""
        from romnav.navigation.checkpoint import load_critic

        trained = self._driven.policy
        return load_critic(trained.folder / "policy.pt") if trained else None

    @cached_property
    def _driver(self) -> Driver:
        return self._driven.driver(self.ground[1], "cpu")

    def drive(self, episode: int, *, guarded: bool = False, progress: Progress | None = None) -> Replay:
        """An episode, led along its recorded way if there is one, a safety filter looking on if it is ``guarded``.

        Raises:
            RomnavError: The arm is not trained, or there is no such episode.
        """
        from romnav.evaluation.paired.replay import replay
        from romnav.evaluation.rollout import Policy
        from romnav.evaluation.shield import Shield

        self._check(episode)
        paired, world = self.ground
        driver, settings = self._driver, self.settings
        if isinstance(driver, Policy):
            driver.actor.reset()
        walks = settings.navigation.dynamics == "g1"
        robot, env = settings.locomotion.robot, settings.navigation.env
        tracks, postures = self._ways
        shield = Shield(world, 1, settings.safety, env, robot if walks else None) if guarded else None
        return replay(
            driver,
            world,
            paired,
            episode,
            env,
            settings.evaluation,
            tracks=tracks if postures or not walks else None,
            postures=(postures, robot) if postures else None,
            body=self._driven.body("cpu"),
            critic=self._critic,
            shield=shield,
            progress=progress,
        )

    def _check(self, episode: int) -> None:
        """Checks what needs no terrain, which may take minutes to build.

        Raises:
            RomnavError: There is no such episode, or no policy.
        """
        paired = episode_set(paired_set(self._driven.work))
        if not 0 <= episode < len(paired):
            raise RomnavError(f"episode {episode}: there are 0 to {len(paired) - 1} in {paired.name}")
        _ = self._critic  # reads the policy

    def segment(self, sight: Sight | None) -> NDArray[np.int8] | None:
        """Classes (K, rows, columns) that the arm's pretrained encoder sees; None where it has none."""
        import torch

        from romnav.sensing.encoder import load_autoencoder

        if sight is None or not self.settings.navigation.encoder.pretrained:
            return None
        pretrained = encoder(self._driven.work, "lidar", self.settings)
        ranges = torch.from_numpy(sight.ranges)
        return load_autoencoder(pretrained.folder / "encoder.pt").segment(ranges).numpy()

    def film(self, episode: int, path: Path, speed: float, size: int) -> None:
        """Writes an episode as a video, ``speed`` times as fast as it was, ``size`` pixels high, with progress.

        Raises:
            RomnavError: As `drive`; it cannot be drawn or written.
        """
        from romnav.report.paired.maps import shortest
        from romnav.report.replay.video import RATE, Film, check, write

        check(path)
        self._check(episode)
        paired, world = self.ground
        goal = np.array([paired.columns[f"goal_{axis}"][episode] for axis in "xyz"])
        (route,) = shortest(world, paired, [episode])
        tile, period = world.tiles[paired.columns["tile"][episode]], self.settings.navigation.env.period
        with bar(f"film of {self._driven.arm}, episode {episode}") as progress:
            again = self.drive(episode, progress=progress)
            film = Film(tile, again, goal, route, self.settings.locomotion.robot, size)
            count = round(len(again.command) * period / speed * RATE) + RATE
            write(path, _told(film.frames(speed, period), count, progress))


def _told(frames: Iterator[NDArray[np.uint8]], count: int, progress: Progress) -> Iterator[NDArray[np.uint8]]:
    """The same frames, about ``count``, with progress."""
    for k, frame in enumerate(frames, 1):
        progress(min(k, count), count, "")
        yield frame
