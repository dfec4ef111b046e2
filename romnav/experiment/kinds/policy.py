"""The navigation policy of an arm, and what it sees."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

from romnav import ranks
from romnav.errors import RomnavError
from romnav.experiment.graph.stage import Session, Stage
from romnav.experiment.kinds.encoder import SENSORS, encoder, make_sensor
from romnav.experiment.kinds.locomotion import body, cpu_only, walking
from romnav.experiment.scales import Scale
from romnav.experiment.spec import suggest
from romnav.experiment.workspace import Workspace
from romnav.navigation.spec import require_same_task
from romnav.progress import Progress

if TYPE_CHECKING:
    from torch import Tensor

    from romnav.navigation.perception import Eye, Perception
    from romnav.sensing.encoder import Encoder
    from romnav.world.world import World

DEPTH_NOISE = 1_000_003
"""Added to the seed of the LiDAR's noise for that of the camera."""


def policy(work: Workspace, arm: str, seed: int) -> Stage:
    """The trained policy of an arm, or of the one whose policy it drives; a teacher, and one that it begins with, are
    trained with the same seed.

    Raises:
        RomnavError: One of these is no trained arm, the teacher was taught itself or for another task, or the arm
            begins with itself.
    """
    arm = work.project.driver(arm)
    settings = work.arm_settings(arm)
    folder = work.folder / arm / f"seed-{seed}"
    encoders = _encoders(work, settings)
    uses = ["world", "lidar", "navigation"]
    if "lidar" not in encoders:
        uses.append("pretrain.encoder")
    if "depth" in encoders:
        uses += ["depth", "pretrain_depth.corruption"]
    teacher = [_teacher(work, arm, settings.kickstart.teacher, seed)] if settings.kickstart else []
    if teacher:
        uses.append("kickstart")
    begun = [_begun(work, arm, settings.begin, seed)] if settings.begin else []
    if begun:
        uses.append("begin")
    return Stage(
        kind="policy",
        name=f"policy {arm}, seed {seed}",
        folder=folder,
        outputs=("policy.pt", "curve.csv"),
        record=folder / "spec.json",
        settings=settings,
        uses=tuple(uses),
        make=partial(_train, work, settings),
        upstream=(*encoders.values(), *teacher, *begun, *walking(work, settings)),
        scratch=("checkpoint.pt",),
        beside=("curve.csv", "kept", "kept.csv"),
        command=work.command("train", "policy", arm, "--seed", str(seed)),
        cpu_only=cpu_only(settings),
        shared=True,
        arm=arm,
        seed=seed,
    )


def _teacher(work: Workspace, arm: str, teacher: str, seed: int) -> Stage:
    key = _trained(work, arm, "kickstart.teacher", teacher)
    if work.arm_settings(teacher).kickstart:
        raise RomnavError(f"{key}: {teacher} has a teacher itself; name one that was trained by PPO alone")
    # known now, not after the teacher's training
    require_same_task(work.arm_settings(teacher).navigation, work.arm_settings(arm).navigation, key)
    return policy(work, teacher, seed)


def _begun(work: Workspace, arm: str, begin: str, seed: int) -> Stage:
    chain, above = [arm], begin
    while above:
        key = _trained(work, chain[-1], "begin", above)
        if above in chain:
            raise RomnavError(f"{key}: {' begins with '.join([*chain, above])}; one of them has to begin anew")
        chain.append(above)
        above = work.arm_settings(above).begin or ""
    return policy(work, begin, seed)


def _trained(work: Workspace, arm: str, setting: str, other: str) -> str:
    """Where the ``setting`` of ``arm`` stands that names the ``other`` one.

    Raises:
        RomnavError: That is not trained, or may be in an experiment that is invalid.
    """
    project = work.project
    key = f"{project.file(project.having(arm)[0])}: arms.{arm}.{setting}"
    trained = {a for e in project.experiments.values() for a, spec in e.arms.items() if spec.trained}
    if other not in trained:
        if project.faults and other not in project.arms:
            project.having(other)  # tells what is wrong with a file that may have it
        raise RomnavError(f"{key}: no arm {other} that is trained{suggest(other, trained)}")
    return key


def _encoders(work: Workspace, settings: Scale) -> dict[str, Stage]:
    """Pretrained encoders of a policy that is trained with these settings, by sensor."""
    sensors = ["lidar"] if settings.navigation.encoder.pretrained else []
    if settings.navigation.dynamics == "g1":
        sensors.append("depth")
    return {sensor: encoder(work, sensor, settings) for sensor in sensors}


