"""Furniture and street furniture: small groups of solids in a local frame, and where to put them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from romnav.world.solids import SolidsBuilder
from romnav.world.tiles.site import Floor, Frame, Span, block

Draw = Callable[[SolidsBuilder, np.random.Generator, Frame, float, float, float], None]


@dataclass(frozen=True)
class Item:
    """A kind of furniture: how it is drawn at ``z`` over a ``length`` x ``width`` footprint about a frame."""

    draw: Draw
    length: Span
    width: Span
    wall: bool
    """Whether its back (v = -width/2) stands against a wall."""


def _table(b: SolidsBuilder, rng: np.random.Generator, f: Frame, z: float, length: float, width: float) -> None:
    height = float(rng.uniform(0.70, 0.78))
    u, v = length / 2, width / 2
    block(b, f, (-u, u), (-v, v), (z + height - 0.04, z + height))
    for su in (-1, 1):
        for sv in (-1, 1):
            b.cylinder(f.at(su * (u - 0.06), sv * (v - 0.06)), 0.03, (z, z + height - 0.04))


def _chair(b: SolidsBuilder, rng: np.random.Generator, f: Frame, z: float, length: float, width: float) -> None:
    u, v = length / 2, width / 2
    block(b, f, (-u, u), (-v, v), (z + 0.42, z + 0.46))
    block(b, f, (-u, u), (-v, -v + 0.04), (z + 0.46, z + 0.9))
    for su in (-1, 1):
        for sv in (-1, 1):
            b.cylinder(f.at(su * (u - 0.03), sv * (v - 0.03)), 0.02, (z, z + 0.42))


def _desk(b: SolidsBuilder, rng: np.random.Generator, f: Frame, z: float, length: float, width: float) -> None:
    _table(b, rng, f.sub(0.0, -width / 2 + 0.35), z, length, 0.7)
    _chair(
        b,
        rng,
        f.sub(float(rng.uniform(-0.2, 0.2)), width / 2 - 0.3, np.pi + float(rng.normal(0, 0.3))),
        z,
        0.44,
        0.44,
    )


def _dining(b: SolidsBuilder, rng: np.random.Generator, f: Frame, z: float, length: float, width: float) -> None:
    _table(b, rng, f, z, length - 0.4, width - 1.0)
    for side in (0.0, np.pi):
        for u in np.arange(-(length - 1.2) / 2, (length - 1.2) / 2 + 0.01, 0.7):
            turn = side + np.pi + float(rng.normal(0.0, 0.15))
            at = f.sub(0.0, 0.0, side).sub(float(u), width / 2 - 0.3)
            _chair(b, rng, Frame(at.x, at.y, f.yaw + turn), z, 0.42, 0.42)


def _shelf(b: SolidsBuilder, rng: np.random.Generator, f: Frame, z: float, length: float, width: float) -> None:
    u, v, height = length / 2, width / 2, float(rng.uniform(1.2, 2.1))
    block(b, f, (-u, u), (-v, -v + 0.02), (z, z + height))
    for s in (-1, 1):
        block(b, f, (s * (u - 0.015) - 0.015, s * (u - 0.015) + 0.015), (-v + 0.02, v), (z, z + height))
    for level in np.linspace(0.08, height - 0.04, 5):
        block(b, f, (-u + 0.03, u - 0.03), (-v + 0.02, v), (z + float(level) - 0.015, z + float(level) + 0.015))


def _cabinet(b: SolidsBuilder, rng: np.random.Generator, f: Frame, z: float, length: float, width: float) -> None:
    block(b, f, (-length / 2, length / 2), (-width / 2, width / 2), (z, z + float(rng.uniform(0.75, 2.0))))


def _sofa(b: SolidsBuilder, rng: np.random.Generator, f: Frame, z: float, length: float, width: float) -> None:
    u, v = length / 2, width / 2
    block(b, f, (-u + 0.18, u - 0.18), (-v + 0.22, v), (z + 0.08, z + 0.43))
    block(b, f, (-u + 0.18, u - 0.18), (-v, -v + 0.22), (z + 0.08, z + 0.85))
    for s in (-1, 1):
        block(b, f, (s * (u - 0.09) - 0.09, s * (u - 0.09) + 0.09), (-v, v), (z, z + 0.62))


def _bed(b: SolidsBuilder, rng: np.random.Generator, f: Frame, z: float, length: float, width: float) -> None:
    u, v = length / 2, width / 2
    block(b, f, (-u, u), (-v + 0.06, v), (z + 0.12, z + 0.5))
    block(b, f, (-u, u), (-v, -v + 0.06), (z, z + 0.95))


def _plant(b: SolidsBuilder, rng: np.random.Generator, f: Frame, z: float, length: float, width: float) -> None:
    pot = float(rng.uniform(0.3, 0.45))
    b.cylinder((f.x, f.y), length / 2, (z, z + pot))
    b.cylinder((f.x, f.y), 0.03, (z + pot, z + pot + 0.4))
    b.cylinder((f.x, f.y), length * 0.6, (z + pot + 0.4, z + pot + float(rng.uniform(0.8, 1.2))))


def _pillar(b: SolidsBuilder, rng: np.random.Generator, f: Frame, z: float, length: float, width: float) -> None:
    if rng.random() < 0.5:
        b.cylinder((f.x, f.y), length / 2, (z, z + 3.8))
    else:
        block(b, f, (-length / 2, length / 2), (-length / 2, length / 2), (z, z + 3.8))


def _pole(b: SolidsBuilder, rng: np.random.Generator, f: Frame, z: float, length: float, width: float) -> None:
    b.cylinder((f.x, f.y), float(rng.uniform(0.015, 0.05)), (z, z + float(rng.uniform(1.2, 2.6))))
    b.cylinder((f.x, f.y), 0.16, (z, z + 0.03))


def _hanging(b: SolidsBuilder, rng: np.random.Generator, f: Frame, z: float, length: float, width: float) -> None:
    low = z + float(rng.uniform(0.95, 1.3))
    high = low + float(rng.uniform(0.15, 0.5))
    block(b, f, (-length / 2, length / 2), (-width / 2, width / 2), (low, high))
    b.cylinder((f.x, f.y), 0.01, (high, z + 3.8))


def _crate(b: SolidsBuilder, rng: np.random.Generator, f: Frame, z: float, length: float, width: float) -> None:
    height = float(rng.uniform(0.25, 0.7))
    block(b, f, (-length / 2, length / 2), (-width / 2, width / 2), (z, z + height))
    if rng.random() < 0.4:
        top = f.sub(0.0, 0.0, float(rng.uniform(-0.6, 0.6)))
        k = 0.35 * min(length, width)
        block(b, top, (-k, k), (-k, k), (z + height, z + height + float(rng.uniform(0.2, 0.5))))


def _bench(b: SolidsBuilder, rng: np.random.Generator, f: Frame, z: float, length: float, width: float) -> None:
    u, v = length / 2, width / 2
    block(b, f, (-u, u), (-v, v), (z + 0.4, z + 0.46))
    for s in (-1, 1):
        block(b, f, (s * (u - 0.2) - 0.05, s * (u - 0.2) + 0.05), (-v + 0.03, v - 0.03), (z, z + 0.4))
    if rng.random() < 0.5:
        block(b, f, (-u, u), (-v, -v + 0.04), (z + 0.5, z + 0.9))


def _planter(b: SolidsBuilder, rng: np.random.Generator, f: Frame, z: float, length: float, width: float) -> None:
    height = float(rng.uniform(0.35, 0.6))
    block(b, f, (-length / 2, length / 2), (-width / 2, width / 2), (z, z + height))
    for u in np.arange(-length / 2 + 0.3, length / 2 - 0.29, 0.55):
        top = height + float(rng.uniform(0.25, 0.6))
        b.cylinder(f.at(float(u), 0.0), min(0.25, width * 0.4), (z + height, z + top))


def _tree(b: SolidsBuilder, rng: np.random.Generator, f: Frame, z: float, length: float, width: float) -> None:
    fork = float(rng.uniform(1.9, 2.6))
    crown = float(rng.uniform(0.7, 1.15))
    b.cylinder((f.x, f.y), float(rng.uniform(0.08, 0.18)), (z, z + fork))
    b.cylinder((f.x, f.y), 0.75 * crown, (z + fork, z + fork + 0.5))
    b.cylinder((f.x, f.y), crown, (z + fork + 0.5, z + fork + 1.4))
    b.cylinder((f.x, f.y), 0.6 * crown, (z + fork + 1.4, z + fork + 2.1))


def _bollard(b: SolidsBuilder, rng: np.random.Generator, f: Frame, z: float, length: float, width: float) -> None:
    b.cylinder((f.x, f.y), float(rng.uniform(0.05, 0.1)), (z, z + float(rng.uniform(0.7, 1.0))))


def _lamp(b: SolidsBuilder, rng: np.random.Generator, f: Frame, z: float, length: float, width: float) -> None:
    height = z + float(rng.uniform(3.2, 4.2))
    b.cylinder((f.x, f.y), 0.12, (z, z + 0.3))
    b.cylinder((f.x, f.y), 0.05, (z + 0.3, height))
    b.cylinder((f.x, f.y), 0.25, (height, height + 0.2))


def _sign(b: SolidsBuilder, rng: np.random.Generator, f: Frame, z: float, length: float, width: float) -> None:
    low = z + float(rng.uniform(0.9, 1.3))
    for s in (-1, 1):
        b.cylinder(f.at(s * (length / 2 - 0.05), 0.0), 0.03, (z, low + 0.6))
    block(b, f, (-length / 2, length / 2), (0.03, 0.06), (low, low + 0.6))


def _car(b: SolidsBuilder, rng: np.random.Generator, f: Frame, z: float, length: float, width: float) -> None:
    u, v = length / 2, width / 2
    block(b, f, (-u, u), (-v, v), (z + 0.2, z + 0.85))
    block(b, f, (-0.55 * u, 0.65 * u), (-v + 0.1, v - 0.1), (z + 0.85, z + 1.45))
    for su in (-0.62, 0.62):
        for sv in (-1, 1):
            block(b, f, (su * u - 0.3, su * u + 0.3), (sv * (v - 0.1) - 0.1, sv * (v - 0.1) + 0.1), (z, z + 0.2))


def _barrier(b: SolidsBuilder, rng: np.random.Generator, f: Frame, z: float, length: float, width: float) -> None:
    for s in (-1, 1):
        block(
            b,
            f,
            (s * (length / 2 - 0.1) - 0.03, s * (length / 2 - 0.1) + 0.03),
            (-width / 2, width / 2),
            (z, z + 0.6),
        )
    block(b, f, (-length / 2, length / 2), (-0.02, 0.02), (z + 0.6, z + 0.9))


def _portal(b: SolidsBuilder, rng: np.random.Generator, f: Frame, z: float, length: float, width: float) -> None:
    head = z + float(rng.uniform(1.45, 1.9))
    for s in (-1, 1):
        at = s * (length / 2 - 0.075)
        block(b, f, (at - 0.075, at + 0.075), (-width / 2, width / 2), (z, head))
    block(b, f, (-length / 2, length / 2), (-width / 2, width / 2), (head, head + 0.2))


ROOM = (
    Item(_desk, (1.2, 1.8), (1.3, 1.4), True),
    Item(_dining, (1.6, 2.6), (1.8, 2.1), False),
    Item(_shelf, (0.8, 2.4), (0.28, 0.4), True),
    Item(_cabinet, (0.5, 1.6), (0.4, 0.65), True),
    Item(_sofa, (1.5, 2.3), (0.8, 0.95), True),
    Item(_bed, (1.0, 1.8), (2.0, 2.1), True),
    Item(_plant, (0.3, 0.5), (0.3, 0.5), True),
    Item(_crate, (0.4, 0.9), (0.4, 0.9), False),
    Item(_hanging, (0.3, 1.2), (0.1, 0.5), False),
    Item(_pole, (0.3, 0.3), (0.3, 0.3), False),
)
CLUTTER = (
    *ROOM,
    Item(_pillar, (0.3, 0.5), (0.3, 0.5), False),
    Item(_portal, (1.6, 2.4), (0.15, 0.4), False),
    Item(_bench, (1.2, 1.8), (0.4, 0.5), True),
    Item(_barrier, (1.0, 1.8), (0.3, 0.5), False),
)
HALL = (
    Item(_sofa, (1.5, 2.3), (0.8, 0.95), True),
    Item(_plant, (0.3, 0.5), (0.3, 0.5), True),
    Item(_bench, (1.2, 1.8), (0.4, 0.5), True),
    Item(_cabinet, (0.5, 1.2), (0.35, 0.5), True),
    Item(_pillar, (0.3, 0.5), (0.3, 0.5), False),
    Item(_hanging, (0.3, 1.2), (0.1, 0.5), False),
)
STREET = (
    Item(_bench, (1.4, 2.0), (0.45, 0.55), False),
    Item(_planter, (1.0, 2.6), (0.6, 1.0), False),
    Item(_tree, (0.4, 0.4), (0.4, 0.4), False),
    Item(_tree, (0.4, 0.4), (0.4, 0.4), False),
    Item(_bollard, (0.2, 0.2), (0.2, 0.2), False),
    Item(_lamp, (0.25, 0.25), (0.25, 0.25), False),
    Item(_sign, (0.8, 1.4), (0.1, 0.1), False),
    Item(_crate, (0.4, 1.0), (0.4, 1.0), False),
)
ROAD = (
    Item(_car, (3.8, 4.6), (1.7, 1.9), False),
    Item(_barrier, (1.0, 1.8), (0.3, 0.5), False),
    Item(_bollard, (0.2, 0.2), (0.2, 0.2), False),
)


def furnish(
    solids: SolidsBuilder,
    rng: np.random.Generator,
    floor: Floor,
    frame: Frame,
    size: tuple[float, float],
    z: float,
    items: tuple[Item, ...],
    count: int,
    *,
    gap: float = 0.9,
    turn: float = 0.5,
) -> None:
    """Put up to ``count`` items into the local rectangle ``[0, size[0]] x [0, size[1]]``.

    Items keep ``gap`` (m) from each other; those that do not stand against a wall keep it from the walls too
    and are rotated at random with probability ``turn``.
    """
    for _ in range(count):
        item = items[int(rng.integers(len(items)))]
        length, width = float(rng.uniform(*item.length)), float(rng.uniform(*item.width))
        for _ in range(6):
            if item.wall:
                at = _against_wall(rng, frame, size, length, width)
            else:
                yaw = float(rng.uniform(0.0, np.pi)) if rng.random() < turn else float(rng.integers(2)) * np.pi / 2
                at = frame.sub(float(rng.uniform(0.0, size[0])), float(rng.uniform(0.0, size[1])), yaw)
            clear = 0.0 if item.wall else gap
            u, v = (-length / 2, length / 2), (-width / 2, width / 2)
            if floor.fits(at, (u[0] - clear, u[1] + clear), (v[0] - clear, v[1] + clear)):
                item.draw(solids, rng, at, z, length, width)
                floor.reserve(at, u, v, gap)
                break


def _against_wall(
    rng: np.random.Generator, frame: Frame, size: tuple[float, float], length: float, width: float
) -> Frame:
    side = int(rng.integers(4))
    span = size[side % 2]
    along = float(rng.uniform(0.0, 1.0)) * max(span - length, 0.0) + length / 2
    off = width / 2 + 0.01
    u, v = ((along, off), (size[0] - off, along), (size[0] - along, size[1] - off), (off, size[1] - along))[side]
    return frame.sub(u, v, side * np.pi / 2)
