"""The paper's four long deployments rebuilt (Sec. IV-D and Fig. 6), with its lengths of route and climbs.

The paper's figure and its caption tell of a cluttered laboratory, 38 m; two storeys up a stairwell with wire railings,
7 m up over 51 m; from outside into a building, 10 m up over 51 m; 100 m outdoors past tables, cliff edges and railings,
1 m down. The rest is assumed. Lengths are those of the shortest path, seen from above.
"""

from __future__ import annotations

import numpy as np

from romnav.world.scenes.scene import Area, Scene
from romnav.world.solids import Label, SolidsBuilder
from romnav.world.tile import Connector, Tile, TileClass
from romnav.world.tiles.furniture import CLUTTER, HALL, ROOM, STREET, Item, furnish
from romnav.world.tiles.site import Floor, Frame, Span, block, cut, edges
from romnav.world.tiles.stairs import MOUTH, Flight, Railing, Staircase, add_flight, add_railing

SIDE = 64.0
"""Side of all four tiles, m: the outdoor route needs it, and tiles of one world are alike."""
WALL = 0.2
DOOR = 1.4
WIRES = Railing(spacing=1.2, wires=3)
GAP = 0.65
"""Kept free around each piece of furniture, m: between two of them the planning grid needs 1.02."""


def deployment_scenes() -> tuple[Scene, ...]:
    """Lab, stairwell, entrance and outdoors."""
    return _lab(), _stairwell(), _entrance(), _outdoors()


def _random(scene: int) -> np.random.Generator:
    """Where furniture stands and what it is: part of the scene, not of a run."""
    return np.random.Generator(np.random.Philox(np.random.SeedSequence([0xDE, scene])))


def _lab() -> Scene:
    """Two partitions make an S of a laboratory of 25 x 20 m, full of desks, shelves, poles and hanging things."""
    rng, solids, floor = _random(0), SolidsBuilder(), Floor(SIDE)
    corner, size = Frame(20.0, 20.0), (25.0, 20.0)
    block(solids, corner, (-WALL, size[0] + WALL), (-WALL, size[1] + WALL), (-0.2, 0.0),
          label=Label.GROUND, layers=(0, 0))  # fmt: skip
    for side, run in edges(corner, size):
        block(solids, side, (-WALL, run), (0.0, WALL), (-0.2, 3.2))
    floor.open(corner, (0.0, size[0]), (0.0, size[1]))
    for u, v in ((8.4, (0.0, 13.6)), (16.6, (5.4, size[1]))):
        block(solids, corner, (u - WALL / 2, u + WALL / 2), v, (0.0, 2.6))
        floor.reserve(corner, (u - 0.1, u + 0.1), (v[0] - 1.0, v[1] + 1.0), 0.1)
    start, goal = Area(corner.sub(4.2, 2.7), (3.0, 1.6)), Area(corner.sub(21.3, 16.7), (0.2, 0.2))
    floor.reserve(corner, (2.4, 6.2), (0.6, 4.6))
    floor.reserve(corner, (20.0, 22.6), (14.0, 19.0))
    furnish(solids, rng, floor, corner, size, 0.0, CLUTTER, 160, gap=GAP)
    return Scene("lab", "Cluttered lab", _tile(TileClass.ROOM, 0, solids, (0.0,), (0,), ()), start, goal)


def _stairwell() -> Scene:
    """Three floors 3.5 m apart; an open U-shaped staircase with wire railings, corridors before and after it."""
    rng, solids = _random(1), SolidsBuilder()
    corner, size, storey = Frame(18.0, 22.0), (26.0, 11.0), 3.5
    stairs = Staircase(Flight(storey / 2, 10 * 0.29, 1.5, 11), landing=1.6, turn=True, walled=False)
    foot = corner.sub(17.0, 4.2)
    (u0, u1), (v0, v1) = stairs.shaft
    shaft = (17.0 + u0, 17.0 + u1), (4.2 + v0, 4.2 + v1)
    connectors = []
    for level in range(3):
        z, layer = level * storey, 2 * level
        for u, v in cut(((-WALL, size[0] + WALL), (-WALL, size[1] + WALL)), [shaft] if level else []):
            block(solids, corner, u, v, (z - WALL, z), label=Label.GROUND, layers=(layer, layer))
        for side, run in edges(corner, size):
            block(solids, side, (-WALL, run), (0.0, WALL), (z - WALL, z + storey - WALL))
        if level:
            stairs.guard(solids, foot, z, WIRES, departs=level < 2)
        if level < 2:
            connectors.append(stairs.build(solids, foot, z, layer, WIRES))
        floor = Floor(SIDE)
        floor.open(corner, (0.0, size[0]), (0.0, size[1]))
        floor.reserve(foot, (u0 - 2.4, u1), (v0, v1), 0.3)
        if level != 1:  # a corridor off the hall, with a door
            wall = corner.sub(10.0, 0.0, np.pi / 2)
            _wall(solids, wall, size[1], (z, z + storey - WALL), door=7.4)
            floor.reserve(wall, (0.0, size[1]), (-0.1, 0.1))
            floor.reserve(wall, (7.2, 9.0), (-1.5, 1.5))
        floor.reserve(corner, (0.6, 4.6), (0.8, 4.4))
        furnish(solids, rng, floor, corner, size, z, HALL, 12, gap=GAP)
    tile = _tile(TileClass.BUILDING, 1, solids, tuple(storey / 2 * k for k in range(5)), (0, 2, 4), tuple(connectors))
    start = Area(corner.sub(2.6, 2.6), (2.0, 2.0), 0.0)
    goal = Area(corner.sub(2.5, 2.5), (0.2, 0.2), 2 * storey)
    return Scene("stairwell", "Stairwell", tile, start, goal)


