"""Outdoor terrain: terraces at several heights joined by steps and ramps, and street furniture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from romnav.world.solids import Label, SolidsBuilder
from romnav.world.spec import WorldSpec
from romnav.world.tile import Connector, Tile, TileClass
from romnav.world.tiles.furniture import STREET, furnish
from romnav.world.tiles.site import Floor, Frame, Span, block
from romnav.world.tiles.stairs import MOUTH, Flight, Railing, add_flight, add_railing, draw_ramp, draw_stair

EDGE = 0.3
"""Width of the boundary wall or hedge, m."""
CURB = (0.08, 0.15)


@dataclass
class Plot:
    """A level rectangle of terrain."""

    u: Span
    v: Span
    z: float


def outdoor(rng: np.random.Generator, spec: WorldSpec, seed: int) -> Tile:
    """Terraces: the tile is divided into plots of different heights; a spanning tree of connectors joins them."""
    solids = SolidsBuilder()
    frame = Frame(0.0, 0.0)
    plots = _divide(rng, (0.0, spec.side), (0.0, spec.side))
    order = [int(k) for k in rng.permutation(len(plots))]
    for k in order:
        plots[k].z = float(rng.choice([0.0, 0.0, rng.uniform(0.3, 0.8), rng.uniform(0.8, 2.5)]))
    floor = Floor(spec.side)
    inner = (EDGE, spec.side - EDGE)
    floor.open(frame, inner, inner)
    connectors = _join(solids, rng, spec, plots, floor, Railing.draw(rng))
    for plot in plots:
        block(solids, frame, plot.u, plot.v, (-0.2, plot.z), label=Label.GROUND, layers=(0, 0))
        size = (plot.u[1] - plot.u[0], plot.v[1] - plot.v[0])
        count = int(rng.poisson(size[0] * size[1] / 14.0))
        furnish(
            solids,
            rng,
            floor,
            frame.sub(plot.u[0], plot.v[0]),
            size,
            plot.z,
            STREET,
            count,
            gap=0.9,
            turn=0.8,
        )
    high = max(plot.z for plot in plots)
    _boundary(solids, rng, spec.side, high)
    return Tile(
        kind=TileClass.OUTDOOR,
        seed=seed,
        side=spec.side,
        solids=solids.build(),
        layers=(0.0,),
        storeys=(0,),
        connectors=tuple(connectors),
    )


def _divide(rng: np.random.Generator, u: Span, v: Span) -> list[Plot]:
    """Recursive bisection into plots of at least 5 m."""
    du, dv = u[1] - u[0], v[1] - v[0]
    if max(du, dv) < 10.5 or (max(du, dv) < 14.0 and rng.random() < 0.3):
        return [Plot(u, v, 0.0)]
    at = float(rng.uniform(0.35, 0.65))
    if du >= dv:
        middle = u[0] + at * du
        return _divide(rng, (u[0], middle), v) + _divide(rng, (middle, u[1]), v)
    middle = v[0] + at * dv
    return _divide(rng, u, (v[0], middle)) + _divide(rng, u, (middle, v[1]))


def _shared(a: Plot, b: Plot) -> tuple[Frame, float] | None:
    """Shared edge of two plots: frame at its start with u along it and v towards ``b``, and its length."""
    for edge, other, side in ((a.u, b.u, 0), (a.v, b.v, 1)):
        cross_a, cross_b = (a.v, b.v) if side == 0 else (a.u, b.u)
        low, high = max(cross_a[0], cross_b[0]), min(cross_a[1], cross_b[1])
        if high - low < 2.5:
            continue
        if abs(edge[1] - other[0]) < 1e-9:
            return (Frame(edge[1], high, -np.pi / 2) if side == 0 else Frame(low, edge[1])), high - low
        if abs(edge[0] - other[1]) < 1e-9:
            return (Frame(edge[0], low, np.pi / 2) if side == 0 else Frame(high, edge[0], np.pi)), high - low
    return None


def _join(
    solids: SolidsBuilder,
    rng: np.random.Generator,
    spec: WorldSpec,
    plots: list[Plot],
    floor: Floor,
    railing: Railing,
) -> list[Connector]:
    connectors = []
    joined = list(range(len(plots)))
    pairs = [(a, b) for a in range(len(plots)) for b in range(a) if _shared(plots[a], plots[b])]
    for k in rng.permutation(len(pairs)):
        a, b = pairs[int(k)]
        low, high = (a, b) if plots[a].z <= plots[b].z else (b, a)
        rise = plots[high].z - plots[low].z
        shared = _shared(plots[high], plots[low])
        if shared is None or rise < 0.25:
            joined = [joined[low] if j == joined[high] else j for j in joined]
            continue
        frame, length = shared
        built: list[Span] = []
        if joined[a] != joined[b] or rng.random() < 0.6:
            connector = _connect(solids, rng, spec, floor, frame, length, plots[low].z, rise, railing, built)
            if connector is not None:
                connectors.append(connector)
                joined = [joined[low] if j == joined[high] else j for j in joined]
        if rng.random() < 0.6:
            edge = 0.0
            for start, end in [*sorted(built), (length, length)]:
                if start - edge > 0.6:
                    add_railing(solids, frame.sub(0.0, -0.05), (edge, start), plots[high].z, railing)
                edge = end
        floor.reserve(frame, (0.0, length), (-0.7, 0.1))
    return connectors


def _connect(
    solids: SolidsBuilder,
    rng: np.random.Generator,
    spec: WorldSpec,
    floor: Floor,
    frame: Frame,
    length: float,
    z: float,
    rise: float,
    railing: Railing,
    built: list[Span],
) -> Connector | None:
    """A flight inside the lower plot, up to the shared edge (u axis of ``frame``, lower plot at v > 0)."""
    for _ in range(12):
        width = min(float(rng.choice([rng.uniform(1.4, 2.0), rng.uniform(2.0, 4.0)])), length - 0.9)
        flight: Flight = (
            draw_ramp(rng, rise, width, (8.0, 15.0))
            if rng.random() < 0.45
            else draw_stair(rng, spec, rise, width)
        )
        at = float(rng.uniform(0.4, length - width - 0.4)) + width / 2
        foot = frame.sub(at, flight.length, -np.pi / 2)
        v = (-width / 2 - 0.1, width / 2 + 0.1)
        if not floor.fits(foot, (-1.2, flight.length + 0.9), v):
            continue
        add_flight(solids, foot, z, flight, (0, 0), base=z - 0.1)
        floor.reserve(foot, (-1.4, flight.length + 1.2), v, 0.3)
        if rng.random() < 0.6 and rise > 0.5:
            for side in (-1, 1):
                add_railing(
                    solids,
                    foot.sub(0.0, side * (width / 2 - 0.04)),
                    (0.0, flight.length),
                    z,
                    railing,
                    rise=rise,
                )
        built.append((at - width / 2, at + width / 2))
        top = z + rise
        points = [
            (-MOUTH, 0.0, z),
            (0.0, 0.0, z),
            (flight.length, 0.0, top),
            (flight.length + MOUTH, 0.0, top),
        ]
        return Connector("stair" if flight.steps else "ramp", foot.path(points), width, (0, 0))
    return None


def _boundary(solids: SolidsBuilder, rng: np.random.Generator, side: float, high: float) -> None:
    top = high + float(rng.uniform(1.2, 2.2))
    for u, v in (
        ((0.0, side), (0.0, EDGE)),
        ((0.0, side), (side - EDGE, side)),
        ((0.0, EDGE), (EDGE, side - EDGE)),
        ((side - EDGE, side), (EDGE, side - EDGE)),
    ):
        block(solids, Frame(0.0, 0.0), u, v, (-0.2, top))
