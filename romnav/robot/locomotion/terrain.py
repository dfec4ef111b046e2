"""The ground of the locomotion curriculum: lanes of one terrain each, as boxes and as a height map."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from romnav.robot.heights import HeightMap
from romnav.robot.statics import Geoms


@dataclass
class Slab:
    """A solid over [x0, x1] x [y0, y1] from z = 0 to a top that rises linearly along x from z0 to z1."""

    x0: float
    x1: float
    y0: float
    y1: float
    z0: float
    z1: float


@dataclass(frozen=True)
class Lane:
    """A path over one terrain.

    Attributes:
        kind: terrain class.
        level: difficulty, from 0 within its kind.
        path: (k, 2) centre line, m.
        slabs: the ground above z = 0.
        spawns: arc lengths, m, of level places to start from.
    """

    kind: str
    level: int
    path: NDArray[np.float64]
    slabs: list[Slab] = field(default_factory=list)
    spawns: tuple[float, ...] = (0.5,)

    @property
    def length(self) -> float:
        """Arc length of the path, m."""
        return float(np.linalg.norm(np.diff(self.path, axis=0), axis=1).sum())


MARGIN = 1.6
"""Level ground before and after a terrain, m."""


def stairs(level: int, riser: float, up: float, down: float, steps: int, *, landing: float = 1.6) -> Lane:
    """A flight up, a landing and a flight down, with treads `up` and `down`, m."""
    slabs, x = [], MARGIN
    for k in range(steps - 1):
        slabs.append(Slab(x, x + up, -1.2, 1.2, riser * (k + 1), riser * (k + 1)))
        x += up
    top = x + landing / 2
    slabs.append(Slab(x, x + landing, -1.2, 1.2, riser * steps, riser * steps))
    x += landing
    for k in range(steps - 1, 0, -1):
        slabs.append(Slab(x, x + down, -1.2, 1.2, riser * k, riser * k))
        x += down
    end = x + MARGIN
    return Lane("stairs", level, np.array([[0.0, 0.0], [end, 0.0]]), slabs, (MARGIN / 2, top, end - MARGIN / 2))


def uturn(level: int, riser: float, tread: float, steps: int, *, width: float = 1.4) -> Lane:
    """Two flights side by side that meet on a landing: a switchback, the second flight on solid ground."""
    slabs, far, half = [], MARGIN + tread * (steps - 1), width / 2
    for k in range(steps - 1):
        x = MARGIN + tread * k
        slabs.append(Slab(x, x + tread, -half, half, riser * (k + 1), riser * (k + 1)))
        back = riser * (2 * steps - k - 1)
        slabs.append(Slab(x, x + tread, half + 0.1, half + 0.1 + width, back, back))
    slabs.append(Slab(far, far + 1.5, -half, half + 0.1 + width, riser * steps, riser * steps))
    slabs.append(Slab(0.0, MARGIN, half + 0.1, half + 0.1 + width, riser * 2 * steps, riser * 2 * steps))
    turn, side = far + 0.75, width + 0.1
    path = np.array([[0.0, 0.0], [turn, 0.0], [turn, side], [0.0, side]])
    total = 2 * turn + side
    return Lane("uturn", level, path, slabs, (MARGIN / 2, turn, total - MARGIN / 2))


def ramp(level: int, degrees: float, length: float, *, landing: float = 1.6) -> Lane:
    """A ramp up, a landing and a ramp down; `length` is horizontal, m."""
    rise = length * float(np.tan(np.radians(degrees)))
    a, b = MARGIN + length, MARGIN + length + landing
    slabs = [
        Slab(MARGIN, a, -1.2, 1.2, 0.0, rise),
        Slab(a, b, -1.2, 1.2, rise, rise),
        Slab(b, b + length, -1.2, 1.2, rise, 0.0),
    ]
    end = b + length + MARGIN
    return Lane("ramp", level, np.array([[0.0, 0.0], [end, 0.0]]), slabs, (MARGIN / 2, (a + b) / 2, end - MARGIN / 2))


def rough(level: int, amplitude: float, rng: np.random.Generator) -> Lane:
    """Blocks of random height on a grid of 0.5 x 0.6 m."""
    slabs = [
        Slab(x, x + 0.5, y, y + 0.6, h, h)
        for x in np.arange(MARGIN, MARGIN + 6.0, 0.5)
        for y in (-1.2, -0.6, 0.0, 0.6)
        for h in [float(rng.uniform(0.005, amplitude))]
    ]
    end = 2 * MARGIN + 6.0
    return Lane("rough", level, np.array([[0.0, 0.0], [end, 0.0]]), slabs, (MARGIN / 2, end - MARGIN / 2))


def flat(level: int = 0) -> Lane:
    """Level ground; its path is only a place to start from, out of reach of the other lanes."""
    return Lane("flat", level, np.array([[-60.0, 0.0], [-59.0, 0.0]]), [], (0.5,))


def curriculum(rng: np.random.Generator) -> list[Lane]:
    """The lanes of training, easy to hard within each kind."""
    lanes = [flat()]
    lanes += [rough(i, a, rng) for i, a in enumerate((0.02, 0.035, 0.05))]
    lanes += [ramp(i, a, 3.0) for i, a in enumerate((4.0, 7.0, 10.0, 13.0, 16.0))]
    flights = (
        (0.04, 0.31, 0.27), (0.07, 0.27, 0.31), (0.10, 0.31, 0.27), (0.12, 0.27, 0.31), (0.14, 0.31, 0.25),
        (0.15, 0.25, 0.31), (0.17, 0.31, 0.25), (0.17, 0.25, 0.27), (0.185, 0.27, 0.31),
    )  # fmt: skip
    lanes += [stairs(i, *shape, steps=12 if shape[0] > 0.1 else 8) for i, shape in enumerate(flights)]
    lanes += [uturn(i, r, t, 6) for i, (r, t) in enumerate(((0.08, 0.31), (0.13, 0.27), (0.155, 0.31), (0.175, 0.27)))]
    return lanes


class Ground:
    """Lanes side by side: one world, one height map, and the path of each lane.

    Attributes:
        geoms: the lanes, to walk on.
        map: the height map (2 cm cells).
        path: (lanes, points, 2) world, m, padded by repeating the last point.
        arc: (lanes, points) arc length at each point, m.
        length: (lanes,) m.
        spawn: (lanes, spawns) arc lengths, padded by repeating.
    """

    def __init__(self, lanes: list[Lane], *, cell: float = 0.02) -> None:
        self.lanes = lanes
        centre: list[Any] = []
        half: list[Any] = []
        quat: list[Any] = []
        offsets, y = [], 0.0
        for lane in lanes:
            low = min([s.y0 for s in lane.slabs], default=-1.2)
            high = max([s.y1 for s in lane.slabs], default=1.2)
            offsets.append(y - low)
            y += high - low + 1.0
        far = max(
            [0.0] + [s.x1 for lane in lanes for s in lane.slabs] + [float(lane.path[:, 0].max()) for lane in lanes]
        )
        origin = np.array([-4.0, -4.0])
        shape = np.ceil((np.array([far + 4.0, y + 4.0]) - origin) / cell).astype(int)
        heights = np.zeros(shape)
        # A sloped slab is a thick plate whose upper face is the slope.
        thickness = 0.1
        for lane, dy in zip(lanes, offsets, strict=True):
            for s in lane.slabs:
                slope = np.arctan2(s.z1 - s.z0, s.x1 - s.x0)
                mid = np.array([(s.x0 + s.x1) / 2, (s.y0 + s.y1) / 2 + dy, (s.z0 + s.z1) / 2])
                long = (s.x1 - s.x0) / np.cos(slope) / 2
                if slope:
                    down = np.array([np.sin(slope), 0.0, -np.cos(slope)])
                    centre.append(mid + down * thickness)
                    half.append([long, (s.y1 - s.y0) / 2, thickness])
                else:
                    centre.append([mid[0], mid[1], s.z0 / 2])
                    half.append([long, (s.y1 - s.y0) / 2, s.z0 / 2])
                quat.append([np.cos(-slope / 2), 0.0, np.sin(-slope / 2), 0.0])
                i0, i1 = np.ceil((np.array([s.x0, s.x1]) - origin[0]) / cell - 0.5).astype(int)
                j0, j1 = np.ceil((np.array([s.y0, s.y1]) + dy - origin[1]) / cell - 0.5).astype(int)
                x = origin[0] + (np.arange(i0, i1) + 0.5) * cell
                top = s.z0 + (x - s.x0) / (s.x1 - s.x0) * (s.z1 - s.z0)
                heights[i0:i1, j0:j1] = np.maximum(heights[i0:i1, j0:j1], top[:, None])
        self.geoms = Geoms.boxes(
            np.array(centre).reshape(-1, 3), np.array(half).reshape(-1, 3), np.array(quat).reshape(-1, 4)
        )
        self.map = HeightMap((origin[0], origin[1]), cell, torch.tensor(heights, dtype=torch.float32))
        points = max(len(lane.path) for lane in lanes)
        path = np.stack(
            [
                np.pad(lane.path, ((0, points - len(lane.path)), (0, 0)), mode="edge") + np.array([0.0, dy])
                for lane, dy in zip(lanes, offsets, strict=True)
            ]
        )
        arc = np.concatenate(
            [np.zeros((len(lanes), 1)), np.linalg.norm(np.diff(path, axis=1), axis=2).cumsum(1)], axis=1
        )
        spawns = max(len(lane.spawns) for lane in lanes)
        self.path = torch.tensor(path, dtype=torch.float32)
        self.arc = torch.tensor(arc, dtype=torch.float32)
        self.length = self.arc[:, -1]
        self.spawn = torch.tensor([[lane.spawns[k % len(lane.spawns)] for k in range(spawns)] for lane in lanes])

    def at(self, lane: Tensor, arc: Tensor) -> Tensor:
        """Points (n, 2) at arc lengths (n,) of lanes (n,), clamped to the ends."""
        a = self.arc[lane]
        arc = arc.clamp(min=0.0).minimum(a[:, -1])[:, None]
        k = (torch.searchsorted(a.contiguous(), arc.contiguous(), right=True) - 1).clamp(0, a.shape[1] - 2)
        start, end = a.gather(1, k), a.gather(1, k + 1)
        t = ((arc - start) / (end - start).clamp(min=1e-6)).clamp(0.0, 1.0)
        pick = self.path[lane]
        p = pick.gather(1, k[..., None].expand(-1, -1, 2))[:, 0]
        q = pick.gather(1, (k + 1)[..., None].expand(-1, -1, 2))[:, 0]
        return p + t * (q - p)

    def project(self, lane: Tensor, point: Tensor, arc: Tensor, window: float = 0.24) -> Tensor:
        """Arc length (n,) of the nearest point of the path within `window` of the last one, `arc`, to 2 cm."""
        count = 2 * round(window / 0.02) + 1
        tries = arc[:, None] + torch.linspace(-window, window, count)
        at = self.at(lane.repeat_interleave(count), tries.flatten()).reshape(-1, count, 2)
        best = (at - point[:, None]).square().sum(-1).argmin(1, keepdim=True)
        return tries.gather(1, best)[:, 0].clamp(min=0.0).minimum(self.length[lane])


def steer(
    ground: Ground, lane: Tensor, arc: Tensor, forward: Tensor, point: Tensor, heading: Tensor, speed: Tensor
) -> Tensor:
    """Velocity command (n, 3) that follows a path: pursue a point 0.7 m ahead, slow down where it bends away."""
    ahead = ground.at(lane, arc + 0.7 * forward)
    # Beyond the end of the path, keep its direction.
    end = ground.at(lane, arc + 0.05 * forward) - ground.at(lane, arc - 0.05 * forward)
    over = torch.where(forward > 0, arc + 0.7 - ground.length[lane], 0.7 - arc).clamp(min=0.0)
    end = end / end.norm(dim=1, keepdim=True).clamp(min=1e-6) * forward.abs()[:, None]
    to = ahead + end * over[:, None] - point
    error = torch.atan2(to[:, 1], to[:, 0]) - heading
    error = torch.atan2(torch.sin(error), torch.cos(error))
    return torch.stack(
        [speed * torch.cos(error).clamp(min=0.2), torch.zeros_like(error), (2.0 * error).clamp(-1.0, 1.0)],
        dim=1,
    )
