"""The episodes that all arms share, walked by one of them."""

from __future__ import annotations

import shlex
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from romnav.errors import RomnavError
from romnav.evaluation.spec import ROWS_VERSION
from romnav.experiment.graph.records import differences
from romnav.experiment.graph.run import missing
from romnav.experiment.graph.stage import Session, Stage
from romnav.experiment.kinds._driven import Driven
from romnav.experiment.kinds.policy import policy
from romnav.experiment.workspace import Workspace
from romnav.progress import Progress, bar

if TYPE_CHECKING:
    from romnav.evaluation.episodes import EpisodeSet
    from romnav.evaluation.postures import Postures
    from romnav.evaluation.tracks import Tracks
    from romnav.report.paired.gallery import EpisodeGallery, EpisodeTable
    from romnav.world.world import World

POSTURES = "postures.npz"


def episodes(work: Workspace, arm: str, seed: int, *, joints: bool = False) -> Stage:
    """The evaluated episodes of a trained or scripted arm; with ``joints``, the humanoid's are kept beside its tracks.

    Raises:
        RomnavError: The arm's robots have no joints.
    """
    driven = Driven.by(work, arm, seed)
    if joints and driven.settings.navigation.dynamics != "g1":
        raise RomnavError(f"--joints: {arm} is driven on a body without joints; only the humanoid has them")
    return Stage(
        kind="episodes",
        name=f"episodes {arm}, seed {driven.seed}",
        folder=driven.folder,
        outputs=("episodes.parquet", "tracks.npz"),
        record=driven.folder / "episodes.json",
        settings=driven.settings,
        uses=("evaluation", *driven.uses),
        make=partial(_evaluate, driven, joints),
        reads=(paired_set(work),),
        code=(f"rows {ROWS_VERSION}", *driven.code),
        upstream=driven.upstream,
        cpu_only=driven.cpu_only,
        command=work.command("eval", arm, "--seed", str(driven.seed)),
        arm=arm,
        seed=driven.seed,
    )


def of_trained_arms(work: Workspace) -> tuple[list[Stage], list[str]]:
    """The episodes of every arm and training seed whose own policy is finished, and why others that were begun are not
    among them: those that are not finished are told of together, as a clone has many."""
    stages: list[Stage] = []
    left_out: list[str] = []
    unfinished: list[str] = []
    experiments = work.project.experiments.values()
    arms = (name for experiment in experiments for name, arm in experiment.arms.items() if arm.trained)
    for arm in dict.fromkeys(arms):
        for seed in work.project.seeds(arm):
            trained = policy(work, arm, seed)
            if not (reason := missing(trained)):
                stages.append(episodes(work, arm, seed))
            elif trained.record.exists():
                alike = not differences(trained)
                if alike and not all((trained.folder / name).exists() for name in trained.outputs):
                    unfinished.append(arm)
                else:
                    left_out.append(f"{trained.name} {reason}")
    if unfinished:
        count = "1 policy that is" if len(unfinished) == 1 else f"{len(unfinished)} policies that are"
        train = shlex.join(("romnav", *work.command("train", "policy", "ARM")))
        left_out.append(f"{count} not finished here ({', '.join(dict.fromkeys(unfinished))}); train with `{train}`")
    return stages, left_out


def paired_set(work: Workspace) -> Path:
    """File of the episodes that tables are made of."""
    return work.project.root / "experiments" / "episodes" / f"{work.settings.evaluation.episodes}.json"


