"""The policies kept along a run, judged on the episodes for choices: progress that training itself cannot show."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from romnav import files
from romnav.errors import RomnavError
from romnav.experiment.graph import records
from romnav.experiment.graph.stage import Session, Stage
from romnav.experiment.kinds._driven import GAIT_NOISE, NOISE
from romnav.experiment.kinds.locomotion import body
from romnav.experiment.kinds.policy import perception, policy
from romnav.experiment.workspace import Workspace
from romnav.files import digest
from romnav.progress import Progress

EPISODES = "dev"
"""The set for choices; the one that tables are made of is not looked at on the way."""


def elsewhere(trained: Stage) -> bool:
    """Whether what the run kept lies on another machine, and how well it did is here."""
    return not any((trained.folder / "kept").glob("*.pt")) and (trained.folder / "kept.csv").exists()


def kept(work: Workspace, arm: str, seed: int) -> Stage:
    """Success of every policy kept so far along the run of a trained arm, which need not have ended.

    Raises:
        RomnavError: The run has kept none.
    """
    trained = policy(work, arm, seed)
    policies = tuple(sorted((trained.folder / "kept").glob("*.pt")))
    if not policies:
        raise RomnavError(
            f"{trained.folder / 'kept'}: no policies along the run; train with navigation.ppo.keep set, and look again"
        )
    return Stage(
        kind="kept",
        name=f"kept policies of {trained.arm}, seed {seed}",
        folder=trained.folder,
        outputs=("kept.csv",),
        record=trained.folder / "kept.json",
        settings=trained.settings,
        uses=("evaluation",),
        make=partial(_judge, work, trained, policies),
        reads=(work.project.root / "experiments" / "episodes" / f"{EPISODES}.json", *policies),
        upstream=tuple(above for above in trained.upstream if above.kind != "policy"),
        cpu_only=trained.cpu_only,
        command=work.command("eval", str(trained.arm), "--kept", "--seed", str(seed)),
        arm=trained.arm,
        seed=seed,
    )


def reports(work: Workspace, name: str, seeds: Sequence[int]) -> list[Stage]:
    """The progress of the trained arms of an ablation, as a figure, where any was judged along its run: of every seed
    that was, asked for or not."""
    experiment = work.project.experiment(name)
    if experiment.kind != "ablation":
        return []
    judged = {
        label: tuple(
            (path, _begun(work, arm, seed))
            for seed in sorted({*seeds, *_seeds(work, arm)})
            if (path := work.folder / arm / f"seed-{seed}" / "kept.csv").exists()
        )
        for arm, label in experiment.labels.items()
    }
    judged = {label: runs for label, runs in judged.items() if runs}
    if not judged:
        return []
    return [
        Stage(
            kind="progress",
            name=f"progress {name}",
            folder=work.folder,
            outputs=(f"figures/{name}-progress.png",),
            record=work.folder / "figures" / f"{name}-progress.json",
            settings=experiment,
            uses=("labels",),
            make=partial(_draw, judged),
            reads=tuple(
                path
                for runs in judged.values()
                for kept, begun in runs
                for path in (kept, *(policy.record for policy in begun))
            ),
        )
    ]


def _seeds(work: Workspace, arm: str) -> list[int]:
    """Training seeds that an arm has results of."""
    numbers = [path.name.removeprefix("seed-") for path in (work.folder / arm).glob("seed-*")]
    return [int(number) for number in numbers if number.isdecimal()]


def _begun(work: Workspace, arm: str, seed: int) -> tuple[Stage, ...]:
    """The policy that a run begins with, after those behind it."""
    begin = work.arm_settings(arm).begin
    if not begin:
        return ()
    behind = policy(work, begin, seed)  # refuses a circle
    return (*_begun(work, begin, seed), behind)


def _draw(
    judged: Mapping[str, tuple[tuple[Path, tuple[Stage, ...]], ...]],
    stage: Stage,
    session: Session,
    progress: Progress,
) -> dict[str, Any]:
    """Of every training seed, the steps of what a run begins with included."""
    import pandas as pd

    from romnav.evaluation.paired.progress import read
    from romnav.report.paired.progress import draw

    def whole(kept: Path, begun: tuple[Stage, ...]) -> pd.DataFrame:
        rows = pd.DataFrame(read(kept)).drop(columns=["policy", "conditions"]).astype(float)
        found = [record.facts for policy in begun if (record := records.read(policy))]
        before = {name: sum(facts.get(name, 0.0) for facts in found) for name in ("steps", "hours")}
        return rows.assign(**{name: rows[name] + spent for name, spent in before.items()})

    draw({label: [whole(*run) for run in runs] for label, runs in judged.items()}, stage.folder / stage.outputs[0])
    return {}


def _judge(
    work: Workspace, trained: Stage, policies: tuple[Path, ...], stage: Stage, session: Session, progress: Progress
) -> dict[str, Any]:
    """Those that were judged before are not walked again."""
    from romnav.evaluation.episodes import load, terrain
    from romnav.evaluation.paired import progress as along
    from romnav.evaluation.rollout import Policy
    from romnav.navigation import checkpoint

    settings, path = work.arm_settings(str(trained.arm)), stage.reads[0]
    episodes = load(path)
    world = terrain(episodes, path, work.project.worlds, progress).to(session.device)
    seen = perception(work, trained, settings, world, noise=NOISE, device=session.device)
    depth = seen.depth.encoder if seen.depth else None
    conditions = _conditions(stage, policies)
    judged = stage.folder / "kept.csv"
    # policies that are gone keep their rows; one that a run made again replaces the earlier one
    rows: dict[int, Mapping[str, Any]] = {
        int(row["iteration"]): row
        for row in (along.read(judged) if session.resume and judged.exists() else ())
        if row["conditions"] == conditions
    }
    # the record of fewer policies would call the file that grows now a damaged one
    stage.record.unlink(missing_ok=True)
    for file in policies:
        name, iteration = digest(file)[:16], int(file.stem)
        if iteration in rows and rows[iteration]["policy"] == name:
            continue
        driver = Policy(checkpoint.load_actor(file, seen.encoder, session.device, depth_encoder=depth), seen)
        robots = body(work, settings, GAIT_NOISE, session.device, settings.evaluation.threads)
        env, spec = settings.navigation.env, settings.evaluation
        saved = checkpoint.read(file)
        place = {"policy": name, "conditions": conditions, "iteration": iteration}
        place |= {"steps": saved["steps"], "hours": saved["hours"]}
        rows[iteration] = place | along.judge(driver, world, episodes, env, spec, progress, robots)
        files.write(judged, files.csv_text([rows[i] for i in sorted(rows)], along.COLUMNS))
    return {"policies": len(policies)}


def _conditions(stage: Stage, policies: Sequence[Path]) -> str:
    """Digest of what policies are judged by: episodes, settings and encoders."""
    judged = {path.name for path in policies}
    spec = {name: value for name, value in stage.spec.items() if name not in judged}
    text = json.dumps([spec, [above.key for above in stage.upstream]], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]
