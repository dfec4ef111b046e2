"""Episodes in the browser, by viser: the tile, the ways of several arms, and what one of them saw and decided."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

import matplotlib
import numpy as np
import viser
import viser.uplot
from numpy.typing import NDArray
from scipy import stats

from romnav.errors import RomnavError
from romnav.evaluation.paired.replay import Replay
from romnav.report.paired.gallery import EpisodeGallery
from romnav.report.paired.maps import shortest
from romnav.report.replay.parts import ARMS, COLOURS, Figure, parts
from romnav.robot.spec import RobotSpec
from romnav.world.solids import Label

HEIGHT, RADIUS = 1.32, 0.26
"""The cylinder that stands for a robot without joints, m: around the G1."""
RANGE = 16.0
"""Distance at which the colours of the range image end, m."""
ZOOM = 4
"""Screen pixels of an image pixel, at least."""
FRAME = 1 / 30
"""Time between two pictures of a playing replay, s."""
UP = np.array([0.0, 0.0, 1.0])
BACK, NEAR = np.array([-12.0, -12.0, 16.0]), np.array([-2.0, -2.0, 1.5])
"""Where an episode and a robot are looked at from, m."""
NO_TIME = {"x": viser.uplot.Scale(time=False)}
SPEEDS = ("1", "2", "4", "8", "16")


@dataclass(frozen=True)
class Seen:
    """An episode again, and the classes that the encoder sees in it."""

    replay: Replay
    labels: NDArray[np.int8] | None
    """(K, rows, columns) `Label`; None where the arm has no pretrained encoder."""


Drive = Callable[[str, int], Seen]
"""(arm, episode) -> the episode again."""


class Viewer:
    """A page that replays episodes; it is there until `stop`.

    Args:
        galleries: Evaluated arms by name, on the same episodes.
        chosen: Episodes to choose from.
        drive: Goes through one again, when what was seen is asked for.
        robot: The humanoid.
        host: Address to listen on; the loopback is for this machine only.
        port: Port.

    Raises:
        RomnavError: The port is taken.
    """

    def __init__(
        self,
        galleries: Mapping[str, EpisodeGallery],
        chosen: Sequence[int],
        drive: Drive,
        robot: RobotSpec,
        host: str = "127.0.0.1",
        port: int = 8080,
    ) -> None:
        self._galleries, self._drive, self._robot = galleries, drive, robot
        first = next(iter(galleries.values()))
        self._episodes, self._world, self._table = first.episodes, first.world, first.table
        # time goes in steps of the shortest period, s
        self._period = min(gallery.period for gallery in galleries.values())
        self._seen: dict[tuple[str, int], Seen] = {}
        self._figure: Figure | None = None
        self._lock = threading.RLock()
        self._episode, self._step = chosen[0], 0
        self._nodes: list[Any] = []
        self._bodies: dict[str, Any] = {}
        self._joints: dict[str, list[Any]] = {}
        try:
            self.server = viser.ViserServer(host=host, port=port, label="romnav", verbose=False)
        except OSError as error:
            raise RomnavError(f"--port {port}: {error.strerror or error}; choose another one") from error
        if self.server.get_port() != port:
            self.server.stop()
            raise RomnavError(f"--port {port}: is taken; choose another one")
        scene = self.server.scene
        scene.set_up_direction("+z")
        scene.configure_default_lights(False)
        scene.add_light_ambient("/light/all", intensity=1.6)
        scene.add_light_directional("/light/sun", intensity=1.4, position=(8.0, -14.0, 30.0), cast_shadow=False)
        self._controls(chosen)
        self._open(self._episode)
        self._running = True
        self._thread = threading.Thread(target=self._play, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Ends the server."""
        self._running = False
        self._thread.join()
        self.server.stop()

    def _controls(self, chosen: Sequence[int]) -> None:
        gui, names = self.server.gui, list(self._galleries)
        self._choice = gui.add_dropdown("episode", [str(k) for k in chosen], initial_value=str(chosen[0]))
        self._told = gui.add_markdown("")
        self._time = gui.add_slider("step", 0, 1, 1, initial_value=0)
        self._playing = gui.add_checkbox("play", initial_value=True)
        self._speed = gui.add_dropdown("speed", SPEEDS, initial_value="4")
        self._storeys = gui.add_slider("storeys shown", 1, 4, 1, initial_value=4)
        self._follow = gui.add_checkbox("hide storeys above the robot", initial_value=True)
        self._chase = gui.add_checkbox("go along with the robot", initial_value=False)
        self._shown = {name: gui.add_checkbox(name, initial_value=True) for name in names}
        with gui.add_folder("what an arm sees"):
            self._eyes = gui.add_dropdown(
                "arm", ["none", *names], initial_value=names[0] if len(names) == 1 else "none"
            )
            self._decided = gui.add_markdown("")
            blank = np.zeros((2, 2, 3), np.uint8)
            self._range = gui.add_image(blank, label="range", visible=False)
            self._classes = gui.add_image(blank, label="classes that the encoder sees", visible=False)
            grid = np.linspace(-1.0, 1.0, 101)
            series = [viser.uplot.Series(label="action")]
            series += [
                viser.uplot.Series(label=name, stroke=stroke, width=2)
                for name, stroke in (("vx", "#1f6fb4"), ("vy", "#d55e00"), ("wz", "#009e73"))
            ]
            self._betas = gui.add_uplot(
                (grid, *(np.zeros_like(grid),) * 3), tuple(series), aspect=1.6, visible=False, scales=NO_TIME
            )
            along = [viser.uplot.Series(label="s")]
            along += [
                viser.uplot.Series(label=name, stroke=stroke, width=2)
                for name, stroke in (("expected return", "#7b3294"), ("h", "#b2182b"))
            ]
            self._along = gui.add_uplot(
                (grid, *(np.zeros_like(grid),) * 2), tuple(along), aspect=1.6, visible=False, scales=NO_TIME
            )
        self._choice.on_update(lambda _: self._open(int(self._choice.value)))
        self._time.on_update(lambda _: self._show(int(self._time.value)))
        for control in (self._storeys, self._follow):
            control.on_update(lambda _: self._show(self._step))
        self._eyes.on_update(lambda _: self._look())
        for box in self._shown.values():
            box.on_update(lambda _: self._show(self._step))

    def _open(self, episode: int) -> None:
        """Put up an episode: tile, ends, shortest path and ways."""
        with self._lock, self.server.atomic():
            for node in (*self._nodes, *chain.from_iterable(self._joints.values()), *self._bodies.values()):
                node.remove()
            self._nodes, self._joints, self._bodies, self._episode = [], {}, {}, episode
            scene, row = self.server.scene, self._table.loc[episode]
            tile = self._world.tiles[int(row.tile)]
            self._floors, self._walls = [tile.layers[layer] for layer in tile.storeys], []
            for part in parts(tile):
                name = f"/tile/{part.storey}/{part.label.name.lower()}"
                see_through = 0.4 if part.label == Label.OBSTACLE else None
                mesh = scene.add_mesh_simple(
                    name, part.vertices, part.triangles, color=COLOURS[part.label], opacity=see_through,
                    flat_shading=True, side="double",
                )  # fmt: skip
                self._walls.append((part.storey, mesh))
            self._nodes += [mesh for _, mesh in self._walls]
            for end, colour in (("spawn", (40, 40, 40)), ("goal", (178, 24, 43))):
                at = np.array([row[f"{end}_{axis}"] for axis in "xyz"])
                self._nodes.append(scene.add_icosphere(f"/{end}", 0.25, color=colour, position=at + UP / 4))
            (route,) = shortest(self._world, self._episodes, [episode])
            self._nodes.append(self._line("/shortest", route, (123, 50, 148)))
            for k, (name, gallery) in enumerate(self._galleries.items()):
                colour = ARMS[k % len(ARMS)]
                way = gallery.tracks.position[gallery.tracks.of(episode)]
                self._nodes.append(self._line(f"/ways/{name}", way, colour))
                self._bodies[name] = scene.add_cylinder(f"/robots/{name}", RADIUS, HEIGHT, color=colour)
            self._points = scene.add_point_cloud("/points", np.zeros((1, 3)), (200, 30, 30), point_size=0.04)
            self._points.visible = False
            self._nodes.append(self._points)
            ends = [(len(self._way(name)) - 1) * gallery.period for name, gallery in self._galleries.items()]
            self._time.max = math.ceil(max(ends) / self._period - 1e-6)
            self._storeys.max = max(2, len(tile.storeys))
            self._storeys.value = self._storeys.max
            middle = route.mean(axis=0)
            self.server.initial_camera.look_at = tuple(middle)
            self.server.initial_camera.position = tuple(middle + BACK)
            for client in self.server.get_clients().values():
                client.camera.position, client.camera.look_at = middle + BACK, middle
            self._told.content = self._tell(row)
            self._seek(0)
        self._look()

    def _tell(self, row: Any) -> str:
        lines = [f"{row.tile_class} {row.tile}, {row.geodesic:.1f} m, climb {row.climb:.1f} m, {row.level} level", ""]
        for name, gallery in self._galleries.items():
            own = gallery.table.loc[self._episode]
            end = f"{own.success_time:.0f} s" if own.outcome == "success" else f"{own['where']}, {own['how']}"
            lines.append(f"* {name}: {end}")
        return "\n".join(lines)

    def _line(self, name: str, way: NDArray[np.float32], colour: tuple[int, int, int]) -> Any:
        raised = way + 0.08 * UP
        segments = np.stack([raised[:-1], raised[1:]], axis=1)
        return self.server.scene.add_line_segments(name, segments, colour, thickness=0.05)

    def _way(self, name: str) -> NDArray[np.float32]:
        tracks = self._galleries[name].tracks
        return tracks.position[tracks.of(self._episode)]

    def _sample(self, name: str, step: int, count: int) -> int:
        """Which of ``count`` samples of an arm, one a period of its own, is that of a step."""
        return min(round(step * self._period / self._galleries[name].period), count - 1)

    def _cut(self) -> None:
        """Hide the storeys above those to show, and above the highest robot in sight."""
        last = int(self._storeys.value) - 1
        heights = [body.position[2] for name, body in self._bodies.items() if self._shown[name].value]
        if self._follow.value and heights:
            last = min(last, int(np.searchsorted(self._floors, max(heights), side="right")) - 1)
        for storey, mesh in self._walls:
            if mesh.visible != (storey <= last):
                mesh.visible = storey <= last

    def _go_along(self) -> None:
        """Look at the first robot in sight from nearby, if that is asked for."""
        robots = (body for name, body in self._bodies.items() if self._shown[name].value)
        if self._chase.value and (robot := next(robots, None)):
            for client in self.server.get_clients().values():
                client.camera.position, client.camera.look_at = robot.position + NEAR, robot.position

    def _look(self) -> None:
        """Go through the episode again for the arm whose eyes are looked through."""
        name, episode = self._eyes.value, self._episode
        if name != "none" and (name, episode) not in self._seen:
            self._decided.content = "going through the episode again ..."
            self._seen[name, episode] = self._drive(name, episode)
        with self._lock:
            for arm in self._galleries:
                if self._postures(arm) is None:
                    for mesh in self._joints.pop(arm, ()):
                        mesh.remove()
                elif arm not in self._joints:
                    self._figure = self._figure or Figure(self._robot)
                    self._joints[arm] = [
                        self.server.scene.add_mesh_simple(f"/joints/{arm}/{k}", vertices, faces, color=tuple(colour))
                        for k, (vertices, faces, colour) in enumerate(self._figure.meshes())
                    ]
            self._show(self._step)

    def _postures(self, name: str) -> NDArray[np.float64] | None:
        """Joints (K + 1, Q) of an arm, kept by its evaluation or those of a humanoid that was driven again."""
        gallery, seen = self._galleries[name], self._seen.get((name, self._episode))
        if gallery.postures is not None:
            return gallery.postures.joints[gallery.tracks.of(self._episode)]
        return seen.replay.joints if seen and name == self._eyes.value else None

    def _seek(self, step: int) -> None:
        if self._time.value == step:
            self._show(step)
        else:
            self._time.value = step  # its callback shows it

    def _show(self, step: int) -> None:
        """Everything as it was at a step."""
        with self._lock, self.server.atomic():
            self._step = step
            for name, body in self._bodies.items():
                way = self._way(name)
                body.position = way[self._sample(name, step, len(way))] + UP * HEIGHT / 2
                body.visible = self._shown[name].value and name not in self._joints
            for name, meshes in self._joints.items():
                joints = self._postures(name)
                if joints is not None and self._figure:
                    posture = joints[self._sample(name, step, len(joints))]
                    for mesh, at, turn in zip(meshes, *self._figure.place(posture), strict=True):
                        mesh.position, mesh.wxyz, mesh.visible = at, turn, self._shown[name].value
            self._cut()
            self._go_along()
            eyes = self._eyes.value
            seen = self._seen.get((eyes, self._episode))
            for shown in (self._range, self._classes, self._betas, self._along, self._points):
                shown.visible = False
            self._decided.content = "" if seen is None else self._draw_sight(eyes, seen, step)

    def _draw_sight(self, name: str, seen: Seen, step: int) -> str:
        replay, sight = seen.replay, seen.replay.sight
        step = self._sample(name, step, len(replay.command))
        vx, vy, wz = replay.command[step]
        lines = [f"command {vx:+.2f} m/s ahead, {vy:+.2f} m/s to the left, {wz:+.2f} rad/s"]
        if replay.value is not None:
            lines.append(f"expected return {replay.value[step]:.2f}")
        elif sight is not None:
            lines.append("expected return: the policy's file has no critic")
        if replay.barrier is not None and replay.filtered is not None:
            x, y = replay.filtered[step]
            lines.append(f"filter: h = {replay.barrier[step]:.2f}, would let {x:+.2f}, {y:+.2f} m/s through")
        self._plot(replay, self._galleries[name].period * np.arange(step + 1))
        if sight is not None:
            self._points.points = sight.points(step)
            colours = matplotlib.colormaps["viridis_r"](np.clip(sight.ranges[step] / RANGE, 0, 1))[..., :3]
            self._range.image = _enlarged(np.where(sight.ranges[step][..., None] > 0, 255 * colours, 0))
            alpha, beta = sight.beta[step]
            reach = sight.support
            grid = np.linspace(-reach, reach, 101)
            density = [stats.beta.pdf(grid, a, b, -reach, 2 * reach) for a, b in zip(alpha, beta, strict=True)]
            self._betas.data = (grid, *(np.nan_to_num(d, posinf=0.0) for d in density))
            for shown in (self._range, self._betas, self._points):
                shown.visible = True
        if seen.labels is not None:
            palette = np.array([COLOURS[label] for label in Label])
            self._classes.image = _enlarged(palette[seen.labels[step]])
            self._classes.visible = True
        return "\n\n".join(lines)

    def _plot(self, replay: Replay, time: NDArray) -> None:
        """Expected return and h at the samples so far, s, as far as they are known."""
        rows = (replay.value, replay.barrier)
        if all(row is None for row in rows):
            return
        blank = np.full(len(time), np.nan)
        self._along.data = (time, *(blank if row is None else row[: len(time)].astype(float) for row in rows))
        self._along.visible = True

    def _play(self) -> None:
        began, start = time.monotonic(), 0
        while self._running:
            time.sleep(FRAME)
            if not self._playing.value:
                began, start = time.monotonic(), self._step
                continue
            step = start + int((time.monotonic() - began) / self._period * float(self._speed.value))
            if step > self._time.max:
                step, began, start = 0, time.monotonic(), 0
            if step != self._step:
                self._seek(step)
                began, start = time.monotonic(), step


def _enlarged(image: NDArray) -> NDArray[np.uint8]:
    return np.repeat(np.repeat(image.astype(np.uint8), ZOOM, axis=0), ZOOM, axis=1)
