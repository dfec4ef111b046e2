"""Multi-storey buildings: a corridor between two rows of rooms on every floor, joined by stairwells.

Stairwells are as in real ones: some rooms apart, most behind a doorway, and not all of them on the same storeys, so
that the way up may lead along the corridor to one staircase and back to the next.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from romnav.errors import RomnavError
from romnav.world.solids import Label, SolidsBuilder
from romnav.world.spec import WorldSpec
from romnav.world.tile import Connector, Tile, TileClass
from romnav.world.tiles.furniture import HALL, ROOM, furnish
from romnav.world.tiles.site import MAX_FITS, Floor, Frame, Span, block, cut, edges
from romnav.world.tiles.stairs import KERB, SLAB, Railing, Staircase, add_railing, draw_ramp, draw_stair

WALL = 0.15
APPROACH = 1.4
"""Free depth before the mouth of a staircase, m."""
NARROWEST = 2.6
"""A row is not cut into pieces shorter than this, m."""
WING, TOWER = ((33.0, 39.4), (15.0, 24.0)), ((9.5, 12.5), (10.5, 12.5))
"""Length and depth of a building, m: rooms of up to ten metres on either side of a corridor; a compact tower where one
staircase joins three storeys, so that goals two storeys up lie within the paper's cap."""
HIGH, RELAY, GOLDEN = 0.46, 0.06, (5**0.5 - 1) / 2
"""Shares of buildings with three storeys, and of those in which no staircase joins all three, spread evenly over the
tiles by multiples of the golden section."""
ATRIA, GALLERY = 0.5, (1.5, 2.4)
"""Share of long buildings with an atrium, and the width of the gallery around it, m."""
KINDS = (0.55, 0.25, 0.12, 0.08)
"""Shares of staircases: U-turns across and along the building, straight ones, ramps; the last two join two storeys."""


@dataclass(frozen=True)
class Hall:
    """A stretch of one row of rooms on the storeys from ``first`` to ``last``."""

    row: int
    u: Span
    """Extent along the corridor, m."""
    first: int
    last: int
    enclosed: bool
    """Whether a wall with a doorway parts the hall from the corridor."""

    def touches(self, storey: int) -> bool:
        """Whether the hall is on ``storey``."""
        return self.first <= storey <= self.last


@dataclass(frozen=True)
class Core(Hall):
    """A staircase in its hall, which joins the storeys."""

    stairs: Staircase
    frame: Frame


@dataclass(frozen=True)
class Atrium(Hall):
    """A hall two storeys high, which a gallery behind railings looks into from above."""

    hole: tuple[Span, Span]
    """Where the upper floor is open, in the plan's frame, m."""


@dataclass(frozen=True)
class Plan:
    """What all storeys of a building share; frame: origin at the building's corner, u along the corridor."""

    frame: Frame
    length: float
    depth: float
    corridor: Span
    cores: tuple[Core, ...]
    atria: tuple[Atrium, ...]
    storeys: int

    def halls(self, storey: int) -> list[Hall]:
        """Halls on ``storey``."""
        return [hall for hall in (*self.cores, *self.atria) if hall.touches(storey)]

    def row(self, row: int) -> Span:
        """Extent across the corridor of the row of rooms below (0) or above (1) it."""
        return (WALL, self.corridor[0]) if row == 0 else (self.corridor[1], self.depth - WALL)


def building(rng: np.random.Generator, spec: WorldSpec, index: int) -> Tile:
    """A building of two to ``spec.max_storeys`` storeys."""
    plan = _draw_plan(rng, spec, index)
    solids = SolidsBuilder()
    railing = Railing.draw(rng)
    connectors = []
    for storey in range(plan.storeys):
        connectors += _storey(solids, rng, spec, plan, storey, railing)
    half = spec.storey_height / 2
    return Tile(
        kind=TileClass.BUILDING,
        index=index,
        side=spec.side,
        solids=solids.build(),
        layers=tuple(half * k for k in range(2 * plan.storeys - 1)),
        storeys=tuple(range(0, 2 * plan.storeys - 1, 2)),
        connectors=tuple(connectors),
    )


