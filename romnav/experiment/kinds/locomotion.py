"""The policy that walks the humanoid, its fixed test, and the gait library that robots start from on stairs."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

from romnav import files, ranks
from romnav.errors import RomnavError
from romnav.experiment.graph.stage import Session, Stage
from romnav.experiment.scales import Scale
from romnav.experiment.workspace import Workspace
from romnav.navigation.spec import BODIES
from romnav.progress import Progress

if TYPE_CHECKING:
    from romnav.robot.dynamics import Body
    from romnav.robot.humanoid import Humanoid
    from romnav.world.world import World


def locomotion(work: Workspace) -> Stage:
    """The policy that walks the humanoid. More iterations continue it, so its checkpoint is never scratch."""
    folder = work.folder / "locomotion"
    return Stage(
        kind="locomotion",
        name="locomotion",
        folder=folder,
        outputs=("policy.pt", "curve.csv"),
        record=folder / "policy.json",
        settings=work.settings,
        uses=("locomotion",),
        make=partial(_train, work),
        command=work.command("train", "locomotion"),
        on_request=True,  # it takes hours
        cpu_only=True,
    )


def _train(work: Workspace, stage: Stage, session: Session, progress: Progress) -> dict[str, Any]:
    from romnav.robot.locomotion.train import train, training_cost

    path = train(
        work.settings.locomotion,
        stage.folder,
        device=session.device,
        resume=session.resume,
        progress=progress,
        worlds=work.project.worlds,
    )
    return training_cost(path)


def terrain(work: Workspace) -> Stage:
    """The fixed test of the locomotion policy."""
    return _of_the_policy(work, "terrain", "terrain test", "terrain.json", _test)


def _test(stage: Stage, session: Session, progress: Progress) -> dict[str, Any]:
    from romnav.robot.locomotion.evaluate import evaluate

    rows = evaluate(stage.upstream[0].folder / "policy.pt", progress=progress)
    turning = {row["terrain"]: row.pop("yaw_error") for row in rows}
    files.write(stage.folder / "terrain.json", json.dumps(rows, indent=2) + "\n")
    return {"yaw_error": turning}


def gaits(work: Workspace) -> Stage:
    """The gait library of the locomotion policy: how it walks on stairs and ramps."""
    return _of_the_policy(work, "gaits", "gait library", "gaits.pt", _record)


def _record(stage: Stage, session: Session, progress: Progress) -> dict[str, Any]:
    from romnav.robot.gaits import record, still_up

    policy = stage.upstream[0].folder / "policy.pt"
    library = record(policy)
    library.save(stage.folder / "gaits.pt")
    recorded = [f"{'up' if g.direction > 0 else 'down'} {g.kind} {g.slope:.2f}" for g in library.gaits]
    return {"gaits": recorded, "still_up_after_3_s": still_up(policy, library) if recorded else None}


def _of_the_policy(
    work: Workspace, kind: str, name: str, output: str, make: Callable[[Stage, Session, Progress], dict[str, Any]]
) -> Stage:
    walked = locomotion(work)
    return Stage(
        kind=kind,
        name=name,
        folder=walked.folder,
        outputs=(output,),
        record=walked.folder / f"{kind}-record.json",
        settings=walked.settings,
        uses=(),
        make=make,
        upstream=(walked,),
    )


def walking(work: Workspace, settings: Scale) -> tuple[Stage, ...]:
    """What robots of these settings need to walk."""
    return (locomotion(work), gaits(work)) if settings.navigation.dynamics == "g1" else ()


def cpu_only(settings: Scale) -> bool:
    """Whether robots of these settings have physics on the CPU alone."""
    return settings.navigation.dynamics == "g1"


def body(work: Workspace, settings: Scale, seed: int, device: str, threads: int) -> Body:
    """What makes the robots of these settings.

    Raises:
        RomnavError: As `humanoid`.
    """
    from romnav.robot.rom import ReducedOrderModel

    match settings.navigation.dynamics:
        case "rom":
            return ReducedOrderModel
        case "g1":
            return humanoid(work, settings, seed, device, threads)
        case outside:
            made: Body = BODIES.load(outside)
            return made


def humanoid(
    work: Workspace, settings: Scale, seed: int, device: str, threads: int
) -> Callable[[World, int, float], Humanoid]:
    """What makes robots that walk by the locomotion policy of the scale.

    Raises:
        RomnavError: They are to walk on another device than the CPU; there is no gait library.
    """
    if device != "cpu":
        raise RomnavError(f"the humanoid has no physics engine on {device} here; use cpu")
    from romnav.robot.gaits import GaitLibrary
    from romnav.robot.humanoid import Humanoid

    return partial(
        Humanoid,
        checkpoint=locomotion(work).folder / "policy.pt",
        gaits=GaitLibrary.load(gaits(work).folder / "gaits.pt"),
        seed=seed,
        threads=threads,
        stair_limits=settings.navigation.stair_limits,
        first=ranks.share(settings.navigation.env.envs).start,
    )