def _entrance() -> Scene:
    """A square, two long flights with a landing between them, a terrace, and through a door into a lobby."""
    rng, solids, floor = _random(2), SolidsBuilder(), Floor(SIDE)
    origin, half = Frame(4.0, 24.0), 9.0
    flight = Flight(5.0, 29 * 0.31, 3.2, 30)
    foot = 15.4
    middle = foot + flight.length
    second = middle + 2.4
    top = second + flight.length
    whole, stair = (0.0, 2 * half), (half - flight.width / 2, half + flight.width / 2)
    levels: tuple[tuple[Span, Span, float], ...] = (
        ((0.0, foot), whole, 0.0),
        ((middle, second), stair, 5.0),
        ((top, top + 20.0), whole, 10.0),
    )
    for along, across, z in levels:
        block(solids, origin, along, across, (-0.2, z), label=Label.GROUND, layers=(0, 0))
    connectors = []
    for start_u, z in ((foot, 0.0), (second, 5.0)):
        end_u = start_u + flight.length
        add_flight(solids, origin.sub(start_u, half), z, flight, (0, 0), base=-0.2)
        points = [
            (start_u - MOUTH, half, z),
            (start_u, half, z),
            (end_u, half, z + 5.0),
            (end_u + MOUTH, half, z + 5.0),
        ]
        connectors.append(Connector("stair", origin.path(points), flight.width, (0, 0)))
        for v in (stair[0] + 0.04, stair[1] - 0.04):
            add_railing(solids, origin.sub(0.0, v), (start_u, end_u), z, WIRES, rise=5.0)
    for v in (stair[0] + 0.04, stair[1] - 0.04):
        add_railing(solids, origin.sub(0.0, v), (middle, second), 5.0, WIRES)
    for low, high in ((0.0, stair[0]), (stair[1], 2 * half)):
        add_railing(solids, origin.sub(top + 0.05, low, np.pi / 2), (0.0, high - low), 10.0, WIRES)
        block(solids, origin, (foot, foot + 0.4), (low, high), (0.0, 5.0))  # retaining walls beside the stairs
    for along, z in (((0.0, foot), 0.0), ((top, top + 5.0), 10.0)):  # fences, on the square and on the terrace
        for v in (0.05, 2 * half - 0.05):
            add_railing(solids, origin.sub(0.0, v), along, z, WIRES)
    block(solids, origin, (0.0, 0.3), whole, (0.0, 1.4))
    lobby, size = origin.sub(top + 5.0, 0.0), (14.8, 2 * half)
    for side, run in edges(lobby, size)[:3]:
        block(solids, side, (-WALL, run), (-WALL, 0.0), (10.0, 13.4))
    _wall(solids, lobby.sub(0.0, 0.0, np.pi / 2), size[1], (10.0, 13.4), door=11.0, width=1.8)
    block(solids, lobby, (0.0, size[0]), (0.0, size[1]), (13.4, 13.6))
    floor.open(lobby, (WALL, size[0] - WALL), (WALL, size[1] - WALL))
    start, goal = Area(origin.sub(3.0, 5.0), (2.4, 2.4)), Area(lobby.sub(11.3, 6.3), (0.2, 0.2), 10.0)
    floor.reserve(lobby, (0.0, 2.2), (10.0, 14.0))
    floor.reserve(goal.frame, (-1.2, 1.2), (-1.2, 1.2))
    furnish(solids, rng, floor, lobby, size, 10.0, HALL + ROOM, 50, gap=GAP)
    square = Floor(SIDE)
    square.open(origin, (0.3, foot - 2.0), (0.2, 2 * half - 0.2))
    square.reserve(start.frame, (-2.0, 2.0), (-2.0, 2.0))
    furnish(solids, rng, square, origin, (foot, 2 * half), 0.0, STREET, 30, gap=GAP)
    tile = _tile(TileClass.OUTDOOR, 2, solids, (0.0,), (0,), tuple(connectors))
    return Scene("entrance", "Into a building", tile, start, goal)


