"""What each kind of stage calls: a short method each, between the plan and the part that does the work."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from romnav import __version__, files
from romnav.errors import RomnavError
from romnav.experiment import store
from romnav.experiment.plan import PRETRAINING, Plan, Stage, digest
from romnav.experiment.run import Action
from romnav.experiment.scales import Scale
from romnav.experiment.spec import SCRIPTED, Experiment
from romnav.progress import Progress

if TYPE_CHECKING:
    from romnav.evaluation.rollout import Driver
    from romnav.evaluation.rowfile import Provenance
    from romnav.navigation.perception import Eye, Perception
    from romnav.robot.dynamics import Body
    from romnav.robot.humanoid import Humanoid
    from romnav.sensing.depth import DepthCamera
    from romnav.sensing.lidar import Lidar
    from romnav.world.scenes.scene import Scene
    from romnav.world.spec import WorldSpec
    from romnav.world.tile import Tile
    from romnav.world.world import World

DEPTH_NOISE = 1_000_003
"""Added to the seed of the LiDAR's noise for that of the camera."""
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


def _scenes(kind: str) -> tuple[Scene, ...]:
    """The scenes of an experiment that consists of trials."""
    from romnav.world.scenes.deployments import deployment_scenes
    from romnav.world.scenes.obstacles import obstacle_scenes

    return {"safety": obstacle_scenes, "deploy": deployment_scenes}[kind]()


