"""How large everything is: one TOML file per scale, a section per part, validated by the part's own spec."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import reduce
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import Field, model_validator

from romnav.config import Config, Count, Positive
from romnav.errors import RomnavError
from romnav.evaluation.spec import DeploymentSpec, EvaluationSpec, TrialSpec
from romnav.experiment.spec import Experiment, parse, read_toml, suggest
from romnav.navigation.spec import BODIES, MOST_STEPS, KickstartSpec, NavigationSpec
from romnav.robot.spec import LocomotionSpec
from romnav.sensing.spec import DepthPretrainSpec, DepthSpec, LidarSpec, PretrainSpec, QualitySpec
from romnav.world.spec import WorldSpec

SHARED = ("bodies", "locomotion", "evaluation", "safety", "deploy")
"""Sections that are the same for all arms."""


class ResourcesSpec(Config):
    """What a stage takes of a cluster's machine."""

    cores: Count = 1
    """Cores: training runs on one thread."""
    gpus: float = Field(default=0.0, ge=0.0, le=64.0)
    """Share of a GPU, with ``--device cuda``."""
    memory_gb: Positive = 3.0
    """Memory (A: measured on a core, see docs/scale.md; `romnav describe scale` tells the largest parts)."""


class Scale(Config):
    """The settings of every part; the defaults are the paper's, or assumed where it is silent."""

    world: WorldSpec = WorldSpec()
    """Training terrain, of encoders and, but for its number of tiles, of policies."""
    lidar: LidarSpec = LidarSpec()
    """Range image."""
    pretrain: PretrainSpec = PretrainSpec()
    """Encoder of the range image and its training."""
    depth: DepthSpec = DepthSpec()
    """Depth image."""
    pretrain_depth: DepthPretrainSpec = DepthPretrainSpec()
    """Encoder of the depth image and its training."""
    quality: QualitySpec = QualitySpec()
    """Judging the encoders."""
    navigation: NavigationSpec = NavigationSpec()
    """Task, policy and reinforcement learning."""
    kickstart: KickstartSpec | None = None
    """Teacher of the policy, and how it teaches; without one, PPO alone."""
    begin: str | None = Field(default=None, exclude_if=lambda arm: arm is None)
    """Arm whose policy and critic the run begins with, so that it trains them on; random ones without (P)."""
    locomotion: LocomotionSpec = LocomotionSpec()
    """The humanoid, and the policy that walks it."""
    evaluation: EvaluationSpec = EvaluationSpec()
    """Evaluation terrain and episodes."""
    safety: TrialSpec = TrialSpec()
    """Trials in the obstacle sets."""
    deploy: DeploymentSpec = DeploymentSpec()
    """Trials in the deployments."""
    resources: ResourcesSpec = ResourcesSpec()
    """Share of a machine that a stage takes on a cluster."""
    bodies: dict[Annotated[str, BODIES], dict[str, Any]] = Field(default={})
    """Settings that differ where another body is trained, e.g. ``bodies.g1.navigation.env.envs = 96``. They come before
    those of the arm; those of ``kickstart`` are for arms that have a teacher."""

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        if self.begin and self.kickstart and self.kickstart.init == "teacher":
            raise ValueError(
                f"begin: the run cannot begin with {self.begin} and with its teacher (kickstart.init); "
                'leave begin out, or set kickstart.init to "fresh"'
            )
        env, cell = self.navigation.env, self.world.grid.cell
        if (way := env.command.forward * env.period) > 2 * cell:
            raise ValueError(
                f"navigation.env.period: {way:.2f} m in a step at the fastest (navigation.env.command.forward), "
                f"beyond two cells of {cell} m (world.grid.cell): robots would jump over walls; lower it"
            )
        robot = self.locomotion.robot
        if self.navigation.dynamics == "g1" and not robot.ticks(env.period):
            raise ValueError(
                f"navigation.env.period: {env.period} s, no multiple of the humanoid's control step of "
                f"{robot.timestep * robot.decimation} s (locomotion.robot.timestep * decimation); make it one"
            )
        for name in ("evaluation", "safety", "deploy"):
            duration = getattr(self, name).duration
            if not 1.0 <= duration / env.period <= MOST_STEPS:
                raise ValueError(
                    f"{name}.duration: {duration} s in steps of {env.period} s (navigation.env.period); make it 1 to "
                    f"{MOST_STEPS:,} steps"
                )
        return self

    @model_validator(mode="after")
    def _encoders_fit(self) -> Self:
        for image, training in (("lidar", self.pretrain), ("depth", self.pretrain_depth)):
            sensor = getattr(self, image)
            for axis, pixels, strides in zip(
                ("rows", "columns"),
                (sensor.rows, sensor.columns),
                zip(*training.encoder.strides, strict=True),
                strict=True,
            ):
                if (merged := math.prod(strides)) >= 2 * pixels:
                    name = "pretrain" if image == "lidar" else "pretrain_depth"
                    raise ValueError(
                        f"{name}.encoder.strides: {merged:,} {axis} become one, of {pixels} ({image}.{axis}): most of "
                        "the image would be padding; lower them"
                    )
        return self

    @property
    def ground(self) -> WorldSpec:
        """The terrain that policies are trained on: ``world``, with as many tiles as ``navigation.tiles`` says."""
        return self.world.model_copy(update={"tiles": self.navigation.tiles or self.world.tiles})

    def on_body(self, own: NavigationSpec) -> Scale:
        """The same with robots of another body."""
        other = {"dynamics": own.dynamics, "stair_limits": own.stair_limits}
        return self.model_copy(update={"navigation": self.navigation.model_copy(update=other)})


