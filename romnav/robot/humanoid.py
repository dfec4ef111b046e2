"""The humanoid as the `Dynamics` of the navigation task: the frozen locomotion policy under velocity commands."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from romnav import random
from romnav.errors import RomnavError
from romnav.robot.dynamics import Head
from romnav.robot.g1 import HEAD, Humanoids, build_spec
from romnav.robot.gaits import Gait, GaitLibrary
from romnav.robot.heights import TileHeights
from romnav.robot.locomotion.control import Controller, has_fallen
from romnav.robot.locomotion.planar import heading_of
from romnav.robot.locomotion.train import load_policy
from romnav.robot.spec import RobotSpec
from romnav.robot.statics import NOTHING
from romnav.robot.tiles import change_layer, geoms
from romnav.world.solids import Label
from romnav.world.spawns import Start
from romnav.world.world import World

STEP_UP = 0.3
"""The surface that a robot is over lies at most this far above its lower foot, m."""
FOOTING = 0.35
"""Distance from the side of a stair or ramp within which nobody is put on it, m."""
_CLOCK, _FRAME = range(2)
_STATE = ("tile", "layer", "position", "yaw", "contacts", "fallen", "_env", "_resets", "_first")


def _head_on(torso: Tensor, rotation: Tensor) -> Head:
    """The sensors of robots whose torsos are at (E, 3), m, turned by (E, 3, 3)."""
    turn = rotation.nan_to_num()
    origin = (torso + turn @ torch.tensor(HEAD)).nan_to_num()
    tilt = torch.stack([torch.atan2(turn[:, 2, 1], turn[:, 2, 2]), -turn[:, 2, 0].clamp(-1.0, 1.0).asin()], dim=1)
    return Head(origin, heading_of(turn), tilt)


class Skeleton:
    """The body without its physics, for postures that are known."""

    def __init__(self, spec: RobotSpec) -> None:
        self._data = mujoco.MjData(build_spec(spec, NOTHING).compile())

    def head(self, joints: NDArray[np.float64]) -> Head:
        """The sensors (of one robot) that generalised positions (Q,) carry."""
        self._data.qpos[:] = joints
        mujoco.mj_kinematics(self._data.model, self._data)
        torso = self._data.body("torso_link")
        return _head_on(torch.tensor(torso.xpos[None]).float(), torch.tensor(torso.xmat.reshape(1, 3, 3)).float())


class _Slope(NamedTuple):
    """A place to start on a stair or ramp: on the middle of a tread, along the flight."""

    kind: str
    direction: int
    steepness: float
    middle: tuple[float, float, float]
    heading: float


class Humanoid:
    """``E`` robots on the tiles of a world, stepped by MuJoCo; the `Dynamics` of the humanoid stage.

    A start on a stair or ramp takes a state out of the gait library, walking up or down, whichever is nearer to
    the start's heading; where the library has none, the robot stands on the slope in that heading.
    """

    def __init__(
        self,
        world: World,
        envs: int,
        period: float,
        checkpoint: Path,
        gaits: GaitLibrary,
        *,
        seed: int = 0,
        threads: int = 0,
        stair_limits: tuple[float, float] | None = None,
        first: int = 0,
    ) -> None:
        """
        Args:
            world: on the CPU.
            envs: number of robots.
            period: of a command, s; a multiple of the control step, 20 ms.
            checkpoint: of the locomotion policy.
            gaits: recorded from it.
            seed: of first feet and times along gaits.
            threads: of the physics; 0 means all cores. They do not change the result.
            stair_limits: fastest forward command, m/s, and turn, rad/s, followed while the next foothold is not level
                with the feet.
            first: number of the first robot, where those before it are elsewhere; what is drawn depends on numbers.

        Raises:
            RomnavError: the checkpoint is missing, or the period is no multiple of the control step.
        """
        self.world, self.period, self.gaits, self.seed = world, period, gaits, seed
        self.stair_limits = stair_limits
        self._spec, self._policy, _ = load_policy(checkpoint)
        self._heights = TileHeights(world.tiles)
        self.tile = torch.zeros(envs, dtype=torch.int64)
        self.layer = torch.zeros(envs, dtype=torch.int64)
        self.position = torch.zeros(envs, 3)
        self.yaw = torch.zeros(envs)
        self.contacts = torch.zeros(envs)
        self.fallen = torch.zeros(envs, dtype=torch.bool)
        self._env = torch.arange(first, first + envs)
        self._resets = torch.zeros(envs, dtype=torch.int64)
        self._first = torch.ones(envs, dtype=torch.bool)
        self.robots = Humanoids(self._spec.robot, [geoms(tile.solids) for tile in world.tiles], envs, threads=threads)
        self.control = Controller(self._spec, self.robots)
        self._ticks = self._spec.robot.ticks(period)
        if not self._ticks:
            raise RomnavError(f"period {period} s: no multiple of the control step, {self.control.dt} s")

    def _enter_tiles(self) -> None:
        self.robots.stand_on(self.tile)
        self._heights.place(self.tile)

    def reset(self, envs: Tensor, start: Start) -> None:
        """Put the robots ``envs`` (K,) at their starts."""
        self.tile[envs], self.layer[envs] = start.tile, start.layer
        self._enter_tiles()
        self._resets[envs] += 1
        z = self._under(envs, start)
        at, heading = torch.cat([start.xy, z[:, None]], dim=1), start.yaw.clone()
        walking: list[int] = []
        gaits: list[Gait] = []
        for k, tile in enumerate(start.tile.tolist()):
            slope = self._slope(tile, start.xy[k].numpy(), float(z[k]), float(heading[k]))
            if slope is None:
                continue
            at[k], heading[k] = torch.tensor(slope.middle), slope.heading
            if self.gaits.has(slope.kind, slope.direction):
                walking.append(k)
                gaits.append(self.gaits.nearest(slope.kind, slope.direction, slope.steepness))
        clock = self._draw(envs, _CLOCK, 2) * self._spec.gait.step_ticks
        self.control.stand(envs, at, heading, clock, torch.zeros(len(envs), 3))
        self._first[envs] = True
        if walking:
            ids = envs[walking]
            frames = self._draw(ids, _FRAME, torch.tensor([len(gait) for gait in gaits]))
            self.gaits.place(self.control, ids, gaits, frames, at[walking], heading[walking])
            self._first[ids] = False
        self.contacts[envs], self.fallen[envs] = 0.0, False
        self._read()

    def _under(self, envs: Tensor, start: Start) -> Tensor:
        """(K,) height of the surface under the starts themselves, not under the middles of their cells."""
        xy, reach = self.position[:, :2].clone(), torch.zeros(len(self.tile))
        xy[envs] = start.xy
        reach[envs] = self.world.surface(start.tile, start.layer, start.xy) + STEP_UP
        return self._heights(xy, reach)[envs]

    def _draw(self, envs: Tensor, purpose: int, high: int | Tensor) -> Tensor:
        return random.integers(high, self.seed, self._env[envs], self._resets[envs], purpose)

    def _slope(self, tile: int, xy: np.ndarray, z: float, yaw: float) -> _Slope | None:
        """Where to walk if a start (2,) on the surface `z` is on a stair or ramp; None where it is not."""
        solids = self.world.tiles[tile].solids
        (u,), (v,) = (part.T for part in solids.local(xy[None]))
        top = solids.top + solids.slope_top * u
        under = solids.walkable & (np.abs(u) <= solids.half[:, 0]) & (np.abs(v) <= solids.half[:, 1])
        under &= np.abs(top - z) < 0.02
        slope = under & np.isin(solids.label, (Label.STAIR, Label.RAMP))
        found = self._flight(tile, xy, z) if slope.any() else None
        if found is None:
            return None
        step, (along, steepness) = np.flatnonzero(slope)[0], found
        kind = "ramp" if solids.label[step] == Label.RAMP else "stair"
        up = np.cos(yaw - along) >= 0
        side = max(solids.half[step, 1] - FOOTING, 0.0)
        at_u, at_v = (u[step] if kind == "ramp" else 0.0), np.clip(v[step], -side, side)
        c, s = np.cos(solids.yaw[step]), np.sin(solids.yaw[step])
        x, y = solids.centre[step] + at_u * np.array([c, s]) + at_v * np.array([-s, c])
        middle = x, y, solids.top[step] + solids.slope_top[step] * at_u
        return _Slope(kind, 1 if up else -1, steepness, middle, along if up else along + np.pi)

    def _flight(self, tile: int, xy: np.ndarray, z: float) -> tuple[float, float] | None:
        """Heading uphill, rad, and rise over run of the connector's piece that passes nearest to a point."""
        best, found = np.inf, None
        for connector in self.world.tiles[tile].connectors:
            for a, b in zip(connector.path[:-1], connector.path[1:], strict=True):
                run, rise = b[:2] - a[:2], b[2] - a[2]
                length = float(np.hypot(*run))
                if rise == 0.0 or length == 0.0:
                    continue
                t = float(np.clip((xy - a[:2]) @ run / length**2, 0.0, 1.0))
                away = np.hypot(*(a[:2] + t * run - xy)) + abs(a[2] + t * rise - z)
                if away < best:
                    best, up = away, run * np.sign(rise)
                    found = float(np.arctan2(up[1], up[0])), abs(rise) / length
        return found

    @property
    def proprioception(self) -> Tensor:
        """(E, 8): gait phase (sine, cosine), pelvis angular rate, rad/s, and projected gravity, both pelvis frame."""
        angle = torch.pi * self.control.walker.clock / self._spec.gait.step_ticks
        phase = torch.stack([torch.sin(angle), torch.cos(angle)], dim=1)
        return torch.cat([phase, self.robots.spin, -self.robots.orientation[:, 2]], dim=1).nan_to_num()

    @property
    def brink(self) -> Tensor:
        """(E,) bool: no drop-off stops it, it falls."""
        return torch.zeros_like(self.fallen)

    @property
    def head(self) -> Head:
        """Sensors as the torso carries them."""
        return _head_on(self.robots.torso, self.robots.torso_rotation)

    @property
    def joints(self) -> Tensor:
        """(E, 22): position, m, and orientation, wxyz, of the pelvis; then `JOINTS`, rad."""
        return self.robots.state(torch.arange(len(self.tile)))[0]

    @torch.no_grad()
    def step(self, command: Tensor) -> None:
        """Walk under the command (E, 3) for one period; who has fallen stays down."""
        touched, kicked = torch.zeros_like(self.robots.touch), torch.zeros_like(self.robots.kicks)
        for _ in range(self._ticks):
            followed = self._followed(command)
            self.control.refer(followed, self._heights, self._first)
            action = self._policy(self.control.observe(followed, self._heights))
            self.control.act(action, (~self.fallen).nonzero()[:, 0])
            self._first = torch.zeros_like(self._first)
            touched |= self.robots.touch
            kicked |= self.robots.kicks
            self.fallen = self.fallen | has_fallen(self.robots)
        touched[:, self.robots.feet] = kicked
        self.contacts = touched.sum(1).float()
        self._read()

    def _followed(self, command: Tensor) -> Tensor:
        """Commands (E, 3), slower on stairs if there is a limit."""
        if self.stair_limits is None:
            return command
        forward, turn = self.stair_limits
        walker = self.control.walker
        steep = ((walker.foothold[:, 2] - walker.base).abs() > self._spec.gait.level) & ~self._first
        slow = command.clone()
        slow[:, 0] = command[:, 0].clamp(max=forward)
        slow[:, 2] = command[:, 2].clamp(-turn, turn)
        return torch.where(steep[:, None], slow, command)

    def _read(self) -> None:
        """Poses and layers from the physics."""
        pelvis = self.robots.pelvis
        reach = self.control.walker.soles(self.robots)[..., 2].amin(1) + STEP_UP
        yaw = heading_of(self.robots.orientation)
        # Physics that blew up counts as a fall, where the robot was last.
        finite = pelvis.isfinite().all(1) & yaw.isfinite() & reach.isfinite() & ~self.robots.lost
        xy = torch.where(finite[:, None], pelvis[:, :2], self.position[:, :2])
        z = torch.where(finite, self._heights(xy, reach), self.position[:, 2])
        self.position = torch.cat([xy, z[:, None]], dim=1)
        self.yaw = torch.where(finite, yaw, self.yaw)
        self.layer = change_layer(self.world, self.tile, self.layer, xy, z)

    def select(self, envs: Tensor) -> None:
        """Keep only the robots ``envs`` (K,), in that order."""
        self.robots = self.robots.part(envs)
        self.control = self.control.part(envs, self.robots)
        for name in _STATE:
            setattr(self, name, getattr(self, name)[envs])
        self._heights.place(self.tile)

    def state_dict(self) -> dict[str, Any]:
        """Everything that changes while stepping."""
        own = {name: getattr(self, name).clone() for name in _STATE}
        physics = {f"physics.{name}": value for name, value in self.robots.state_dict().items()}
        walker = self.control.snapshot(torch.arange(len(self.tile)))
        return own | physics | {f"walker.{name}": value for name, value in walker.items()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue where `state_dict` was taken."""
        for name in _STATE:
            setattr(self, name, state[name].clone())
        self._enter_tiles()
        parts: dict[str, dict[str, Tensor]] = {"physics": {}, "walker": {}}
        for name, value in state.items():
            if "." in name:
                part, key = name.split(".")
                parts[part][key] = value
        self.control.restore(torch.arange(len(self.tile)), parts["walker"])
        # After `restore`, which forgets contacts and the solver's warm start.
        self.robots.load_state_dict(parts["physics"])
