"""``romnav train``: one part."""

from __future__ import annotations

from typing import Annotated

import typer

from romnav.cli.app import train
from romnav.cli.options import ArmArgument, DeviceJob, SeedOption, command
from romnav.errors import RomnavError


@command(train, "encoder")
def encoder(
    job: DeviceJob,
    sensor: Annotated[str | None, typer.Argument(help="lidar or depth; default: both.")] = None,
) -> None:
    """Pretrain the encoders, then measure and draw what they make of tiles that they have not seen."""
    from romnav.experiment.kinds.encoder import SENSORS, encoder, quality
    from romnav.experiment.spec import suggest

    if sensor and sensor not in SENSORS:
        raise RomnavError(f"unknown sensor {sensor}{suggest(sensor, SENSORS)}")
    job.make([stage(job.work, s) for s in ([sensor] if sensor else SENSORS) for stage in (encoder, quality)])


@command(train, "policy")
def policy(job: DeviceJob, arm: ArmArgument, seed: SeedOption = None) -> None:
    """Train the navigation policy of an arm, and its encoder if that is missing."""
    from romnav.experiment.kinds.policy import policy

    seeds = job.project.seeds(arm) if seed is None else (seed,)
    job.make([policy(job.work, arm, s) for s in seeds])


@command(train, "locomotion")
def locomotion(job: DeviceJob) -> None:
    """Train the policy that walks the humanoid; a larger number of iterations in the scale continues it."""
    from romnav.experiment.kinds.locomotion import locomotion

    job.make([locomotion(job.work)])


@command(train, "gaits")
def gaits(job: DeviceJob) -> None:
    """Record the gait library of the locomotion policy: how it walks on stairs and ramps, to start episodes there."""
    from romnav.experiment.kinds.locomotion import gaits

    job.make([gaits(job.work)])
