"""The reduced-order model with a body: an upright cylinder that touches the exact solids and slides along them.

The reduced-order model of training collides on 0.2 m cells, which are free or not as a whole. Here the paper's rule (a
command into an obstacle loses its penetrating component) is kept, but on true geometry, so that the robot can come as
near to an obstacle as its body, and touch it. Drop-offs and the ends of the walking surface stay on the grid: against
them there is no contact.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from romnav.kernels import wp
from romnav.robot.rom import ReducedOrderModel
from romnav.robot.spec import BodySpec
from romnav.world.scenes.scene import terrain_only
from romnav.world.solids import Solids
from romnav.world.spawns import Start
from romnav.world.world import World

PUSHES = 4
"""Solids that a body may be pushed out of in one substep: in a corner they take turns."""
_GAP = wp.constant(1e-4)
"""Left between the body and what it was pushed out of, m."""
_TOLERANCE = 1e-3
"""Deeper overlap, m, is not accepted: the body stays where it was."""

wp.set_module_options({"enable_backward": False})


@wp.struct
class Prism:
    """One solid, see `romnav.world.solids.Solids`."""

    box: wp.bool
    centre: wp.vec2
    cos: float
    sin: float
    half: wp.vec2
    bottom: float
    top: float
    slope_bottom: float
    slope_top: float


@wp.func
def _below(offset: float, slope: float, span: wp.vec2):
    """Part of ``span`` in u where ``offset + slope u < 0``; empty if its ends have changed places."""
    if slope == 0.0:
        return wp.where(offset < 0.0, span, wp.vec2(1.0, -1.0))
    root = -offset / slope
    if slope > 0.0:
        return wp.vec2(span[0], wp.min(span[1], root))
    return wp.vec2(wp.max(span[0], root), span[1])


@wp.func
def _escape(prism: Prism, xy: wp.vec2, low: float, high: float, radius: float):
    """Shortest way (x, y) out of the part of ``prism`` between two heights for a disc, and its length; 0 if clear."""
    d = xy - prism.centre
    u = prism.cos * d[0] + prism.sin * d[1]
    v = prism.cos * d[1] - prism.sin * d[0]
    span = _below(low - prism.top, -prism.slope_top, wp.vec2(-prism.half[0], prism.half[0]))
    span = _below(prism.bottom - high, prism.slope_bottom, span)
    if span[0] > span[1]:
        return wp.vec3()
    way = wp.vec2()
    depth = float(0.0)  # noqa: UP018 - in Warp, float() declares a variable that changes
    if prism.box:
        du = u - wp.clamp(u, span[0], span[1])
        dv = v - wp.clamp(v, -prism.half[1], prism.half[1])
        distance = wp.sqrt(du * du + dv * dv)
        depth = radius - distance
        if distance > 0.0:
            way = wp.vec2(du, dv) / distance
        else:
            # the axis itself is inside: out by the nearest face
            out = wp.vec4(u - span[0], span[1] - u, v + prism.half[1], prism.half[1] - v)
            k = wp.argmin(out)
            depth = radius + out[k]
            way = wp.vec2(
                wp.where(k == wp.uint32(0), -1.0, wp.where(k == wp.uint32(1), 1.0, 0.0)),
                wp.where(k == wp.uint32(2), -1.0, wp.where(k == wp.uint32(3), 1.0, 0.0)),
            )
    else:
        distance = wp.sqrt(u * u + v * v)
        depth = radius + prism.half[0] - distance
        way = wp.vec2(1.0, 0.0)
        if distance > 0.0:
            way = wp.vec2(u, v) / distance
    if depth <= 0.0:
        return wp.vec3()
    return wp.vec3(prism.cos * way[0] - prism.sin * way[1], prism.sin * way[0] + prism.cos * way[1], depth)


@wp.kernel
def _push(
    prisms: wp.array(dtype=Prism),
    first: wp.array(dtype=int),
    tile: wp.array(dtype=wp.int64),
    position: wp.array(dtype=wp.vec3),
    radius: float,
    step: float,
    height: float,
    pushes: int,
    xy: wp.array(dtype=wp.vec2),
    touched: wp.array(dtype=wp.bool),
    left: wp.array(dtype=float),
):
    """Push each body out of the solid that it overlaps most, some times over; the overlap that is left."""
    e = wp.tid()
    t = int(tile[e])
    at = wp.vec2(position[e][0], position[e][1])
    low = position[e][2] + step
    high = position[e][2] + height
    touched[e] = False
    for push in range(pushes + 1):
        worst = wp.vec3()
        for k in range(first[t], first[t + 1]):
            prism = prisms[k]
            reach = radius + prism.half[0] + prism.half[1]
            if wp.abs(at[0] - prism.centre[0]) < reach and wp.abs(at[1] - prism.centre[1]) < reach:
                way = _escape(prism, at, low, high, radius)
                if way[2] > worst[2]:
                    worst = way
        left[e] = worst[2]
        if worst[2] == 0.0:
            break
        touched[e] = True
        if push < pushes:
            at += wp.vec2(worst[0], worst[1]) * (worst[2] + _GAP)
    xy[e] = at


class Obstacles:
    """The solids of each tile that are no walking surface, for contact with upright cylinders."""

    def __init__(self, solids: list[Solids], body: BodySpec, device: str = "cpu") -> None:
        parts = [s[~s.walkable] for s in solids]
        rows = np.zeros(sum(map(len, parts)), dtype=Prism.numpy_dtype())
        columns = {
            "box": lambda s: s.shape == 0,
            "centre": lambda s: s.centre,
            "cos": lambda s: np.cos(s.yaw),
            "sin": lambda s: np.sin(s.yaw),
            **{name: lambda s, name=name: getattr(s, name) for name in ("half", "bottom", "top")},
            **{name: lambda s, name=name: getattr(s, name) for name in ("slope_bottom", "slope_top")},
        }
        for name, column in columns.items():
            rows[name] = np.concatenate([column(s) for s in parts])
        self.body = body
        self._device = device
        self._prisms = wp.array(rows, dtype=Prism, device=device)
        self._first = wp.array(np.cumsum([0, *map(len, parts)]), dtype=int, device=device)

    def push_out(self, tile: Tensor, position: Tensor, pushes: int = PUSHES) -> tuple[Tensor, Tensor, Tensor]:
        """Where bodies (E,) standing at ``position`` (E, 3) are pushed by the solids that they overlap.

        Returns:
            (E, 2) m, (E,) bool whether they overlapped any, (E,) the deepest overlap that is left, m.
        """
        count = len(tile)
        xy = torch.empty(count, 2, device=self._device)
        touched = torch.empty(count, dtype=torch.bool, device=self._device)
        left = torch.empty(count, device=self._device)
        inputs = [
            self._prisms,
            self._first,
            wp.from_torch(tile.contiguous()),
            wp.from_torch(position.contiguous(), dtype=wp.vec3),
            self.body.radius,
            self.body.step,
            self.body.height,
            pushes,
        ]
        outputs = [wp.from_torch(xy, dtype=wp.vec2), wp.from_torch(touched), wp.from_torch(left)]
        wp.launch(_push, count, inputs, outputs, device=self._device)
        return xy, touched, left


class BodyModel(ReducedOrderModel):
    """``E`` cylinders driven like the reduced-order model; the `Dynamics` of the obstacle experiments.

    ``contacts`` counts solids touched, not drop-offs that stopped the robot: those are in ``brink`` (E,) bool.
    """

    def __init__(self, world: World, envs: int, period: float, body: BodySpec | None = None) -> None:
        body = body or BodySpec()
        super().__init__(terrain_only(world, body.radius), envs, period)
        self.obstacles = Obstacles([tile.solids for tile in world.tiles], body, str(world.node.device))
        self.brink = torch.zeros_like(self.fallen)

    def reset(self, envs: Tensor, start: Start) -> None:
        """Put the robots ``envs`` (K,) at their starts."""
        super().reset(envs, start)
        self.brink[envs] = False

    def select(self, envs: Tensor) -> None:
        """Keep only the robots ``envs`` (K,), in that order."""
        super().select(envs)
        self.brink = self.brink[envs]

    def step(self, command: Tensor) -> None:
        """Integrate the command (E, 3) for one period."""
        self.brink = torch.zeros_like(self.brink)
        super().step(command)

    def _slide(self, move: Tensor) -> Tensor:
        position, layer = self.position, self.layer
        self.brink |= super()._slide(move)
        xy, touched, left = self.obstacles.push_out(self.tile, self.position)
        if touched.any():
            free = self.world.node_at(self.tile, self.layer, xy) >= 0
            self._place(torch.where((touched & free)[:, None], xy, self.position[:, :2]))
            # on another step of a stair, or over a drop-off, the way out may be none
            _, _, now = self.obstacles.push_out(self.tile, self.position, pushes=0)
            back = touched & (~free | (torch.maximum(left, now) > _TOLERANCE))
            self.position = torch.where(back[:, None], position, self.position)
            self.layer = torch.where(back, layer, self.layer)
        return touched