@dataclass(frozen=True)
class Stages:
    """The parts at work, on one device, for the stages of one plan."""

    plan: Plan
    device: str
    resume: bool = True

    @property
    def actions(self) -> Mapping[str, Action]:
        """What makes the output of each kind of stage."""
        return {
            "encoder": self.encoder,
            "quality": self.quality,
            "locomotion": self.locomotion,
            "terrain": self.terrain,
            "navigation": self.navigation,
            "gaits": self.gaits,
            "policy": self.policy,
            "episodes": self.episodes,
            "trials": self.trials,
            "tables": self.tables,
            "curves": self.curves,
            "report": self.report,
        }

    def encoder(self, stage: Stage, progress: Progress) -> dict[str, Any]:
        """Pretrains the encoder of a sensor."""
        from romnav.sensing.encoder import load
        from romnav.sensing.pretrain import pretrain

        settings = cast(Scale, stage.settings)
        world = self.world(settings.world, progress)
        sensor = self._sensor(str(stage.sensor), settings, world.tiles)
        path = pretrain(
            getattr(settings, PRETRAINING[str(stage.sensor)]),
            list(zip(world.tiles, world.grids, strict=True)),
            sensor,
            sensor.spec.height,
            stage.folder,
            device=self.device,
            progress=progress,
            resume=self.resume,
        )
        return {"digest": load(path).digest()}

    def quality(self, stage: Stage, progress: Progress) -> dict[str, Any]:
        """Measures and draws what an encoder makes of tiles that it was not trained on."""
        from romnav.report.encoder_figure import draw_encoder
        from romnav.sensing.encoder import load_autoencoder
        from romnav.sensing.pretrain import quality
        from romnav.world.tiles import generate

        settings = cast(Scale, stage.settings)
        spec = settings.quality
        if spec.seed == settings.world.seed:
            raise RomnavError(f"quality.seed: {spec.seed} is the training terrain's; set another one in the scale")
        terrain = settings.world.model_copy(update={"seed": spec.seed})
        tiles = []
        for index in range(spec.tiles):
            tiles.append(generate(terrain, index))
            progress(index + 1, spec.tiles, "tiles")
        sensor = self._sensor(str(stage.sensor), settings, [tile for tile, _ in tiles])
        model = load_autoencoder(stage.upstream[0].folder / "encoder.pt", self.device)
        corruption = getattr(settings, PRETRAINING[str(stage.sensor)]).corruption
        judged = (model, tiles, sensor, sensor.spec.height, corruption)
        measured = quality(*judged, images=spec.images, device=self.device)
        files.write(stage.folder / "quality.json", json.dumps(measured, indent=2) + "\n")
        draw_encoder(*judged, stage.folder / "encoder.png", device=self.device)
        return {}

    def locomotion(self, stage: Stage, progress: Progress) -> dict[str, Any]:
        """Trains the policy that walks the humanoid."""
        from romnav.robot.locomotion.train import train, training_cost

        settings = cast(Scale, stage.settings)
        path = train(
            settings.locomotion,
            stage.folder,
            device=self.device,
            resume=self.resume,
            progress=progress,
            worlds=self.plan.project.worlds,
        )
        return training_cost(path)

    def terrain(self, stage: Stage, progress: Progress) -> dict[str, Any]:
        """Runs the fixed test of the locomotion policy."""
        from romnav.robot.locomotion.evaluate import evaluate

        rows = evaluate(stage.upstream[0].folder / "policy.pt", progress=progress)
        turning = {row["terrain"]: row.pop("yaw_error") for row in rows}
        files.write(stage.folder / "terrain.json", json.dumps(rows, indent=2) + "\n")
        return {"yaw_error": turning}

    def navigation(self, stage: Stage, progress: Progress) -> dict[str, Any]:
        """Counts the falls of the locomotion policy under navigation by place."""
        from romnav.evaluation import episodes, rollout
        from romnav.evaluation.paired import falls

        settings = cast(Scale, stage.settings)
        spec, (path,) = settings.evaluation, stage.reads
        dev = episodes.load(path)
        world = episodes.terrain(dev, path, self.plan.project.worlds)
        body = self._body(stage, spec.threads)
        rows: list[dict[str, Any]] = []
        for name, driver in (("oracle", rollout.SCRIPTED["oracle"]()), (str(stage.arm), self._driver(stage, world))):
            rows += falls.count(name, driver, world, dev, settings.navigation.env, spec, body, progress)
        files.write(stage.folder / stage.outputs[0], json.dumps(rows, indent=2) + "\n")
        return {}

    def gaits(self, stage: Stage, progress: Progress) -> dict[str, Any]:
        """Records the gait library of the locomotion policy."""
        from romnav.robot.gaits import record, still_up

        policy = stage.upstream[0].folder / "policy.pt"
        library = record(policy)
        library.save(stage.folder / "gaits.pt")
        gaits = [f"{'up' if g.direction > 0 else 'down'} {g.kind} {g.slope:.2f}" for g in library.gaits]
        return {"gaits": gaits, "still_up_after_3_s": still_up(policy, library) if gaits else None}

    def policy(self, stage: Stage, progress: Progress) -> dict[str, Any]:
        """Trains the policy of an arm."""
        from romnav.navigation import checkpoint
        from romnav.navigation.train import train

        settings = cast(Scale, stage.settings)
        world = self.world(settings.world, progress)
        perception = self._perception(stage, settings, world, stage.seed or 0)
        teachers = [above.folder / "policy.pt" for above in stage.upstream if above.kind == "policy"]
        path = train(
            settings.navigation,
            world,
            perception,
            stage.folder,
            stage.seed or 0,
            body=self._body(stage, settings.navigation.ppo.threads),
            kickstart=None if settings.kickstart is None else (settings.kickstart, teachers[0]),
            device=self.device,
            resume=self.resume,
            progress=progress,
        )
        policy = checkpoint.read(path)
        return {"steps": policy["steps"], "hours": policy["hours"]}

    def episodes(self, stage: Stage, progress: Progress) -> dict[str, Any]:
        """Evaluates an arm on the paired episodes."""
        from romnav.evaluation import episodes
        from romnav.evaluation.paired import rows, run

        settings = cast(Scale, stage.settings)
        paired = episodes.load(self.plan.episode_set)
        world = episodes.terrain(paired, self.plan.episode_set, self.plan.project.worlds).to(self.device)
        driver = self._driver(stage, world)
        spec = settings.evaluation
        body = self._body(stage, spec.threads)
        measured = run.run(driver, world, paired, settings.navigation.env, spec, progress, body)
        provenance = self._provenance(stage, paired.digest)
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

    def trials(self, stage: Stage, progress: Progress) -> dict[str, Any]:
        """Drives an arm through the scenes of an experiment, with the safety filter off and on."""
        from romnav.evaluation.trials import rows as trial_rows
        from romnav.evaluation.trials import run as trials
        from romnav.world.scenes.scene import scene_world

        settings = cast(Scale, stage.settings)
        kind = Path(stage.outputs[0]).stem
        scenes = _scenes(kind)
        world = scene_world(scenes).to(self.device)
        spec = getattr(settings, kind)
        walks = settings.navigation.dynamics == "g1"
        columns = trials.run(
            self._driver(stage, world),
            scenes,
            world,
            settings.navigation.env,
            spec,
            progress,
            body=self._humanoid(stage, spec.threads) if walks else None,
            arms=settings.locomotion.robot if walks else None,
        )
        starts = trials.draw(scenes, world, spec).digest
        rows = trial_rows.TrialRows(str(stage.arm), stage.seed or 0, columns, self._provenance(stage, starts))
        trial_rows.write(stage.folder / stage.outputs[0], rows)
        return {}

    def tables(self, stage: Stage, progress: Progress) -> dict[str, Any]:
        """Writes the tables of an experiment from the recorded rows."""
        from romnav.evaluation.paired.statistics import Bootstrap
        from romnav.report import formats
        from romnav.report.paired import results, tables

        arms = results.load(self.plan.project.results, self.plan.scale.name)
        bootstrap = Bootstrap(arms)
        specs = {spec.name: spec for spec in tables.SPECS}
        names = cast(Experiment, stage.settings).tables
        for done, name in enumerate(names, 1):
            formats.write(tables.build(specs[name], bootstrap), stage.folder)
            progress(done, len(names), name)
        return {}

    def curves(self, stage: Stage, progress: Progress) -> dict[str, Any]:
        """Draws and tabulates the learning curves that are there."""
        from romnav.report import curves, formats

        experiment = cast(Experiment, stage.settings)
        name = Path(stage.outputs[0]).stem
        arms, commits = {}, set()
        records = {run.name: store.read(run) for run in stage.upstream}
        finished = [run for run in stage.upstream if (record := records[run.name]) and record.outputs]
        for arm, label in experiment.labels.items():
            runs = [run for run in finished if run.arm == arm]
            if runs:
                unfreeze_at = cast(Scale, runs[0].settings).navigation.encoder.unfreeze_at
                arms[arm] = curves.read(label, unfreeze_at, [run.folder / "curve.csv" for run in runs])
            commits |= {record.provenance["commit"][:12] for run in runs if (record := records[run.name])}
        if not arms:
            raise RomnavError(f"{stage.folder}: no arm of {name} is trained; run `romnav run ablation {name}`")
        provenance = {"scale": self.plan.scale.name, "commit": ", ".join(sorted(commits))}
        curves.draw(arms, stage.folder / stage.outputs[0])
        formats.write(curves.tabulate(name, experiment.title, arms, provenance), stage.folder / "tables")
        return {}

    def report(self, stage: Stage, progress: Progress) -> dict[str, Any]:
        """Writes the table and draws the figure of an experiment that consists of trials, of those that are there."""
        from romnav.evaluation.trials import rows as trial_rows
        from romnav.report import formats
        from romnav.report.trials import pictures as trial_pictures
        from romnav.report.trials import tables as trial_tables

        experiment, name = cast(Experiment, stage.settings), Path(stage.outputs[0]).stem
        files = [above.folder / above.outputs[0] for above in stage.upstream]
        runs = [trial_rows.read(file) for file in files if file.exists()]
        if not runs:
            raise RomnavError(f"{files[0]}: no trials yet; run `romnav run {' '.join({experiment.kind: 0, name: 0})}`")
        scenes = _scenes(experiment.kind)
        build, draw = {
            "safety": (trial_tables.safety, trial_pictures.draw_safety),
            "deploy": (trial_tables.deploy, trial_pictures.draw_deployments),
        }[experiment.kind]
        table = replace(build(runs, scenes, experiment.labels), name=name)
        formats.write(table, stage.folder / "tables")
        draw(runs[0], scenes, stage.folder / stage.outputs[-1])
        return {}

    def _body(self, stage: Stage, threads: int) -> Body:
        """What makes the robots of a stage."""
        from romnav.robot.rom import ReducedOrderModel

        walks = cast(Scale, stage.settings).navigation.dynamics == "g1"
        return self._humanoid(stage, threads) if walks else ReducedOrderModel

    def _humanoid(self, stage: Stage, threads: int) -> Callable[[World, int, float], Humanoid]:
        """What makes humanoids that walk by the stage's locomotion policy.

        Raises:
            RomnavError: They are to walk on another device than the CPU.
        """
        if self.device != "cpu":
            raise RomnavError(f"{stage.name}: the humanoid has no physics engine on {self.device} here; use cpu")
        from romnav.robot.gaits import GaitLibrary
        from romnav.robot.humanoid import Humanoid

        above = {stage.kind: stage for stage in stage.upstream}
        return partial(
            Humanoid,
            checkpoint=above["locomotion"].folder / "policy.pt",
            gaits=GaitLibrary.load(above["gaits"].folder / "gaits.pt"),
            seed=stage.seed or 0,
            threads=threads,
        )

    def _driver(self, stage: Stage, world: World) -> Driver:
        """The policy or script of the arm of a stage."""
        from romnav.evaluation import rollout
        from romnav.navigation import checkpoint

        driver = self.plan.project.driver(str(stage.arm))
        if driver in SCRIPTED:
            return rollout.SCRIPTED[driver]()
        trained = stage.upstream[-1]
        perception = self._perception(trained, cast(Scale, stage.settings), world, EVALUATION_NOISE)
        depth = perception.depth.encoder if perception.depth else None
        path = trained.folder / "policy.pt"
        actor = checkpoint.load_actor(path, perception.encoder, self.device, depth_encoder=depth)
        return rollout.Policy(actor, perception)

    def _provenance(self, stage: Stage, episode_set: str) -> Provenance:
        """Where the rows of a stage come from."""
        from romnav.evaluation.rowfile import Provenance

        facts: dict[str, Any] = {"steps": 0, "hours": 0.0}
        policy = None
        if self.plan.project.driver(str(stage.arm)) not in SCRIPTED:
            policy = stage.upstream[-1].folder / "policy.pt"
            record = store.read(stage.upstream[-1])
            facts = record.facts if record else facts
        source = store.provenance()
        return Provenance(
            scale=self.plan.scale.name,
            commit=source["commit"],
            spec_hash=stage.key[:16],
            checkpoint_sha256=digest(policy) if policy else None,
            episode_set=episode_set,
            version=__version__,
            machine=source["machine"],
            **facts,
        )

    def world(self, spec: WorldSpec, progress: Progress | None = None) -> World:
        """Terrain, from the cache if it was built before."""
        from romnav.world.build import build

        return build(spec, self.plan.project.worlds, progress)

    def _perception(self, policy: Stage, settings: Scale, world: World, noise: int) -> Perception:
        """What a policy sees; through a depth camera, too, if its training had one."""
        from romnav.navigation.perception import Perception

        seen = {above.sensor: above.folder / "encoder.pt" for above in policy.upstream if above.kind == "encoder"}
        lidar = self._eye("lidar", seen.get("lidar"), policy, settings, world, noise)
        if "depth" not in seen:
            return Perception(lidar)
        return Perception(lidar, self._eye("depth", seen["depth"], policy, settings, world, noise + DEPTH_NOISE))

    def _eye(
        self, sensor: str, pretrained: Path | None, policy: Stage, settings: Scale, world: World, noise: int
    ) -> Eye:
        """A sensor with its pretrained encoder, or the random one that a policy's training began with."""
        from romnav.navigation.perception import Eye
        from romnav.robot.arms import OwnArms
        from romnav.sensing import encoder as encoders
        from romnav.sensing.corruption import Corruption

        navigation, pretraining = settings.navigation, getattr(settings, PRETRAINING[sensor])
        eye, spec = self._sensor(sensor, settings, world.tiles), pretraining.encoder
        if pretrained is not None:
            encoder = encoders.load(pretrained, spec, self.device)
        else:
            encoder = encoders.untrained(spec, eye.directions, policy.seed or 0).encoder.to(self.device)
        # a running sensor loses far fewer pixels than pretraining drops, a camera as a LiDAR
        depth = pretraining.corruption.model_copy(update={"dropout": navigation.corruption.dropout})
        corruption = Corruption(navigation.corruption if sensor == "lidar" else depth, noise, self.device)
        arms = None
        if navigation.dynamics == "g1":
            robot = settings.locomotion.robot
            arms = OwnArms(robot, eye.directions, levelled=sensor == "lidar", device=self.device)
        return Eye(eye, corruption, encoder.requires_grad_(False), arms)

    def _sensor(self, sensor: str, settings: Scale, tiles: Sequence[Tile]) -> Lidar | DepthCamera:
        from romnav.sensing.depth import DepthCamera
        from romnav.sensing.lidar import Lidar

        solids = [tile.solids for tile in tiles]
        if sensor == "lidar":
            return Lidar(solids, settings.lidar, self.device, self.plan.project.worlds)
        return DepthCamera(solids, settings.depth, self.device)