def _outdoors() -> Scene:
    """A promenade above a pit, steps down, tables on a square, and a path back along the other edge of the pit."""
    rng, solids, floor = _random(3), SolidsBuilder(), Floor(SIDE)
    origin = Frame(6.0, 10.0)
    upper, depth = 33.0, 8.0
    steps = Flight(1.0, 6 * 0.32, 4.0, 7)
    for u, v, z in (
        ((0.0, upper), (0.0, depth), 1.0),  # promenade
        ((upper, 52.0), (0.0, depth), 0.0),  # square
        ((42.0, 52.0), (depth, 35.0), 0.0),  # tables
        ((6.0, 52.0), (35.0, 42.0), 0.0),  # path back
    ):
        block(solids, origin, u, v, (-3.2, z), label=Label.GROUND, layers=(0, 0))
    for u, v in (((0.0, 42.0), (depth, 35.0)), ((0.0, 6.0), (35.0, 42.0))):  # the pit, where no way leads
        block(solids, origin, u, v, (-3.4, -3.0), label=Label.GROUND)
    # the steps are set into the promenade's end, wide as its middle
    flight = origin.sub(upper + steps.length, 4.0, np.pi)
    add_flight(solids, flight, 0.0, steps, (0, 0), base=-0.2)
    points = [(-MOUTH, 0.0, 0.0), (0.0, 0.0, 0.0), (steps.length, 0.0, 1.0), (steps.length + MOUTH, 0.0, 1.0)]
    connectors = (Connector("stair", flight.path(points), steps.width, (0, 0)),)
    for v in ((0.0, 1.9), (6.1, depth)):
        add_railing(solids, origin.sub(upper - 0.05, v[0], np.pi / 2), (0.0, v[1] - v[0]), 1.0, WIRES)
    # railings along parts of the cliff; the rest is a bare edge
    for u in ((0.0, 11.0), (20.0, 27.0)):
        add_railing(solids, origin.sub(0.0, depth - 0.05), u, 1.0, WIRES)
    add_railing(solids, origin.sub(0.0, depth - 0.05), (upper + 3.0, 42.0), 0.0, WIRES)
    add_railing(solids, origin.sub(0.0, 35.05), (14.0, 30.0), 0.0, WIRES)
    add_railing(solids, origin.sub(42.05, 0.0, np.pi / 2), (14.0, 26.0), 0.0, WIRES)
    # hedges and walls close the outside
    for at, u, z in (
        (origin, (0.0, upper), 1.0), (origin, (upper, 52.0), 0.0),
        (origin.sub(0.0, 41.7), (6.0, 52.0), 0.0),
        (origin.sub(0.3, 0.0, np.pi / 2), (0.0, depth), 1.0),
        (origin.sub(52.0, 0.0, np.pi / 2), (0.0, 42.0), 0.0),
        (origin.sub(6.3, 35.0, np.pi / 2), (0.0, 7.0), 0.0),
    ):  # fmt: skip
        block(solids, at, u, (0.0, 0.3), (z - 0.1, z + 1.3))
    start, goal = Area(origin.sub(4.0, 4.0), (2.4, 2.4), 1.0), Area(origin.sub(9.1, 38.7), (0.2, 0.2), 0.0)
    _street(solids, rng, floor, origin, ((7.0, upper - 3.0), (0.4, depth - 1.4)), 1.0, STREET, 40)
    _street(solids, rng, floor, origin, ((upper + 4.0, 51.4), (0.4, depth - 1.4)), 0.0, STREET, 30)
    _street(solids, rng, floor, origin, ((43.4, 51.4), (depth, 34.0)), 0.0, TABLES, 80)
    _street(solids, rng, floor, origin, ((13.0, 50.0), (36.4, 41.2)), 0.0, STREET, 50)
    return Scene("outdoors", "Outdoors", _tile(TileClass.OUTDOOR, 3, solids, (0.0,), (0,), connectors), start, goal)


TABLES: tuple[Item, ...] = (ROOM[1], ROOM[1], STREET[0], STREET[1])
"""Tables with their chairs, benches and planters."""


def _tile(
    kind: TileClass,
    index: int,
    solids: SolidsBuilder,
    layers: tuple[float, ...],
    storeys: tuple[int, ...],
    connectors: tuple[Connector, ...],
) -> Tile:
    return Tile(kind, index, SIDE, solids.build(), layers, storeys, connectors)


def _wall(solids: SolidsBuilder, frame: Frame, length: float, z: Span, door: float, width: float = DOOR) -> None:
    """A wall along u with a doorway from ``door`` on."""
    half = WALL / 2
    block(solids, frame, (0.0, door), (-half, half), z)
    block(solids, frame, (door + width, length), (-half, half), z)
    block(solids, frame, (door, door + width), (-half, half), (z[0] + 2.1, z[1]))


def _street(
    solids: SolidsBuilder,
    rng: np.random.Generator,
    floor: Floor,
    origin: Frame,
    rectangle: tuple[Span, Span],
    z: float,
    items: tuple[Item, ...],
    count: int,
) -> None:
    """Furnish a local rectangle."""
    (u0, u1), (v0, v1) = rectangle
    corner = origin.sub(u0, v0)
    floor.open(corner, (0.0, u1 - u0), (0.0, v1 - v0))
    furnish(solids, rng, floor, corner, (u1 - u0, v1 - v0), z, items, count, gap=GAP)
