"""Trials of an arm in scenes, with the safety filter off and on, and their report: a table and a figure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import romnav.world.scenes
from romnav.errors import NothingRecorded, RomnavError
from romnav.experiment.graph.stage import Session, Stage
from romnav.experiment.kinds._driven import GAIT_NOISE, Driven
from romnav.experiment.kinds.locomotion import humanoid
from romnav.experiment.spec import SCRIPTED, TrialKind
from romnav.experiment.workspace import Workspace
from romnav.progress import Progress

if TYPE_CHECKING:
    from romnav.evaluation.trials.rows import TrialRows
    from romnav.report.formats import Table
    from romnav.world.scenes.scene import Scene

SCENES = tuple(sorted(Path(romnav.world.scenes.__path__[0]).glob("[!_]*.py")))
"""Descriptions of the scenes: trials in a scene that has been changed since are out of date."""


def trials(work: Workspace, kind: TrialKind, arm: str, seed: int) -> Stage:
    """The trials of a trained or scripted arm in scenes, with the safety filter off and on: on the humanoid if it walks
    on that, otherwise on the reduced-order model with a body.

    Raises:
        RomnavError: The arm drives the policy of another one on the same body, or has the filter in all it does.
    """
    if work.project.filtered(arm):
        raise RomnavError(
            f"{work.project.file(work.project.having(arm)[0])}: arms.{arm}.filter: trials have the filter both off and "
            "on; leave it out"
        )
    driver = work.project.driver(arm)
    if driver != arm and work.arm_settings(arm).navigation.dynamics == "rom":
        raise RomnavError(
            f"{work.project.file(work.project.having(arm)[0])}: arms.{arm}.policy: trials drive the "
            f"reduced-order model with a body; name {driver} in its place"
        )
    driven = Driven.by(work, arm, seed)
    if driven.settings.navigation.dynamics not in ("rom", "g1"):
        raise RomnavError(
            f"{work.project.file(work.project.having(arm)[0])}: arms.{arm}.navigation.dynamics: trials need a body "
            "that touches the solids themselves; set rom or g1"
        )
    return Stage(
        kind="trials",
        name=f"{kind} {arm}, seed {driven.seed}",
        folder=driven.folder,
        outputs=(f"{kind}.parquet",),
        record=driven.folder / f"{kind}.json",
        settings=driven.settings,
        uses=(kind, *driven.uses),
        make=partial(_run, driven, kind),
        reads=SCENES,
        code=driven.code,
        upstream=driven.upstream,
        cpu_only=driven.cpu_only,
        arm=arm,
        seed=driven.seed,
    )


def _run(driven: Driven, kind: TrialKind, stage: Stage, session: Session, progress: Progress) -> dict[str, Any]:
    from romnav.evaluation.trials import rows
    from romnav.evaluation.trials.run import draw, run
    from romnav.world.scenes.scene import scene_world

    scenes = _scenes(kind)
    world = scene_world(scenes).to(session.device)
    settings, spec = driven.settings, getattr(driven.settings, kind)
    walks = settings.navigation.dynamics == "g1"
    provenance = driven.provenance(stage, draw(scenes, world, spec).digest, spec)
    columns = run(
        driven.driver(world, session.device),
        scenes,
        world,
        settings.navigation.env,
        spec,
        progress,
        body=humanoid(driven.work, settings, GAIT_NOISE, session.device, spec.threads) if walks else None,
        arms=settings.locomotion.robot if walks else None,
    )
    rows.write(stage.folder / stage.outputs[0], rows.TrialRows(driven.arm, driven.seed, columns, provenance))
    return {}


def reports(work: Workspace, name: str, seeds: Sequence[int]) -> list[Stage]:
    """Table and figure of an experiment that consists of trials, its arms beside the scripted ones on the same body."""
    experiment = work.project.experiment(name)
    if experiment.kind == "ablation":
        return []
    kind = experiment.kind
    rolls = any(work.arm_settings(arm).navigation.dynamics == "rom" for arm in experiment.arms)
    bounds = [(arm, 0) for arm in SCRIPTED if rolls]
    arms = [*((arm, seed) for arm in experiment.arms for seed in seeds), *bounds]
    declared = experiment.declared(name, {"trials"})
    return [
        Stage(
            kind="report",
            name=f"report {table}",
            folder=work.folder,
            outputs=(*(f"tables/{table}.{format}" for format in ("tex", "md", "csv")), f"figures/{table}.png"),
            record=work.folder / "tables" / f"{table}.json",
            settings=declared,
            uses=("labels", "tables"),
            make=partial(_report, work, name, table),
            reads=work.project.published_files(name),
            upstream=tuple(trials(work, kind, arm, seed) for arm, seed in arms),
        )
        for table in declared.tables
    ]


def _report(
    work: Workspace, name: str, table: str, stage: Stage, session: Session, progress: Progress
) -> dict[str, Any]:
    """Of the arms that have been driven."""
    from romnav.report import formats
    from romnav.report.trials import pictures

    kind, runs = cast(TrialKind, work.project.experiment(name).kind), recorded(stage)
    if not runs:
        missing = stage.upstream[0].folder / stage.upstream[0].outputs[0]
        raise NothingRecorded(f"{missing}: no trials yet; run `romnav run {' '.join({kind: 0, name: 0})}`")
    draw = {"safety": pictures.draw_safety, "deploy": pictures.draw_deployments}[kind]
    formats.write(tabulate(work, name, table, runs), stage.folder / "tables")
    draw(runs[0], _scenes(kind), stage.folder / stage.outputs[-1])
    return {}


def recorded(report: Stage) -> list[TrialRows]:
    """The trials of a report's arms, as far as they have been driven."""
    from romnav.evaluation.trials import rows

    files = [above.folder / above.outputs[0] for above in report.upstream]
    return [rows.read(file) for file in files if file.exists()]


def tabulate(work: Workspace, name: str, table: str, runs: Sequence[TrialRows]) -> Table:
    """A declared table of an experiment that consists of trials."""
    from romnav.report.trials import tables

    experiment = work.project.experiment(name)
    kind = cast(TrialKind, experiment.kind)
    build = {"safety": tables.safety, "deploy": tables.deploy}[kind]
    return replace(build(runs, _scenes(kind), experiment.labels, work.project.published(name)), name=table)


def _scenes(kind: TrialKind) -> tuple[Scene, ...]:
    from romnav.world.scenes.deployments import deployment_scenes
    from romnav.world.scenes.obstacles import obstacle_scenes

    return {"safety": obstacle_scenes, "deploy": deployment_scenes}[kind]()
