"""What each kind of stage calls: a short method each, between the plan and the part that does the work."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from romnav import __version__
from romnav.errors import RomnavError
from romnav.experiment import store
from romnav.experiment.plan import Plan, Stage, digest
from romnav.experiment.run import Action
from romnav.experiment.scales import Scale
from romnav.experiment.spec import SCRIPTED, Experiment
from romnav.progress import Progress

if TYPE_CHECKING:
    from romnav.navigation.perception import LidarPerception
    from romnav.sensing.lidar import Lidar
    from romnav.world.spec import WorldSpec
    from romnav.world.world import World

EVALUATION_NOISE = 1
"""Seed of the sensor noise in evaluation: every arm meets the same noise in the same step of an episode."""


def require_device(device: str) -> None:
    """Checks that a device is there.

    Raises:
        RomnavError: It is not, or its name is none.
    """
    import torch

    try:
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0].rstrip(".")
        raise RomnavError(f"device {device}: {reason}; use cpu, cuda or cuda:N") from error


@dataclass(frozen=True)
class Stages:
    """The parts at work, on one device, for the stages of one plan."""

    plan: Plan
    device: str
    resume: bool = True

    @property
    def _worlds(self) -> Path:
        return self.plan.project.root / ".cache" / "worlds"

    @property
    def actions(self) -> Mapping[str, Action]:
        """What makes the output of each kind of stage."""
        return {
            "encoder": self.encoder,
            "policy": self.policy,
            "episodes": self.episodes,
            "tables": self.tables,
        }

    def encoder(self, stage: Stage, progress: Progress) -> dict[str, Any]:
        """Pretrains the LiDAR encoder."""
        from romnav.sensing.pretrain import pretrain

        settings = cast(Scale, stage.settings)
        world = self.world(settings.world, progress)
        pretrain(
            settings.pretrain,
            list(zip(world.tiles, world.grids, strict=True)),
            self._lidar(settings, world),
            settings.lidar.height,
            stage.folder,
            device=self.device,
            progress=progress,
            resume=self.resume,
        )
        return {}

    def policy(self, stage: Stage, progress: Progress) -> dict[str, Any]:
        """Trains the policy of an arm."""
        from romnav.navigation import checkpoint
        from romnav.navigation.train import train

        settings = cast(Scale, stage.settings)
        world = self.world(settings.world, progress)
        perception = self._perception(stage.upstream[0], settings, world, stage.seed or 0)
        path = train(
            settings.navigation,
            world,
            perception,
            stage.folder,
            stage.seed or 0,
            device=self.device,
            resume=self.resume,
            progress=progress,
        )
        policy = checkpoint.read(path)
        return {"steps": policy["steps"], "hours": policy["hours"]}

    def episodes(self, stage: Stage, progress: Progress) -> dict[str, Any]:
        """Evaluates an arm on the paired episodes."""
        from romnav.evaluation import episodes, rollout, rows
        from romnav.navigation import checkpoint

        settings = cast(Scale, stage.settings)
        paired = episodes.load(self.plan.episode_set)
        world = episodes.terrain(paired, self.plan.episode_set, self._worlds).to(self.device)
        facts: dict[str, Any] = {"steps": 0, "hours": 0.0}
        policy = None
        if stage.arm in SCRIPTED:
            driver: Any = rollout.SCRIPTED[stage.arm]()
        else:
            encoder, trained = stage.upstream
            perception = self._perception(encoder, settings, world, EVALUATION_NOISE)
            policy = trained.folder / "policy.pt"
            actor = checkpoint.load_actor(
                policy, perception.encoder.token_shape, perception.encoder.digest(), self.device
            )
            driver = rollout.Policy(actor, perception)
            record = store.read(trained)
            facts = record.facts if record else facts
        measured = rollout.evaluate(driver, world, paired, settings.navigation.env, settings.evaluation, progress)
        source = store.provenance()
        provenance = rows.Provenance(
            scale=self.plan.scale.name,
            commit=source["commit"],
            spec_hash=stage.key[:16],
            checkpoint_sha256=digest(policy) if policy else None,
            episode_set=paired.digest,
            version=__version__,
            machine=source["machine"],
            **facts,
        )
        count = len(paired)
        columns: dict[str, Any] = {
            "arm": [stage.arm] * count,
            "seed": [stage.seed] * count,
            "episode": range(count),
            "tile_class": [str(world.tiles[t].kind) for t in paired.columns["tile"]],
            "multi_story": [world.tiles[t].multi_story for t in paired.columns["tile"]],
            "level": ["cross" if cross else "same" for cross in paired.cross],
            **{name: values for name, values in paired.columns.items() if name in rows.SCHEMA.names},
            **measured,
        }
        rows.write(stage.folder / "episodes.parquet", rows.make(columns, provenance))
        return {}

    def tables(self, stage: Stage, progress: Progress) -> dict[str, Any]:
        """Writes the tables of an experiment from the recorded rows."""
        from romnav.evaluation.statistics import Bootstrap
        from romnav.report import formats, results, tables

        arms = results.load(self.plan.project.results, self.plan.scale.name)
        bootstrap = Bootstrap(arms)
        specs = {spec.name: spec for spec in tables.SPECS}
        names = cast(Experiment, stage.settings).tables
        for done, name in enumerate(names, 1):
            formats.write(tables.build(specs[name], bootstrap), stage.folder)
            progress(done, len(names), name)
        return {}

    def world(self, spec: WorldSpec, progress: Progress | None = None) -> World:
        """Terrain, from the cache if it was built before."""
        from romnav.world.world import build

        return build(spec, self._worlds, progress)

    def _perception(self, encoder: Stage, settings: Scale, world: World, seed: int) -> LidarPerception:
        from romnav.navigation.perception import LidarPerception
        from romnav.sensing import encoder as encoders
        from romnav.sensing.corruption import Corruption

        corruption = Corruption(settings.navigation.corruption, seed, self.device)
        frozen = encoders.load(encoder.folder / "encoder.pt", settings.pretrain.encoder, self.device)
        return LidarPerception(self._lidar(settings, world), corruption, frozen)

    def _lidar(self, settings: Scale, world: World) -> Lidar:
        from romnav.sensing.lidar import Lidar

        return Lidar([tile.solids for tile in world.tiles], settings.lidar, self.device)
