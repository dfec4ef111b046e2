"""The generalization gap: an arm on the terrain that its policy was trained on, and on terrain that it never saw."""

from __future__ import annotations

import json
from functools import partial
from typing import Any

from romnav import files
from romnav.errors import RomnavError
from romnav.evaluation.spec import EpisodeSetSpec
from romnav.experiment.graph.stage import Session, Stage
from romnav.experiment.kinds._driven import Driven
from romnav.experiment.kinds.kept import EPISODES
from romnav.experiment.workspace import Workspace
from romnav.progress import Progress

SEED = 777
"""Of the draw on the terrain of training."""


def generalization(work: Workspace, arm: str, seed: int) -> Stage:
    """Success on as many episodes of the terrain of training, drawn alike, as on the episodes for choices.

    Raises:
        RomnavError: The arm drives by a script.
    """
    driven = Driven.by(work, arm, seed)
    if driven.policy is None:
        raise RomnavError(f"--generalization: {arm} drives by a script, which was trained nowhere; name trained arms")
    return Stage(
        kind="generalization",
        name=f"generalization of {arm}, seed {seed}",
        folder=driven.folder,
        outputs=("generalization.json",),
        record=driven.folder / "generalization-record.json",
        settings=driven.settings,
        uses=("evaluation", *driven.uses),
        make=partial(_compare, driven),
        reads=(work.project.root / "experiments" / "episodes" / f"{EPISODES}.json",),
        code=driven.code,
        upstream=driven.upstream,
        cpu_only=driven.cpu_only,
        command=work.command("eval", arm, "--generalization", "--seed", str(seed)),
        arm=arm,
        seed=seed,
    )


def _compare(driven: Driven, stage: Stage, session: Session, progress: Progress) -> dict[str, Any]:
    from romnav.evaluation.episodes import draw, load, terrain
    from romnav.evaluation.paired import progress as along
    from romnav.world.build import build

    work, settings, path = driven.work, driven.settings, stage.reads[0]
    unseen, spec = load(path), settings.evaluation
    ground = build(settings.ground, work.project.worlds, progress)
    alike = EpisodeSetSpec(world=ground.spec, episodes=len(unseen), cross=int(unseen.cross.sum()), seed=SEED)
    seen = draw("seen", alike, ground)
    rows = []
    for name, episodes, world in (
        ("seen", seen, ground),
        ("unseen", unseen, terrain(unseen, path, work.project.worlds, progress)),
    ):
        here, env = world.to(session.device), settings.navigation.env
        found = along.judge(
            driven.driver(here, session.device), here, episodes, env, spec, progress, driven.body(session.device)
        )
        rows.append({"terrain": name, "tiles": len(world.tiles), **found})
    files.write(stage.folder / stage.outputs[0], json.dumps(rows, indent=2) + "\n")
    return {}
