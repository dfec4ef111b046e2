"""The encoder of a sensor, and what it makes of tiles that it was not trained on."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

from romnav import files
from romnav.errors import RomnavError
from romnav.experiment.graph.stage import Session, Stage
from romnav.experiment.scales import Scale
from romnav.experiment.workspace import Workspace
from romnav.progress import Progress

if TYPE_CHECKING:
    from romnav.sensing.depth import DepthCamera
    from romnav.sensing.lidar import Lidar
    from romnav.world.tile import Tile

SENSORS = {"lidar": "pretrain", "depth": "pretrain_depth"}
"""Section of a scale that tells how the encoder of a sensor is trained, by the section of the sensor."""


def encoder(work: Workspace, sensor: str, settings: Scale | None = None) -> Stage:
    """The encoder of a sensor of `SENSORS`; an arm whose ``settings`` change it gets one of its own."""
    folder, own = work.folder / "encoder" / sensor, settings or work.settings
    stage = Stage(
        kind="encoder",
        name=f"encoder {sensor}",
        folder=folder,
        outputs=("encoder.pt", "curve.csv"),
        record=folder / "encoder.json",
        settings=own,
        uses=("world", sensor, SENSORS[sensor]),
        make=partial(_pretrain, work, own, sensor),
        scratch=("state.pt",),
    )
    if settings is None or stage.key == encoder(work, sensor).key:
        return stage
    folder = folder.with_name(f"{sensor}-{stage.key[:8]}")
    return replace(stage, name=f"encoder {folder.name}", folder=folder, record=folder / "encoder.json")


def _pretrain(
    work: Workspace, settings: Scale, sensor: str, stage: Stage, session: Session, progress: Progress
) -> dict[str, Any]:
    from romnav.sensing.encoder import load
    from romnav.sensing.pretrain import pretrain
    from romnav.world.build import build

    world = build(settings.world, work.project.worlds, progress)
    scanner = make_sensor(work, settings, sensor, world.tiles, session.device)
    path = pretrain(
        getattr(settings, SENSORS[sensor]),
        list(zip(world.tiles, world.grids, strict=True)),
        scanner,
        scanner.spec.height,
        stage.folder,
        device=session.device,
        progress=progress,
        resume=session.resume,
    )
    return {"digest": load(path).digest()}


def quality(work: Workspace, sensor: str) -> Stage:
    """What the encoder of a sensor makes of images from tiles that it was not trained on, in numbers and pictures."""
    trained = encoder(work, sensor)
    return Stage(
        kind="quality",
        name=f"quality of encoder {sensor}",
        folder=trained.folder,
        outputs=("quality.json", "encoder.png"),
        record=trained.folder / "held-out.json",
        settings=work.settings,
        uses=("quality",),
        make=partial(_judge, work, sensor),
        upstream=(trained,),
    )


def _judge(work: Workspace, sensor: str, stage: Stage, session: Session, progress: Progress) -> dict[str, Any]:
    from romnav.report.encoder_figure import draw_encoder
    from romnav.sensing.encoder import load_autoencoder
    from romnav.sensing.pretrain import quality
    from romnav.world.tiles import generate

    settings = work.settings
    spec = settings.quality
    if spec.seed == settings.world.seed:
        raise RomnavError(f"quality.seed: {spec.seed} is the training terrain's; set another one in the scale")
    terrain = settings.world.model_copy(update={"seed": spec.seed})
    tiles = []
    for index in range(spec.tiles):
        tiles.append(generate(terrain, index))
        progress(index + 1, spec.tiles, "tiles")
    scanner = make_sensor(work, settings, sensor, [tile for tile, _ in tiles], session.device)
    model = load_autoencoder(stage.upstream[0].folder / "encoder.pt", session.device)
    training = getattr(settings, SENSORS[sensor])
    judged = (model, tiles, scanner, scanner.spec.height, training.corruption)
    measured = quality(*judged, sway=training.sway, images=spec.images, device=session.device)
    files.write(stage.folder / "quality.json", json.dumps(measured, indent=2) + "\n")
    draw_encoder(*judged, stage.folder / "encoder.png", sway=training.sway, device=session.device)
    return {}


def make_sensor(
    work: Workspace, settings: Scale, sensor: str, tiles: Sequence[Tile], device: str
) -> Lidar | DepthCamera:
    """A sensor of `SENSORS` among the solids of ``tiles``."""
    from romnav.sensing.depth import DepthCamera
    from romnav.sensing.lidar import Lidar

    solids = [tile.solids for tile in tiles]
    if sensor == "lidar":
        return Lidar(solids, settings.lidar, device, work.project.worlds)
    return DepthCamera(solids, settings.depth, device)
