"""Episodes as videos: the robot from behind and from above, drawn by MuJoCo."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from romnav import files
from romnav.errors import RomnavError
from romnav.evaluation.paired.replay import Replay
from romnav.report.replay.opengl import FIX
from romnav.report.replay.parts import ARMS, COLOURS, Motion, storeys
from romnav.robot.g1 import build_spec
from romnav.robot.spec import RobotSpec
from romnav.robot.statics import OBSTACLES
from romnav.robot.tiles import geoms
from romnav.world.solids import Label, Solids
from romnav.world.tile import Tile

RATE = 15
"""Pictures per second."""
HEIGHT, RADIUS = 1.32, 0.2
"""The capsule that stands for a robot without joints, m: as tall as the G1."""
GLASS = 0.22
"""Opacity of obstacles as tall as the robot, which would hide it."""
OVERHEAD = 1.9
"""What begins this far above the robot's feet is hidden, m."""
UPSTAIRS = 0.5
"""A floor this far above the robot's feet is translucent, m: on the way down, the camera looks through it."""
BEHIND, ABOVE = (5.5, -32.0), (13.0, -89.0)
"""Distance, m, and elevation, degrees, of the cameras."""
SKY = (0.93, 0.95, 0.98)
UP = np.array([0.0, 0.0, 1.0])
SUFFIXES = (".mp4", ".gif")
COLOURS_OF_A_GIF = 96


class _Scenery:
    """Solids to look at: nothing collides, and what would hide the robot is translucent."""

    def __init__(self, solids: Solids) -> None:
        self._solids, self._geoms = solids, geoms(solids)

    def add_to(self, model: mujoco.MjSpec) -> None:
        """Add them all, named by their number."""
        before = len(model.worldbody.geoms)
        self._geoms.add_to(model)
        obstacle = self._geoms.obstacle
        for body, first, chosen in ((model.worldbody, before, ~obstacle), (model.body(OBSTACLES), 0, obstacle)):
            for geom, k in zip(body.geoms[first:], np.flatnonzero(chosen), strict=True):
                label = Label(self._solids.label[k])
                tall = label == Label.OBSTACLE and self._solids.top[k] - self._solids.bottom[k] > HEIGHT / 2
                geom.name, geom.rgba = f"solid {k}", [*np.array(COLOURS[label]) / 255.0, GLASS if tall else 1.0]
                geom.contype = geom.conaffinity = 0