def _draw_plan(rng: np.random.Generator, spec: WorldSpec, index: int) -> Plan:
    lot = index * GOLDEN % 1.0
    low = spec.max_storeys < 3 or lot > HIGH
    storeys = min(2, spec.max_storeys) if low else spec.max_storeys
    spans = _spans(rng, storeys, relay=lot < RELAY)
    lengths, depths = TOWER if (0, 2) in spans else WING
    room = spec.side - 0.6
    for _ in range(MAX_FITS):
        yaw = float(rng.uniform(-0.35, 0.35)) if rng.random() < 0.4 else 0.0
        length, depth = (min(float(rng.uniform(*x)), room) for x in (lengths, depths))
        c, s = np.cos(yaw), abs(np.sin(yaw))
        if max(length * c + depth * s, length * s + depth * c) <= room:
            break
    else:
        raise RomnavError(f"world.side: no building fits into {spec.side} m; widen it")
    quarter = float(rng.integers(4)) * np.pi / 2
    middle = Frame(spec.side / 2, spec.side / 2, yaw + quarter)
    frame = middle.sub(-length / 2, -depth / 2)
    width = float(rng.uniform(1.8, 2.6))
    start = (depth - width) * float(rng.uniform(0.38, 0.62))
    empty = Plan(frame, length, depth, (start, start + width), (), (), storeys)
    cores: list[Core] = []
    for first, last in spans:
        core = _draw_core(rng, spec, empty, cores, first, last)
        if core is not None:
            cores.append(core)
    long = storeys > 1 and lengths == WING[0]
    atrium = _draw_atrium(rng, empty, cores) if long and rng.random() < ATRIA else None
    return Plan(frame, length, depth, empty.corridor, tuple(cores), (atrium,) if atrium else (), storeys)


def _spans(rng: np.random.Generator, storeys: int, relay: bool) -> list[tuple[int, int]]:
    """Storeys that each staircase joins: one through all, or a relay of one per storey, and perhaps one more."""
    if storeys == 1:
        return []
    relay = storeys == 3 and relay
    spans = [(0, 1), (1, 2)] if relay else [(0, storeys - 1)]
    if (storeys == 2 or relay) and rng.random() < 0.25:
        first = int(rng.integers(storeys - 1))
        spans.append((first, int(rng.integers(first + 1, storeys))))
    return spans


def _draw_core(
    rng: np.random.Generator, spec: WorldSpec, plan: Plan, others: list[Core], first: int, last: int
) -> Core | None:
    """A staircase from storey ``first`` to ``last`` clear of the ``others``; None where there is no room for one."""
    length = plan.length - 2 * WALL
    kinds = np.array(KINDS) * ((1, 1, 1, 1) if last - first == 1 else (1, 1, 0, 0))
    for _ in range(40):
        row = int(rng.integers(2))
        v0, v1 = plan.row(row)
        depth = v1 - v0
        kind = int(rng.choice(4, p=kinds / kinds.sum()))
        width, half = float(rng.uniform(1.4, 1.8)), spec.storey_height / 2
        flight = draw_ramp(rng, half, width, (12.5, 15.0)) if kind == 3 else draw_stair(rng, spec, half, width, 1.1)
        stairs = Staircase(flight, float(rng.uniform(1.4, 1.8)), turn=kind != 2, walled=rng.random() < 0.35)
        wide, reach = 2 * stairs.half_width, stairs.length
        along = reach + APPROACH * (1 if stairs.turn else 2)
        if kind == 0:
            span = wide + float(rng.uniform(0.0, 3.0))
            fits = depth >= reach + APPROACH
        else:
            span = along + float(rng.uniform(0.0, 1.5))
            fits = depth >= wide
        if not fits or span > length:
            continue
        left = float(rng.choice([0.0, 1.0, rng.uniform()], p=(0.42, 0.42, 0.16))) * (length - span)
        left = 0.0 if left < NARROWEST else length - span if length - span - left < NARROWEST else left
        hall = (WALL + left, WALL + left + span)
        if not _clear(row, hall, others):
            continue
        enclosed = rng.random() < 0.8
        if kind == 0:
            at = hall[0] + float(rng.uniform(wide / 2, span - wide / 2))
            mouth, yaw = (v1 - reach, np.pi / 2) if row else (v0 + reach, -np.pi / 2)
            return Core(row, hall, first, last, enclosed, stairs, plan.frame.sub(at, mouth, yaw))
        side = v1 - wide / 2 if row else v0 + wide / 2
        if rng.random() < 0.5 and depth > wide + 1.0:
            side = float(rng.uniform(v0 + wide / 2, v1 - wide / 2))
        if rng.random() < 0.5:
            frame = plan.frame.sub(hall[0] + APPROACH, side)
        else:
            frame = plan.frame.sub(hall[1] - APPROACH, side, np.pi)
        return Core(row, hall, first, last, enclosed, stairs, frame)
    return None