def _train(work: Workspace, settings: Scale, stage: Stage, session: Session, progress: Progress) -> dict[str, Any]:
    from romnav.navigation import checkpoint
    from romnav.navigation.train import train
    from romnav.world.build import build

    world, seed = build(settings.ground, work.project.worlds, progress), stage.seed or 0
    others = {above.arm: above.folder / "policy.pt" for above in stage.upstream if above.kind == "policy"}
    path = train(
        settings.navigation,
        world,
        perception(work, stage, settings, world, noise=seed, device=session.device),
        stage.folder,
        seed,
        body=body(work, settings, seed, session.device, settings.navigation.ppo.threads),
        kickstart=(settings.kickstart, others[settings.kickstart.teacher]) if settings.kickstart else None,
        begin=others[settings.begin] if settings.begin else None,
        device=session.device,
        resume=session.resume,
        progress=progress,
    )
    if ranks.rank() > 0:
        return {}  # the first process tells, and it alone may see the file yet
    trained = checkpoint.read(path)
    # the number of processes changes bits, as another machine does, but not the experiment: no setting, but recorded
    return {name: trained[name] for name in ("steps", "hours", "processes") if name in trained}


def perception(
    work: Workspace, trained: Stage, settings: Scale, world: World, *, noise: int, device: str
) -> Perception:
    """What a policy sees; through a depth camera, too, if its training had one.

    Args:
        work: Where encoders lie.
        trained: Stage of the policy.
        settings: Of the robots that it drives: other ones than in its training, maybe.
        world: Where they are.
        noise: Seed of the sensors' noise.
        device: Where images are made.
    """
    from romnav.navigation.perception import Perception

    pretrained = _encoders(work, work.arm_settings(str(trained.arm)))
    noises = {"lidar": noise, "depth": noise + DEPTH_NOISE}
    eyes = {
        sensor: eye(work, settings, sensor, pretrained.get(sensor), trained.seed or 0, world, noises[sensor], device)
        for sensor in ("lidar", *(pretrained.keys() - {"lidar"}))
    }
    return Perception(**eyes)


def frozen_encoders(work: Workspace, trained: Stage) -> tuple[Encoder, Encoder | None]:
    """Encoders of the LiDAR and, if it has one, the depth camera of a policy, as its training began with them."""
    from romnav.sensing.image import directions

    settings = work.arm_settings(str(trained.arm))
    pretrained = _encoders(work, settings)
    rays = directions(settings.lidar)
    lidar = _encoder(settings, "lidar", pretrained.get("lidar"), trained.seed or 0, rays, "cpu")
    depth = _encoder(settings, "depth", pretrained["depth"], 0, rays, "cpu") if "depth" in pretrained else None
    return lidar, depth


def _encoder(
    settings: Scale, sensor: str, pretrained: Stage | None, seed: int, directions: Tensor, device: str
) -> Encoder:
    """The pretrained encoder of a sensor, or the random one that the training with ``seed`` began with."""
    from romnav.sensing import encoder as encoders

    spec = getattr(settings, SENSORS[sensor]).encoder
    if pretrained:
        return encoders.load(pretrained.folder / "encoder.pt", spec, device)
    return encoders.untrained(spec, directions, seed).encoder.to(device).requires_grad_(False)


def eye(
    work: Workspace,
    settings: Scale,
    sensor: str,
    pretrained: Stage | None,
    seed: int,
    world: World,
    noise: int,
    device: str,
) -> Eye:
    """A sensor and its encoder."""
    from romnav.navigation.perception import Eye
    from romnav.robot.arms import OwnArms
    from romnav.sensing.corruption import Corruption

    navigation, pretraining = settings.navigation, getattr(settings, SENSORS[sensor])
    scanner = make_sensor(work, settings, sensor, world.tiles, device)
    made = _encoder(settings, sensor, pretrained, seed, scanner.directions, device)
    # a running sensor loses far fewer pixels than pretraining drops, a camera as a LiDAR
    depth = pretraining.corruption.model_copy(update={"dropout": navigation.corruption.dropout})
    corruption = Corruption(navigation.corruption if sensor == "lidar" else depth, noise, device)
    arms = None
    if navigation.dynamics == "g1":
        arms = OwnArms(settings.locomotion.robot, scanner.directions, levelled=sensor == "lidar", device=device)
    return Eye(scanner, corruption, made, arms)
