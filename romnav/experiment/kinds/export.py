"""The policy of an arm as one file for a robot, with how well it did in evaluation."""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING, Any

from romnav.errors import RomnavError
from romnav.experiment.graph import records
from romnav.experiment.graph.stage import Session, Stage
from romnav.experiment.kinds._driven import Driven
from romnav.experiment.kinds.episodes import episodes
from romnav.experiment.kinds.policy import frozen_encoders
from romnav.experiment.workspace import Workspace
from romnav.files import digest
from romnav.progress import Progress

if TYPE_CHECKING:
    from romnav.deploy.card import Measured


def export(work: Workspace, arm: str, seed: int) -> Stage:
    """The policy of an arm in ONNX.

    Raises:
        RomnavError: The arm has none.
    """
    driven = Driven.by(work, arm, seed)
    if driven.policy is None:
        raise RomnavError(f"{arm}: a scripted arm has no policy to export; name a trained one")
    return Stage(
        kind="export",
        name=f"export {arm}, seed {seed}",
        folder=driven.folder,
        outputs=("policy.onnx",),
        record=driven.folder / "export.json",
        settings=driven.settings,
        uses=("lidar", "depth", "navigation.env", *driven.uses),
        make=partial(_export, driven, driven.policy),
        reads=(driven.folder / "episodes.parquet",),
        upstream=driven.upstream,
        command=work.command("export", arm, "--seed", str(seed)),
        arm=arm,
        seed=seed,
    )


def _export(driven: Driven, trained: Stage, stage: Stage, session: Session, progress: Progress) -> dict[str, Any]:
    from romnav.deploy.card import INPUTS, Card
    from romnav.deploy.export import export
    from romnav.navigation import checkpoint
    from romnav.navigation.observations import STATE_SIZE
    from romnav.navigation.policy import LAYERS

    path, settings = trained.folder / "policy.pt", driven.settings
    lidar, depth = frozen_encoders(driven.work, trained)
    actor = checkpoint.load_actor(path, lidar, depth_encoder=depth)
    env = settings.navigation.env
    card = Card(
        arm=driven.arm,
        seed=driven.seed,
        scale=driven.work.scale,
        steps=checkpoint.read(path)["steps"],
        checkpoint=digest(path),
        commit=records.commit(),
        period=env.period,
        command=env.command,
        stair_limits=settings.navigation.stair_limits,
        max_goal_distance=env.max_goal_distance,
        lidar=settings.lidar,
        depth=settings.depth if actor.depth else None,
        proprioception=actor.obs_dim - STATE_SIZE,
        memory=(LAYERS, 1, actor.core.width),
        inputs={name: told for name, told in INPUTS.items() if name != "depth" or actor.depth},
        measured=_measured(driven),
    )
    card = export(actor, lidar, depth if actor.depth else None, card, stage.folder / stage.outputs[0], progress)
    return {"error": card.error, "measured": card.measured is not None}


def _measured(driven: Driven) -> Measured | None:
    """Metrics of the evaluation, if there is one that is up to date."""
    from romnav.deploy.card import Measured
    from romnav.evaluation.paired import metrics, rows

    evaluated = episodes(driven.work, driven.arm, driven.seed)
    if not records.finished(evaluated):
        return None
    run = rows.read(evaluated.folder / evaluated.outputs[0])
    values = {name: value if math.isfinite(value) else None for name, value in metrics.evaluate(run.columns).items()}
    return Measured(episode_set=driven.settings.evaluation.episodes, digest=run.provenance.episode_set, metrics=values)