def find(folder: Path, name: str) -> Path:
    """The file of a scale among those in a folder.

    Raises:
        RomnavError: There is no such scale.
    """
    known = {file.stem: file for file in folder.glob("*.toml")}
    if name not in known:
        raise RomnavError(f"unknown scale {name}{suggest(name, known)}")
    return known[name]


class ScaleFile:
    """A scale, and what becomes of it when an arm changes some of its settings.

    Raises:
        RomnavError: There is no such scale, or its file is invalid.
    """

    def __init__(self, folder: Path, name: str) -> None:
        self._file = file = find(folder, name)
        self.name = name
        self._data = read_toml(file)
        self._bodies = parse(Scale, self._data, file).bodies
        for body, change in self._bodies.items():
            key = f"bodies.{body}"
            _refuse_shared(file, key, change)
            taught = {"kickstart": {"teacher": "any"}} if "kickstart" in change else {}
            driven = _merge(self._data, {"navigation": {"dynamics": body}} | taught)
            if parse(Scale, _merge(driven, change), file, f"{key}.").navigation.dynamics != body:
                raise RomnavError(f"{file}: {key}.navigation.dynamics: it is {body} here; leave it out")
        self.settings = parse(Scale, self._on_its_body(), file)

    def of_body(self, body: str) -> Scale:
        """The settings of a body that no arm changes."""
        change = {"navigation": {"dynamics": body}}
        return parse(Scale, _merge(self._on_its_body(change), change), self._file)

    def changed(self, name: str, experiment: Experiment, file: Path) -> Scale:
        """The settings of arm ``name`` of the ``experiment`` in ``file``.

        Raises:
            RomnavError: The arm, or the experiment at this scale, changes a setting that does not exist, or to a value
                of a wrong type.
        """
        changes = {
            f"scales.{self.name}": experiment.scales.get(self.name, {}),
            f"arms.{name}": experiment.arms[name].changes,
        }
        applied: list[Mapping[str, Any]] = []
        for key, change in changes.items():
            _refuse_shared(file, key, change)
            applied.append(change)
            settings = parse(Scale, reduce(_merge, applied, self._on_its_body(*applied)), file, f"{key}.")
        return settings

    def _on_its_body(self, *changes: Mapping[str, Any]) -> dict[str, Any]:
        """The scale for the body that it has after some changes, without these."""
        whole = reduce(_merge, changes, self._data)
        navigation = whole.get("navigation")
        body = navigation.get("dynamics", "rom") if isinstance(navigation, dict) else None
        own = self._bodies.get(str(body), {})
        return _merge(self._data, {name: own[name] for name in own if name != "kickstart" or name in whole})


def _refuse_shared(file: Path, key: str, change: Mapping[str, Any]) -> None:
    for section in SHARED:
        if section in change:
            raise RomnavError(f"{file}: {key}.{section}: set [{section}] of the scale, all arms share it")


def _merge(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in changes.items():
        below = merged.get(key)
        both = isinstance(value, dict) and isinstance(below, dict)
        merged[key] = _merge(below or {}, value) if both else value
    return merged
