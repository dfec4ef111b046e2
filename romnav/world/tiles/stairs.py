"""Flights, landings, railings, and the staircases and ramps made of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from romnav.world.solids import Label, SolidsBuilder
from romnav.world.spec import WorldSpec
from romnav.world.tile import Connector
from romnav.world.tiles.site import Frame, Span, block

SLAB = 0.2
KERB = 0.08
KERB_HEIGHT = 0.12
MOUTH = 0.6


@dataclass(frozen=True)
class Flight:
    """A straight climb of ``rise`` over ``length`` metres; ``steps`` risers, or 0 for a ramp."""

    rise: float
    length: float
    width: float
    steps: int

    @property
    def label(self) -> Label:
        """Semantic class of its surface."""
        return Label.STAIR if self.steps else Label.RAMP

    @property
    def kind(self) -> str:
        """Kind of a connector of this flight alone."""
        return "stair" if self.steps else "ramp"


@dataclass(frozen=True)
class Railing:
    """How railings look in one tile: post distance (m), wires between floor and handrail, height (m)."""

    spacing: float
    wires: int
    height: float = 1.0

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Railing:
        """A random style."""
        return cls(spacing=float(rng.uniform(1.0, 1.8)), wires=int(rng.integers(0, 3)))


def draw_stair(rng: np.random.Generator, spec: WorldSpec, rise: float, width: float, gentle: float = 1.35) -> Flight:
    """A random staircase of exactly ``rise``; the last riser meets the floor.

    It has up to ``gentle`` times as many risers as it needs, and at least two: one that is too high for a curb is
    split, below the range of risers if need be.
    """
    least = max(2, int(np.ceil(rise / spec.riser[1] - 1e-9)))
    most = int(np.floor(rise / spec.riser[0] + 1e-9))
    steps = int(rng.integers(least, max(least, min(most, round(gentle * least))) + 1))
    return Flight(rise, (steps - 1) * float(rng.uniform(*spec.tread)), width, steps)


def draw_ramp(rng: np.random.Generator, rise: float, width: float, degrees: Span = (10.0, 15.0)) -> Flight:
    """A random ramp of ``rise`` with an inclination within ``degrees``."""
    return Flight(rise, rise / float(np.tan(np.radians(rng.uniform(*degrees)))), width, 0)


def add_flight(
    solids: SolidsBuilder,
    frame: Frame,
    z: float,
    flight: Flight,
    layers: tuple[int, int],
    base: float | None = None,
) -> None:
    """Build ``flight`` from the frame's origin along u; solid down to ``base``, or hung with a soffit."""
    v = (-flight.width / 2, flight.width / 2)
    if flight.steps == 0:
        slope = flight.rise / flight.length
        top = z + flight.rise / 2
        bottom, slope_bottom = (top - SLAB, slope) if base is None else (base, 0.0)
        block(
            solids, frame, (0.0, flight.length), v, (bottom, top),
            slope=slope, slope_bottom=slope_bottom, label=Label.RAMP, layers=layers,
        )  # fmt: skip
        return
    riser, tread = flight.rise / flight.steps, flight.length / (flight.steps - 1)
    for i in range(flight.steps - 1):
        bottom, slope_bottom = (z + (i + 0.5) * riser - SLAB, riser / tread) if base is None else (base, 0.0)
        block(
            solids, frame, (i * tread, (i + 1) * tread), v, (bottom, z + (i + 1) * riser),
            slope_bottom=slope_bottom, label=Label.STAIR, layers=layers,
        )  # fmt: skip


def add_railing(
    solids: SolidsBuilder,
    frame: Frame,
    u: Span,
    z: float,
    railing: Railing,
    *,
    rise: float = 0.0,
    kerb: bool = False,
) -> None:
    """Posts, wires and handrail along u from ``u[0]`` (floor at ``z``) to ``u[1]`` (``z + rise``)."""
    length = u[1] - u[0]
    slope = rise / length
    middle = z + rise / 2

    def bar(low: float, high: float, width: float) -> None:
        block(
            solids,
            frame,
            u,
            (-width / 2, width / 2),
            (middle + low, middle + high),
            slope=slope,
            slope_bottom=slope,
        )

    if kerb:
        bar(-SLAB, KERB_HEIGHT, KERB)
    bar(railing.height - 0.05, railing.height, 0.06)
    for k in range(railing.wires):
        height = railing.height * (k + 1) / (railing.wires + 1)
        bar(height - 0.01, height + 0.01, 0.02)
    count = max(1, round((length - 0.1) / railing.spacing))
    for k in range(count + 1):
        at = u[0] + 0.05 + (length - 0.1) * k / count
        foot = z + slope * (at - u[0])
        solids.cylinder(frame.at(at, 0.0), 0.02, (foot, foot + railing.height - 0.03))