def _draw_atrium(rng: np.random.Generator, plan: Plan, others: list[Core]) -> Atrium | None:
    """A hall under a gallery clear of the ``others``; None where there is no room for one."""
    for _ in range(20):
        row = int(rng.integers(2))
        v = plan.row(row)
        span = float(rng.uniform(8.0, 13.0))
        start = WALL + NARROWEST + float(rng.uniform()) * (plan.length - 2 * (WALL + NARROWEST) - span)
        u = (start, start + span)
        if v[1] - v[0] < 6.0 or not _clear(row, u, others):
            continue
        side, end = rng.uniform(*GALLERY, 2), rng.uniform(*GALLERY, 2)
        hole = (u[0] + float(end[0]), u[1] - float(end[1])), (v[0] + float(side[0]), v[1] - float(side[1]))
        first = int(rng.integers(plan.storeys - 1))
        return Atrium(row, u, first, first + 1, bool(rng.random() < 0.3), hole)
    return None


def _clear(row: int, u: Span, others: list[Core]) -> bool:
    """Whether a hall at ``u`` of a row is clear of the ``others`` by a room."""
    return not any(o.row == row and u[0] < o.u[1] + NARROWEST and o.u[0] < u[1] + NARROWEST for o in others)


def _storey(
    solids: SolidsBuilder,
    rng: np.random.Generator,
    spec: WorldSpec,
    plan: Plan,
    storey: int,
    railing: Railing,
) -> list[Connector]:
    z, frame, layer = storey * spec.storey_height, plan.frame, 2 * storey
    top = z + spec.storey_height
    ceiling = top - SLAB
    holes = [_shaft(plan, core) for core in plan.cores if core.first < storey <= core.last]
    voids = [atrium.hole for atrium in plan.atria if storey == atrium.last]
    for u, v in cut(((0.0, plan.length), (0.0, plan.depth)), holes + voids):
        block(solids, frame, u, v, (z - SLAB, z), label=Label.GROUND, layers=(layer, layer))
    _outer_walls(solids, rng, plan, z, top)

    floor = Floor(spec.side)
    floor.open(frame, (WALL, plan.length - WALL), (WALL, plan.depth - WALL))
    connectors = []
    for core in plan.cores:
        if not core.touches(storey):
            continue
        shaft = core.stairs.shaft
        floor.reserve(core.frame, shaft[0], shaft[1], 0.1)
        mouth = (-APPROACH, 0.0)
        floor.reserve(core.frame, mouth, shaft[1])
        if not core.stairs.turn:
            floor.reserve(core.frame, (shaft[0][1], shaft[0][1] + APPROACH), shaft[1])
        if storey > core.first:
            core.stairs.guard(solids, core.frame, z, railing, departs=storey < core.last)
        if storey < core.last:
            connectors.append(core.stairs.build(solids, core.frame, z, layer, railing))
    for u, v in voids:
        corner, size = frame.sub(u[0], v[0]), (u[1] - u[0], v[1] - v[0])
        floor.reserve(corner, (0.0, size[0]), (0.0, size[1]), 0.2)
        for side, length in edges(corner, size):
            add_railing(solids, side.sub(0.0, KERB / 2), (0.0, length), z, railing)
    rooms: list[tuple[Span, Span]] = []
    for row in (0, 1):
        rooms += _rooms(solids, rng, plan, floor, row, storey, (z, ceiling))
    for u, v in rooms:
        area = (u[1] - u[0]) * (v[1] - v[0])
        at = frame.sub(u[0], v[0])
        furnish(solids, rng, floor, at, (u[1] - u[0], v[1] - v[0]), z, ROOM, int(rng.poisson(area / 9.0)))
    for hall in plan.halls(storey):
        v = plan.row(hall.row)
        size = (hall.u[1] - hall.u[0], v[1] - v[0])
        furnish(
            solids, rng, floor, frame.sub(hall.u[0], v[0]), size, z, HALL, int(rng.poisson(size[0] * size[1] / 16.0))
        )
    size = (plan.length - 2 * WALL, plan.corridor[1] - plan.corridor[0])
    furnish(solids, rng, floor, frame.sub(WALL, plan.corridor[0]), size, z, HALL, int(rng.poisson(2.0)))
    return connectors