def _evaluate(driven: Driven, joints: bool, stage: Stage, session: Session, progress: Progress) -> dict[str, Any]:
    import numpy as np

    from romnav.evaluation import postures, tracks
    from romnav.evaluation.episodes import load, terrain
    from romnav.evaluation.paired import rows
    from romnav.evaluation.paired.failures import classify
    from romnav.evaluation.paired.run import run

    work, settings, path = driven.work, driven.settings, paired_set(driven.work)
    paired = load(path)
    world = terrain(paired, path, work.project.worlds, progress).to(session.device)
    provenance = driven.provenance(stage, paired.digest, settings.evaluation)
    driver = driven.driver(world, session.device)
    recorder = postures.PostureRecorder() if joints else tracks.Recorder()
    env, spec, robots = settings.navigation.env, settings.evaluation, driven.body(session.device)
    measured = run(driver, world, paired, env, spec, progress, robots, recorder)
    count = len(paired)
    columns: dict[str, Any] = {
        "arm": [driven.arm] * count,
        "seed": [driven.seed] * count,
        "episode": range(count),
        "tile_class": [str(world.tiles[t].kind) for t in paired.columns["tile"]],
        "multi_story": [world.tiles[t].multi_story for t in paired.columns["tile"]],
        "level": ["cross" if cross else "same" for cross in paired.cross],
        **{name: values for name, values in paired.columns.items() if name in rows.SCHEMA.names},
        **measured,
    }
    ways, period = recorder.tracks(count), settings.navigation.env.period
    columns["level"] = np.asarray(columns["level"])
    columns["where"], columns["how"] = classify(ways, columns, world, period)
    rows.write(stage.folder / "episodes.parquet", rows.make(columns, provenance))
    source = {name: str(value) for name, value in provenance.model_dump().items()}
    tracks.write(stage.folder / "tracks.npz", ways, source)
    if isinstance(recorder, postures.PostureRecorder):
        postures.write(stage.folder / POSTURES, recorder.postures(count), ways, source)
    else:
        (stage.folder / POSTURES).unlink(missing_ok=True)  # of an earlier evaluation
    return {}


def tabulate(work: Workspace, arm: str, seed: int) -> EpisodeTable:
    """The evaluated episodes of an arm without their terrain, which may take minutes to build.

    Raises:
        RomnavError: They are missing or out of date.
    """
    from romnav.evaluation.paired import rows
    from romnav.report.paired.gallery import EpisodeTable

    stage, path = episodes(work, arm, seed), paired_set(work)
    run, digest = rows.read(stage.folder / "episodes.parquet"), episode_set(path).digest
    if run.provenance.episode_set != digest:
        raise RomnavError(
            f"{run.source}: rows of episode set {run.provenance.episode_set}, but {path} is {digest}; "
            f"run `romnav {shlex.join(stage.command)}`"
        )
    return EpisodeTable(run)


def look_at(work: Workspace, arm: str, seed: int) -> EpisodeGallery:
    """The evaluated episodes of an arm with their tracks and their terrain.

    Raises:
        RomnavError: They are missing or out of date.
    """
    from romnav.report.paired.gallery import EpisodeGallery

    run, driven = tabulate(work, arm, seed).run, Driven.by(work, arm, seed)
    tracks, postures, _ = read_ways(driven.folder)
    paired, world = ground(paired_set(work), work.project.worlds)
    return EpisodeGallery(run, tracks, paired, world, driven.settings.navigation.env.period, postures)


def read_ways(folder: Path) -> tuple[Tracks, Postures | None, dict[str, str]]:
    """Tracks of an evaluation, postures if they were kept, and where they come from.

    Raises:
        RomnavError: A file is missing or damaged, or they are of two evaluations.
    """
    from romnav.evaluation import postures, tracks

    ways, provenance = tracks.read(folder / "tracks.npz")
    held = folder / POSTURES
    return ways, postures.read(held, ways) if held.exists() else None, provenance


@cache
def episode_set(path: Path) -> EpisodeSet:
    """The episodes of a file, read once."""
    from romnav.evaluation.episodes import load

    return load(path)


@cache
def ground(path: Path, worlds: Path) -> tuple[EpisodeSet, World]:
    """The episodes of a file and their terrain, read or built once however many arms are looked at, with its bar."""
    from romnav.evaluation.episodes import terrain

    paired = episode_set(path)
    with bar("world") as progress:
        return paired, terrain(paired, path, worlds, progress)
