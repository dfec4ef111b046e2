"""The test of the locomotion policy under navigation: where it falls."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from romnav import files
from romnav.experiment.graph.stage import Session, Stage
from romnav.experiment.kinds._driven import Driven
from romnav.experiment.kinds.locomotion import locomotion
from romnav.experiment.workspace import Workspace
from romnav.progress import Progress


def navigation(work: Workspace) -> Stage:
    """Falls by place while the oracle and `rom` drive the humanoid over the `dev` episodes."""
    own = work.body_settings("g1").navigation
    drivers = [replace(driven, settings=driven.settings.on_body(own)) for driven in _drivers(work)]
    limits = ("navigation.stair_limits",) if own.stair_limits else ()
    rom, walked = drivers[-1], locomotion(work)
    return Stage(
        kind="navigation",
        name="navigation test",
        folder=walked.folder,
        outputs=("navigation.json",),
        record=walked.folder / "navigation-record.json",
        settings=rom.settings,
        uses=("navigation.env", *limits, "evaluation.duration", "evaluation.reach"),
        make=partial(_count, drivers),
        reads=(_episodes(work),),
        upstream=rom.upstream,
        cpu_only=rom.cpu_only,
    )


def _drivers(work: Workspace) -> list[Driven]:
    return [Driven.by(work, arm, 0) for arm in ("oracle", "rom")]


def _episodes(work: Workspace) -> Path:
    return work.project.root / "experiments" / "episodes" / "dev.json"


def _count(drivers: list[Driven], stage: Stage, session: Session, progress: Progress) -> dict[str, Any]:
    from romnav.evaluation.episodes import load, terrain
    from romnav.evaluation.paired.falls import count

    work = drivers[0].work
    path = _episodes(work)
    dev = load(path)
    world = terrain(dev, path, work.project.worlds, progress)
    rows: list[dict[str, Any]] = []
    for driven in drivers:
        env, spec = driven.settings.navigation.env, driven.settings.evaluation
        driver, robots = driven.driver(world, session.device), driven.body(session.device)
        rows += count(driven.arm, driver, world, dev, env, spec, robots, progress)
    files.write(stage.folder / stage.outputs[0], json.dumps(rows, indent=2) + "\n")
    return {}
