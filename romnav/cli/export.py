"""``romnav export`` and ``replay``: policies for robots."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from romnav.cli.app import app
from romnav.cli.options import ArmArgument, InProject, Job, SeedOption, command
from romnav.cli.printing import print_table


@command(app, "export")
def export(
    job: Job,
    arm: ArmArgument,
    seed: SeedOption = None,
    onnx: Annotated[bool, typer.Option("--onnx", hidden=True)] = False,
) -> None:
    """Write the trained policy of an arm, its encoders and a card of metadata as one ONNX file for a robot, checked
    against PyTorch over 1,000 steps."""
    # ONNX is the only format: --onnx asks for what is done anyway, as commands written down so far do
    from romnav.experiment.graph.run import require
    from romnav.experiment.kinds.export import export

    stages = [export(job.work, arm, s) for s in (job.project.seeds(arm) if seed is None else (seed,))]
    for stage in stages:
        require(stage.upstream[-1], stage)
    job.make(stages)
    for stage in stages:
        typer.echo(stage.folder / stage.outputs[0])


@command(app, "replay")
def replay(
    here: InProject,
    policy: Annotated[Path, typer.Argument(help="File of `romnav export`.")],
    stream: Annotated[Path, typer.Argument(help="Recorded sensor stream, .npz.")],
    bare: Annotated[bool, typer.Option("--bare", help="Without the safety filter.")] = False,
) -> None:
    """Run an exported policy on a recorded sensor stream, on one core; tell how long it takes and what it does."""
    from romnav.deploy.replay import Stream
    from romnav.deploy.replay import replay as run
    from romnav.deploy.runner import Runner
    from romnav.progress import bar
    from romnav.safety.spec import SafetySpec
    from romnav.threads import torch_threads

    recorded = Stream.load(stream)
    runner = Runner(policy, None if bare else SafetySpec())
    with bar("replay") as progress, torch_threads(1):
        told = run(runner, recorded, progress).summary()
    print_table(f"{policy.name} on {stream.name}", [told], {name: name for name in told})