class Film:
    """Pictures of a replay on its tile.

    Args:
        tile: Where it took place.
        replay: The episode.
        goal: (3,) m.
        route: (N, 3) shortest path, m.
        robot: The humanoid, drawn if the replay has its joints.
        size: Height of the picture, pixels; it is two squares side by side.

    Raises:
        RomnavError: There is neither a GPU nor software to draw with.
    """

    def __init__(
        self, tile: Tile, replay: Replay, goal: NDArray, route: NDArray, robot: RobotSpec, size: int = 480
    ) -> None:
        self._replay, self._goal, self._route, self._size = replay, goal, route, size
        standing = tile.solids.top + np.abs(tile.solids.slope_top) * tile.solids.half[:, 0] > 1e-6
        solids = tile.solids[standing]
        scenery = _Scenery(solids)
        self._motion = None if replay.joints is None else Motion(replay.joints)
        if self._motion is not None:
            spec = build_spec(robot, scenery, visual=True)
        else:
            spec = mujoco.MjSpec()
            spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1])
            spec.worldbody.add_body(name=OBSTACLES)
            scenery.add_to(spec)
            body = spec.worldbody.add_body(name="robot", mocap=True)
            colour = [*np.array(ARMS[0]) / 255.0, 1.0]
            half = HEIGHT / 2 - RADIUS
            body.add_geom(
                type=mujoco.mjtGeom.mjGEOM_CAPSULE, pos=[0, 0, HEIGHT / 2], size=[RADIUS, half, 0], rgba=colour
            )
            nose = [0.2, 0.05, 0.05]
            body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, pos=[RADIUS, 0, HEIGHT - 0.2], size=nose, rgba=[1, 1, 1, 1])
        spec.geom("floor").rgba = [*np.array(COLOURS[Label.GROUND]) / 255.0, 1.0]
        sun = spec.worldbody.add_light(dir=[0.2, 0.3, -1], type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
        sun.castshadow, sun.diffuse = False, [0.35] * 3
        spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.4] * 3, [0.25] * 3
        spec.visual.headlight.specular = [0.0] * 3
        sky = {"builtin": mujoco.mjtBuiltin.mjBUILTIN_FLAT, "rgb1": SKY, "width": 8, "height": 48}
        spec.add_texture(name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, **sky)
        spec.visual.quality.numslices, spec.visual.quality.numstacks = 12, 8
        spec.visual.global_.offwidth = spec.visual.global_.offheight = size
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        self._solids = np.array([self._model.geom(f"solid {k}").id for k in range(len(solids))])
        self._bottom = np.where(solids.walkable, solids.top, solids.bottom)
        self._alpha = self._model.geom_rgba[self._solids, 3].copy()
        self._ground = storeys(tile)[standing] == 0
        self._floor = solids.walkable & (solids.label == Label.GROUND) & ~self._ground
        try:
            self._renderer = mujoco.Renderer(self._model, size, size)
            for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
                self._renderer.scene.flags[flag] = False  # take software most of its time
        except Exception as error:  # of OpenGL, of any kind
            raise RomnavError(f"no OpenGL to draw with ({str(error).splitlines()[0]}); {FIX}") from error

    def frames(self, speed: float, period: float) -> Iterator[NDArray[np.uint8]]:
        """(size, 2 size, 3) pictures, `RATE` a second, of the replay run ``speed`` times as fast.

        Args:
            speed: Seconds of the episode in a second of the film.
            period: Time between samples of the replay, s.
        """
        last = len(self._replay.position) - 1
        heading = float(self._replay.yaw[0])
        for at in np.arange(0.0, last + 1e-9, speed / (RATE * period)):
            turn = np.angle(np.exp(1j * (self._yaw(at) - heading)))
            heading += 0.12 * turn  # the camera turns more slowly than the robot
            yield self._picture(at, heading)
        for _ in range(RATE):
            yield self._picture(float(last), heading)

    def _picture(self, at: float, heading: float) -> NDArray[np.uint8]:
        k = int(at)
        position = _between(self._replay.position, at)
        if self._motion is not None:
            self._data.qpos[:] = self._motion(at)
        else:
            yaw = self._yaw(at)
            self._data.mocap_pos[0] = position
            self._data.mocap_quat[0] = [np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]
        hidden = (self._bottom > position[2] + OVERHEAD) & ~self._ground
        upstairs = self._floor & (self._bottom > position[2] + UPSTAIRS)
        shown = np.where(upstairs, GLASS, self._alpha)
        self._model.geom_rgba[self._solids, 3] = np.where(hidden, 0.0, shown)
        mujoco.mj_forward(self._model, self._data)
        views = []
        for distance, elevation in (BEHIND, ABOVE):
            camera = mujoco.MjvCamera()
            camera.lookat, camera.distance, camera.elevation = position + 0.8 * UP, distance, elevation
            camera.azimuth = np.degrees(heading) if elevation > -80.0 else 90.0
            self._renderer.update_scene(self._data, camera)
            self._lines(self._route, (0.48, 0.2, 0.58, 1.0), position[2])
            self._lines(self._replay.position[: k + 1], (*np.array(ARMS[0]) / 255.0, 1.0), position[2])
            self._ball(self._goal)
            views.append(self._renderer.render())
        return np.concatenate(views, axis=1)

    def _yaw(self, at: float) -> float:
        k = min(int(at), len(self._replay.yaw) - 2)
        turn = np.angle(np.exp(1j * float(self._replay.yaw[k + 1] - self._replay.yaw[k])))
        return float(self._replay.yaw[k] + (at - k) * turn)

    def _lines(self, points: NDArray, colour: Sequence[float], height: float) -> None:
        """Draw a way, as far as it is not hidden with what is above."""
        shown = points[points[:, 2] < height + OVERHEAD]
        for a, b in zip(shown[:-1:2], shown[2::2], strict=False):
            if np.linalg.norm(b - a) < 1.0:
                lift = 0.06 * UP
                geom = self._new(colour)
                if geom is not None:
                    mujoco.mjv_connector(geom, mujoco.mjtGeom.mjGEOM_CAPSULE, 0.035, a + lift, b + lift)

    def _ball(self, at: NDArray) -> None:
        geom = self._new((0.7, 0.1, 0.17, 0.9))
        if geom is not None:
            geom.pos, geom.size = at + 0.25 * UP, [0.25] * 3

    def _new(self, colour: Sequence[float]) -> Any:
        """Another geom in the scene; None where it is full."""
        scene = self._renderer.scene
        if scene.ngeom >= scene.maxgeom:
            return None
        geom = scene.geoms[scene.ngeom]
        sphere, place, turn = mujoco.mjtGeom.mjGEOM_SPHERE, np.zeros(3), np.eye(3).ravel()
        mujoco.mjv_initGeom(geom, sphere, np.full(3, 0.03), place, turn, np.array(colour, np.float32))
        scene.ngeom += 1
        return geom


def _between(points: NDArray, at: float) -> NDArray[np.float64]:
    k = min(int(at), len(points) - 2)
    return np.asarray((1 - (at - k)) * points[k] + (at - k) * points[k + 1], np.float64)


def check(path: Path) -> None:
    """Makes sure that a video can be written to a path, which is better known before it is drawn.

    Raises:
        RomnavError: Its suffix names no type of video, the encoder of MP4 is not installed, or it cannot be written.
    """
    if path.suffix not in SUFFIXES:
        raise RomnavError(f"--out {path}: a video is {' or '.join(SUFFIXES)}")
    if path.suffix == ".mp4" and find_spec("imageio_ffmpeg") is None:
        raise RomnavError("--out: MP4 needs imageio-ffmpeg; run `pip install 'romnav[video]'`, or name a .gif")
    files.prepare(path)


def write(path: Path, frames: Iterator[NDArray[np.uint8]]) -> None:
    """Writes pictures as a video of the type that the suffix of ``path`` names.

    Raises:
        RomnavError: As `check`.
    """
    check(path)
    if path.suffix == ".gif":
        images = [Image.fromarray(frame) for frame in frames]
        # one palette for all, so that what stands still costs nothing
        palette = images[len(images) // 2].quantize(COLOURS_OF_A_GIF)
        first, *rest = (image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images)
        with files.atomic(path) as file:
            first.save(file, "GIF", save_all=True, append_images=rest, duration=1000 // RATE, loop=0, optimize=True)
        return
    import imageio_ffmpeg

    first_frame = next(frames)
    high, wide, _ = first_frame.shape
    writer = imageio_ffmpeg.write_frames(str(path), (wide, high), fps=RATE, macro_block_size=8)
    writer.send(None)
    for frame in (first_frame, *frames):
        writer.send(np.ascontiguousarray(frame))
    writer.close()