def _shaft(plan: Plan, core: Core) -> tuple[Span, Span]:
    """The shaft of ``core`` as a rectangle of the plan (its frame is turned by quarters only)."""
    (u0, u1), (v0, v1) = core.stairs.shaft
    (a0, b0), (a1, b1) = (plan.frame.local(*core.frame.at(u, v)) for u, v in ((u0, v0), (u1, v1)))
    return (min(a0, a1), max(a0, a1)), (min(b0, b1), max(b0, b1))


def _outer_walls(solids: SolidsBuilder, rng: np.random.Generator, plan: Plan, z: float, top: float) -> None:
    """Four walls with a band of windows between sill and lintel."""
    sill, head = z + 0.9, z + float(rng.uniform(2.1, 2.6))
    sides = (
        (plan.frame, plan.length),
        (plan.frame.sub(plan.length, 0.0, np.pi / 2), plan.depth),
        (plan.frame.sub(plan.length, plan.depth, np.pi), plan.length),
        (plan.frame.sub(0.0, plan.depth, -np.pi / 2), plan.depth),
    )
    for side, length in sides:
        run = (0.0, length - WALL)
        block(solids, side, run, (0.0, WALL), (z - SLAB, sill))
        block(solids, side, run, (0.0, WALL), (head, top - SLAB))
        count = max(1, int(length / rng.uniform(3.0, 4.5)))
        pitch = length / count
        window = float(rng.uniform(1.0, 0.6 * pitch))
        ends = [
            0.0,
            *(pitch * k + s * window / 2 for k in np.arange(count) + 0.5 for s in (-1, 1)),
            length - WALL,
        ]
        for a, b in zip(ends[::2], ends[1::2], strict=True):
            block(solids, side, (float(a), float(b)), (0.0, WALL), (sill, head))


def _rooms(
    solids: SolidsBuilder,
    rng: np.random.Generator,
    plan: Plan,
    floor: Floor,
    row: int,
    storey: int,
    z: Span,
) -> list[tuple[Span, Span]]:
    """Divide a row into rooms around its halls, with walls and doors; their clear rectangles."""
    v = plan.row(row)
    halls = [hall for hall in plan.halls(storey) if hall.row == row]
    rooms: list[tuple[Span, Span]] = []
    start = WALL
    for low, high in [*sorted(hall.u for hall in halls), (plan.length - WALL, plan.length)]:
        stretch = low - start
        if stretch > 2.0:
            count = max(1, round(stretch / float(rng.uniform(3.4, 6.5))))
            cuts = start + stretch * (np.arange(1, count) + rng.uniform(-0.15, 0.15, count - 1)) / count
            bounds = [start, *(float(c) for c in cuts), low]
            for a, b in itertools.pairwise(bounds):
                rooms.append(((a, b), v))
            parted = bounds[1:-1] + [e for e in (start, low) if WALL < e < plan.length - WALL - 1e-9]
            for u in parted:
                side = plan.frame.sub(u, v[0], np.pi / 2)
                _wall(solids, rng, floor, side, v[1] - v[0], z, rng.random() < 0.35)
        start = high
    edge = plan.frame.sub(0.0, plan.corridor[0] if row == 0 else plan.corridor[1])
    for (a, b), _ in rooms:
        if rng.random() < 0.88:
            _wall(solids, rng, floor, edge.sub(a, 0.0), b - a, z, True)
    for hall in halls:
        if hall.enclosed:
            _wall(solids, rng, floor, edge.sub(hall.u[0], 0.0), hall.u[1] - hall.u[0], z, True)
    return rooms


def _wall(
    solids: SolidsBuilder,
    rng: np.random.Generator,
    floor: Floor,
    frame: Frame,
    length: float,
    z: Span,
    door: bool,
) -> None:
    """An interior wall along u, with a doorway if ``door``."""
    half = WALL / 2
    floor.reserve(frame, (0.0, length), (-half, half))
    if not door:
        block(solids, frame, (0.0, length), (-half, half), z)
        return
    width = min(float(rng.uniform(1.2, 1.7)), length - 0.6)
    left = float(rng.uniform(0.3, length - width - 0.3))
    head = z[0] + float(rng.uniform(2.05, 2.4))
    block(solids, frame, (0.0, left), (-half, half), z)
    block(solids, frame, (left + width, length), (-half, half), z)
    block(solids, frame, (left, left + width), (-half, half), (head, z[1]))
    floor.reserve(frame, (left - 0.1, left + width + 0.1), (-1.1, 1.1))