@dataclass(frozen=True)
class Staircase:
    """Two flights and a landing half way, stackable storey upon storey.

    Local frame: u points up the first flight, whose foot is at u = 0. A U-turn brings the second flight
    back to u = 0, beside the first; a straight staircase goes on to ``length``. The half landing is a layer
    of its own, so that staircases may be stacked and the space under them stays walkable.
    """

    flight: Flight
    landing: float
    turn: bool
    walled: bool
    """Whether its sides are closed by walls, else by kerbs and railings."""

    @property
    def kind(self) -> str:
        """Kind of its connector."""
        return "u-stair" if self.turn and self.flight.steps else self.flight.kind

    @property
    def length(self) -> float:
        """Extent of the shaft along u, m."""
        return (1 if self.turn else 2) * self.flight.length + self.landing + (KERB if self.turn else 0.0)

    @property
    def half_width(self) -> float:
        """Half of the shaft's extent along v, m."""
        return (self.flight.width + 1.5 * KERB) if self.turn else (self.flight.width / 2 + KERB)

    @property
    def shaft(self) -> tuple[Span, Span]:
        """Local rectangle that it takes of every floor above its first."""
        return (0.0, self.length), (-self.half_width, self.half_width)

    def build(self, solids: SolidsBuilder, frame: Frame, z: float, layer: int, railing: Railing) -> Connector:
        """Build from floor ``layer`` at ``z`` by the landing ``layer + 1`` to floor ``layer + 2``."""
        f, half = self.flight, self.flight.rise
        up, down = (layer, layer + 1), (layer + 1, layer + 2)
        end, mid, top = f.length + self.landing, z + half, z + 2 * half
        c = (f.width + KERB) / 2 if self.turn else 0.0
        second = frame.sub(f.length, c, np.pi) if self.turn else frame.sub(end, 0.0)
        add_flight(solids, frame.sub(0.0, -c), z, f, up)
        add_flight(solids, second, mid, f, down)
        wide = self.half_width - KERB
        block(
            solids, frame, (f.length, end), (-wide, wide), (mid - SLAB, mid),
            label=Label.GROUND, layers=(layer + 1, layer + 1),
        )  # fmt: skip
        out = wide + KERB / 2
        lower = [0.0] if self.turn else []
        if self.walled:
            walls = [((0.0, self.length), (v - KERB / 2, v + KERB / 2)) for v in (-out, out)]
            walls += [((end, end + KERB), (-wide, wide))] if self.turn else []
            for along, across in walls:
                block(solids, frame, along, across, (z, top))
        else:
            lower += [-out] if self.turn else [-out, out]
            for v in (-out, out):
                add_railing(solids, frame.sub(0.0, v), (f.length, end), mid, railing, kerb=True)
            if self.turn:
                back = frame.sub(end + KERB / 2, 0.0, np.pi / 2)
                add_railing(solids, back, (-wide, wide), mid, railing, kerb=True)
        for v in lower:
            add_railing(solids, frame.sub(0.0, v), (0.0, f.length), z, railing, rise=half, kerb=True)
            add_railing(solids, second.sub(0.0, c + v), (0.0, f.length), mid, railing, rise=half, kerb=True)
        points = [(-MOUTH, -c, z), (0.0, -c, z), (f.length, -c, mid)]
        if self.turn:
            turn = f.length + self.landing / 2
            points += [(turn, -c, mid), (turn, c, mid), (f.length, c, mid), (0.0, c, top), (-MOUTH, c, top)]
        else:
            points += [(end, 0.0, mid), (end + f.length, 0.0, top), (end + f.length + MOUTH, 0.0, top)]
        return Connector(self.kind, frame.path(points), f.width, (layer, layer + 2))

    def guard(self, solids: SolidsBuilder, frame: Frame, z: float, railing: Railing, *, departs: bool) -> None:
        """Railings on the floor at ``z`` around the shaft, and across its mouth if no flight ``departs``."""
        if self.walled and departs:
            return
        out = self.half_width + KERB / 2
        for v in (-out, out):
            add_railing(solids, frame.sub(0.0, v), (0.0, self.length), z, railing)
        if self.turn:
            add_railing(solids, frame.sub(self.length + KERB / 2, 0.0, np.pi / 2), (-out, out), z, railing)
        if not departs:
            across = (-out, 0.0) if self.turn else (-out, out)
            add_railing(solids, frame.sub(-KERB / 2, 0.0, np.pi / 2), across, z, railing)
