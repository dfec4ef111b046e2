"""Which stage needs which, and which settings its output depends on."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from operator import attrgetter
from pathlib import Path
from typing import Any, cast

from romnav.config import Config
from romnav.errors import RomnavError
from romnav.experiment.project import Project
from romnav.experiment.scales import Scale, ScaleFile
from romnav.experiment.spec import SCRIPTED, TrialKind, suggest

SCENES = tuple(sorted((Path(__file__).parents[1] / "world" / "scenes").glob("[!_]*.py")))
"""Descriptions of the scenes: trials in a scene that has been changed since are out of date."""

PRETRAINING = {"lidar": "pretrain", "depth": "pretrain_depth"}
"""Section of a scale that tells how the encoder of a sensor is trained, by the section of the sensor."""


@dataclass(frozen=True)
class Stage:
    """One step of an experiment: files in a folder, made from settings and the output of other stages."""

    kind: str
    """Which function makes it."""
    name: str
    """Unique within a scale, as shown to the user."""
    folder: Path
    """Where its output lies."""
    outputs: tuple[str, ...]
    """Files that it writes into its folder."""
    record: Path
    """File that tells what made the output."""
    settings: Config
    """All settings of the scale, with the arm's changes."""
    uses: tuple[str, ...]
    """Dotted names of the settings that its output depends on."""
    reads: tuple[Path, ...] = ()
    """Versioned files that its output depends on."""
    upstream: tuple[Stage, ...] = ()
    """Stages whose output it reads."""
    scratch: tuple[str, ...] = ()
    """Files from which an interrupted run continues; useless once a setting has changed."""
    sensor: str | None = None
    """Sensor whose encoder it trains or judges."""
    arm: str | None = None
    """Arm that it trains or evaluates."""
    seed: int | None = None
    """Training seed of the arm."""

    @cached_property
    def spec(self) -> dict[str, Any]:
        """Everything that determines the output beside the upstream stages, as plain data."""
        used = {name: attrgetter(name)(self.settings) for name in self.uses}
        plain = {k: v.model_dump(mode="json") if isinstance(v, Config) else v for k, v in used.items()}
        read = {path.name: digest(path) if path.exists() else None for path in self.reads}
        # through JSON, as the record is: a tuple there is a list
        data: dict[str, Any] = json.loads(json.dumps({"arm": self.arm, "seed": self.seed, **plain, **read}))
        return data

    @cached_property
    def key(self) -> str:
        """Hash of the specification and of every upstream key."""
        text = json.dumps([self.kind, self.spec, [stage.key for stage in self.upstream]], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()


@dataclass(frozen=True)
class Plan:
    """The stages of one scale."""

    project: Project
    scale: ScaleFile

    @property
    def folder(self) -> Path:
        """Results of this scale."""
        return self.project.results / self.scale.name

    @property
    def episode_set(self) -> Path:
        """The initial conditions that all arms share."""
        return self._episodes(self.scale.settings.evaluation.episodes)

    def _episodes(self, name: str) -> Path:
        return self.project.root / "experiments" / "episodes" / f"{name}.json"

    def settings(self, arm: str) -> Scale:
        """The scale's settings with the changes of a trained arm.

        Raises:
            RomnavError: No experiment has this arm, or its changes are invalid.
        """
        name, experiment = self.project.having(arm)
        return self.scale.changed(arm, experiment, self.project.file(name))

    def encoder(self, settings: Scale | None = None, sensor: str = "lidar") -> Stage:
        """The encoder of a sensor (a key of `PRETRAINING`); an arm that changes it gets one of its own."""
        folder = self.folder / "encoder" / sensor
        stage = Stage(
            kind="encoder",
            name=f"encoder {sensor}",
            folder=folder,
            outputs=("encoder.pt", "curve.csv"),
            record=folder / "encoder.json",
            settings=settings or self.scale.settings,
            uses=("world", sensor, PRETRAINING[sensor]),
            scratch=("state.pt",),
            sensor=sensor,
        )
        if settings is None or stage.key == self.encoder(sensor=sensor).key:
            return stage
        folder = folder.with_name(f"{sensor}-{stage.key[:8]}")
        return replace(stage, name=f"encoder {folder.name}", folder=folder, record=folder / "encoder.json")

    def quality(self, sensor: str) -> Stage:
        """What the encoder of a sensor makes of images from tiles that it was not trained on."""
        encoder = self.encoder(sensor=sensor)
        return Stage(
            kind="quality",
            name=f"quality of encoder {sensor}",
            folder=encoder.folder,
            outputs=("quality.json", "encoder.png"),
            record=encoder.folder / "held-out.json",
            settings=self.scale.settings,
            uses=("quality",),
            upstream=(encoder,),
            sensor=sensor,
        )

    def locomotion(self) -> Stage:
        """The policy that walks the humanoid. More iterations continue it, so its checkpoint is never scratch."""
        folder = self.folder / "locomotion"
        return Stage(
            kind="locomotion",
            name="locomotion",
            folder=folder,
            outputs=("policy.pt", "curve.csv"),
            record=folder / "policy.json",
            settings=self.scale.settings,
            uses=("locomotion",),
        )

    def terrain(self) -> Stage:
        """The fixed test of the locomotion policy."""
        return self._after_locomotion("terrain", "terrain test", "terrain.json")

    def navigation(self) -> Stage:
        """The test of the locomotion policy under navigation: the oracle and `rom` drive it over the `dev` episodes."""
        walked, policy = self.locomotion(), self.policy("rom", 0)
        settings = _on_body(cast(Scale, policy.settings), "g1")
        return Stage(
            kind="navigation",
            name="navigation test",
            folder=walked.folder,
            outputs=("navigation.json",),
            record=walked.folder / "navigation-record.json",
            settings=settings,
            uses=("navigation.env", "evaluation.duration", "evaluation.reach"),
            reads=(self._episodes("dev"),),
            upstream=(*self._walking(settings), *policy.upstream, policy),
            arm=policy.arm,
            seed=policy.seed,
        )

    def gaits(self) -> Stage:
        """The gait library of the locomotion policy."""
        return self._after_locomotion("gaits", "gait library", "gaits.pt")

    def _after_locomotion(self, kind: str, name: str, output: str) -> Stage:
        walked = self.locomotion()
        return Stage(
            kind=kind,
            name=name,
            folder=walked.folder,
            outputs=(output,),
            record=walked.folder / f"{kind}-record.json",
            settings=walked.settings,
            uses=(),
            upstream=(walked,),
        )

    def _walking(self, settings: Scale) -> tuple[Stage, ...]:
        """What robots of these settings need to walk."""
        return (self.locomotion(), self.gaits()) if settings.navigation.dynamics == "g1" else ()

    def policy(self, arm: str, seed: int) -> Stage:
        """The trained policy of an arm, or of the one whose policy it drives; a teacher is trained with the same seed.

        Raises:
            RomnavError: The teacher is no trained arm, or taught itself.
        """
        arm = self.project.driver(arm)
        settings = self.settings(arm)
        pretrained, walks = settings.navigation.encoder.pretrained, settings.navigation.dynamics == "g1"
        encoders = [self.encoder(settings)] if pretrained else []
        if walks:
            encoders.append(self.encoder(settings, "depth"))
        taught = settings.kickstart
        teacher = [self._teacher(arm, taught.teacher, seed)] if taught else []
        folder = self.folder / arm / f"seed-{seed}"
        return Stage(
            kind="policy",
            name=f"policy {arm}, seed {seed}",
            folder=folder,
            outputs=("policy.pt", "curve.csv"),
            record=folder / "spec.json",
            settings=settings,
            uses=(
                *("world", "lidar", "navigation"),
                *(() if pretrained else ("pretrain.encoder",)),
                *(("depth", "pretrain_depth.corruption") if walks else ()),
                *(("kickstart",) if taught else ()),
            ),
            upstream=(*encoders, *teacher, *self._walking(settings)),
            scratch=("checkpoint.pt", "curve.csv"),
            arm=arm,
            seed=seed,
        )

    def _teacher(self, arm: str, teacher: str, seed: int) -> Stage:
        key = f"{self.project.file(self.project.having(arm)[0])}: arms.{arm}.kickstart.teacher"
        trained = {a for e in self.project.experiments.values() for a, spec in e.arms.items() if not spec.policy}
        if teacher not in trained:
            raise RomnavError(f"{key}: no arm {teacher} that is trained{suggest(teacher, trained)}")
        if self.settings(teacher).kickstart:
            raise RomnavError(f"{key}: {teacher} has a teacher itself; name one that was trained by PPO alone")
        return self.policy(teacher, seed)

    def episodes(self, arm: str, seed: int) -> Stage:
        """The evaluated episodes of a trained or scripted arm."""
        return self._driven("episodes", "episodes", "evaluation", (self.episode_set,), arm, seed)

    def trials(self, kind: TrialKind, arm: str, seed: int) -> Stage:
        """The trials of a trained or scripted arm in scenes, with the safety filter off and on: on the humanoid if it
        walks on that, otherwise on the reduced-order model with a body.

        Raises:
            RomnavError: The arm drives the policy of another one on the same body.
        """
        driver = self.project.driver(arm)
        if driver != arm and self.settings(arm).navigation.dynamics == "rom":
            raise RomnavError(
                f"{self.project.file(self.project.having(arm)[0])}: arms.{arm}.policy: trials drive the "
                f"reduced-order model with a body; name {driver} in its place"
            )
        return self._driven("trials", kind, kind, SCENES, arm, seed)

    def _driven(self, kind: str, output: str, section: str, reads: tuple[Path, ...], arm: str, seed: int) -> Stage:
        """A stage that drives an arm and writes rows."""
        uses: tuple[str, ...] = (section,)
        upstream: tuple[Stage, ...] = ()
        driver = self.project.driver(arm)
        if driver in SCRIPTED:
            settings = self.scale.settings
            seed = 0
            uses += ("navigation.dynamics", "navigation.env")
        else:
            policy = self.policy(arm, seed)
            settings = cast(Scale, policy.settings)
            upstream = (*policy.upstream, policy)
        if driver != arm:
            settings = _on_body(settings, self.settings(arm).navigation.dynamics)
            uses = (*dict.fromkeys((*uses, "navigation.dynamics")),)
        if settings.navigation.dynamics == "g1":
            present = {stage.name for stage in upstream}
            upstream = (*(stage for stage in self._walking(settings) if stage.name not in present), *upstream)
        folder = self.folder / arm / f"seed-{seed}"
        return Stage(
            kind=kind,
            name=f"{output} {arm}, seed {seed}",
            folder=folder,
            outputs=(f"{output}.parquet",),
            record=folder / f"{output}.json",
            settings=settings,
            uses=uses,
            reads=reads,
            upstream=upstream,
            arm=arm,
            seed=seed,
        )

    def reports(self, name: str, seeds: Iterable[int]) -> list[Stage]:
        """Everything that is written of an experiment in the end.

        Raises:
            RomnavError: As `tables`.
        """
        experiment, seeds = self.project.experiment(name), tuple(seeds)
        if experiment.kind != "ablation":
            return [self.report(name, experiment.kind, seeds)]
        written = [self.tables(name, seeds)] if experiment.tables else []
        return [*written, *([self.curves(name, seeds)] if experiment.curves else [])]

    def curves(self, name: str, seeds: Iterable[int]) -> Stage:
        """The learning curves of an experiment, as a figure and a table."""
        experiment = self.project.experiment(name)
        return Stage(
            kind="curves",
            name=f"curves {name}",
            folder=self.folder,
            outputs=(f"figures/{name}.png", *(f"tables/{name}.{format}" for format in ("tex", "md", "csv"))),
            record=self.folder / "figures" / f"{name}.json",
            settings=experiment,
            uses=("title", "labels"),
            upstream=tuple(
                self.policy(name, seed) for name, arm in experiment.arms.items() if not arm.policy for seed in seeds
            ),
        )

    def tables(self, name: str, seeds: Iterable[int]) -> Stage:
        """The tables of an experiment.

        Raises:
            RomnavError: There is no such experiment or table, or its arms are invalid.
        """
        from romnav.report.paired.tables import SPECS

        experiment = self.project.experiment(name)
        known = {spec.name for spec in SPECS}
        for table in experiment.tables:
            if table not in known:
                raise RomnavError(f"{self.project.file(name)}: tables: unknown table {table}{suggest(table, known)}")
        arms = [(arm, seed) for arm in experiment.arms for seed in seeds]
        return Stage(
            kind="tables",
            name=f"tables {name}",
            folder=self.folder / "tables",
            outputs=tuple(f"{table}.{format}" for table in experiment.tables for format in ("tex", "md", "csv")),
            record=self.folder / "tables" / f"{name}.json",
            settings=experiment,
            uses=("tables",),
            upstream=tuple(self.episodes(arm, seed) for arm, seed in [*arms, *((arm, 0) for arm in SCRIPTED)]),
        )

    def report(self, name: str, kind: TrialKind, seeds: Iterable[int]) -> Stage:
        """Table and figure of an experiment that consists of trials, its arms beside the scripted ones."""
        experiment = self.project.experiment(name)
        arms = [*((arm, seed) for arm in experiment.arms for seed in seeds), *((arm, 0) for arm in SCRIPTED)]
        return Stage(
            kind="report",
            name=f"report {name}",
            folder=self.folder,
            outputs=(*(f"tables/{name}.{format}" for format in ("tex", "md", "csv")), f"figures/{name}.png"),
            record=self.folder / "tables" / f"{name}.json",
            settings=experiment,
            uses=("labels",),
            upstream=tuple(self.trials(kind, arm, seed) for arm, seed in arms),
        )


def _on_body(settings: Scale, dynamics: str) -> Scale:
    navigation = settings.navigation.model_copy(update={"dynamics": dynamics})
    return settings.model_copy(update={"navigation": navigation})


def digest(path: Path) -> str:
    """SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
