"""Single rooms: clutter on one level, or around a raised stage."""

from __future__ import annotations

import numpy as np

from romnav.errors import RomnavError
from romnav.world.solids import Label, SolidsBuilder
from romnav.world.spec import WorldSpec
from romnav.world.tile import Connector, Tile, TileClass
from romnav.world.tiles.furniture import CLUTTER, furnish
from romnav.world.tiles.site import MAX_FITS, Floor, Frame, block
from romnav.world.tiles.stairs import MOUTH, Railing, add_flight, add_railing, draw_ramp, draw_stair

WALL = 0.2
LEAST = 70.0
"""Least area of a room, m^2."""


def room(rng: np.random.Generator, spec: WorldSpec, index: int) -> Tile:
    """A hall of up to the tile's size, rotated, with furniture, screens and often a stage."""
    solids, floor = SolidsBuilder(), Floor(spec.side)
    most = spec.side - 0.4
    for _ in range(MAX_FITS):
        yaw = float(rng.uniform(-np.pi / 4, np.pi / 4)) if rng.random() < 0.5 else 0.0
        length, depth = float(rng.uniform(0.45, 1.0)) * most, float(rng.uniform(0.4, 0.95)) * most
        c, s = np.cos(yaw), abs(np.sin(yaw))
        if max(length * c + depth * s, length * s + depth * c) <= most and length * depth > LEAST:
            break
    else:
        raise RomnavError(f"world.side: no room of {LEAST:.0f} m^2 fits into {spec.side} m; widen it")
    middle = Frame(spec.side / 2, spec.side / 2, yaw + float(rng.integers(4)) * np.pi / 2)
    frame = middle.sub(-length / 2, -depth / 2)
    block(solids, frame, (0.0, length), (0.0, depth), (-0.2, 0.0), label=Label.GROUND, layers=(0, 0))
    height = float(rng.uniform(2.8, 4.0))
    for u, v in (
        ((0.0, length), (0.0, WALL)),
        ((0.0, length), (depth - WALL, depth)),
        ((0.0, WALL), (WALL, depth - WALL)),
        ((length - WALL, length), (WALL, depth - WALL)),
    ):
        block(solids, frame, u, v, (-0.2, height))
    inner = (length - 2 * WALL, depth - 2 * WALL)
    corner = frame.sub(WALL, WALL)
    floor.open(corner, (0.0, inner[0]), (0.0, inner[1]))
    connectors: list[Connector] = []
    if rng.random() < 0.6:
        connectors = _stage(solids, rng, spec, floor, corner, inner)
    _screens(solids, rng, floor, corner, inner)
    count = int(rng.poisson(inner[0] * inner[1] / 7.0))
    furnish(solids, rng, floor, corner, inner, 0.0, CLUTTER, count, gap=float(rng.uniform(0.75, 1.0)))
    return Tile(
        kind=TileClass.ROOM,
        index=index,
        side=spec.side,
        solids=solids.build(),
        layers=(0.0,),
        storeys=(0,),
        connectors=tuple(connectors),
    )


def _stage(
    solids: SolidsBuilder,
    rng: np.random.Generator,
    spec: WorldSpec,
    floor: Floor,
    corner: Frame,
    inner: tuple[float, float],
) -> list[Connector]:
    """A platform along the wall v = 0 with steps and a ramp at its front."""
    rise = float(rng.uniform(0.3, 0.9))
    width = float(rng.uniform(0.5, 1.0)) * inner[0]
    depth = float(rng.uniform(2.2, 0.45 * inner[1]))
    left = float(rng.choice([0.0, inner[0] - width]))
    stage = corner.sub(left, 0.0)
    block(solids, stage, (0.0, width), (0.0, depth), (-0.1, rise), label=Label.GROUND, layers=(0, 0))
    floor.reserve(stage, (0.0, width), (0.0, depth))
    flights = [draw_stair(rng, spec, rise, float(rng.uniform(1.4, 2.4)))]
    if rng.random() < 0.5 or rise > 0.7:
        flights.append(draw_ramp(rng, rise, float(rng.uniform(1.4, 2.0)), (8.0, 14.0)))
    spare = width - sum(f.width for f in flights) - 0.6
    if spare <= 0.0:
        flights, spare = flights[:1], width - flights[0].width - 0.6
    railing = Railing.draw(rng)
    connectors, at, edge = [], 0.3, 0.0
    guarded = rng.random() < 0.6
    for flight in flights:
        at += spare * float(rng.uniform(0.1, 0.45))
        foot = stage.sub(at + flight.width / 2, depth + flight.length, -np.pi / 2)
        add_flight(solids, foot, 0.0, flight, (0, 0), base=-0.1)
        if guarded and at - edge > 0.5:
            add_railing(solids, stage.sub(0.0, depth - 0.05), (edge, at), rise, railing)
        half = flight.width / 2
        floor.reserve(foot, (-1.4, flight.length), (-half - 0.2, half + 0.2))
        points = [
            (-MOUTH, 0.0, 0.0),
            (0.0, 0.0, 0.0),
            (flight.length, 0.0, rise),
            (flight.length + MOUTH, 0.0, rise),
        ]
        connectors.append(Connector(flight.kind, foot.path(points), flight.width, (0, 0)))
        at += flight.width
        edge = at
    if guarded and width - edge > 0.5:
        add_railing(solids, stage.sub(0.0, depth - 0.05), (edge, width), rise, railing)
    above = Floor(spec.side)
    above.open(stage, (0.0, width), (0.0, depth - 0.9))
    furnish(solids, rng, above, stage, (width, depth), rise, CLUTTER, int(rng.poisson(width * depth / 10.0)))
    return connectors


def _screens(
    solids: SolidsBuilder, rng: np.random.Generator, floor: Floor, corner: Frame, inner: tuple[float, float]
) -> None:
    """Free-standing partitions of any direction."""
    for _ in range(int(rng.integers(0, 4))):
        length, height = float(rng.uniform(1.5, 4.0)), float(rng.uniform(1.2, 2.4))
        u, v, yaw = (float(x) for x in rng.uniform((0.0, 0.0, 0.0), (*inner, np.pi)))
        at = corner.sub(u, v, yaw)
        half = length / 2
        if floor.fits(at, (-half - 1.0, half + 1.0), (-1.0, 1.0)):
            block(solids, at, (-half, half), (-0.05, 0.05), (0.0, height))
            floor.reserve(at, (-half, half), (-0.05, 0.05), 1.0)
