"""Outdoor terrain: terraces, streets and parks at several heights, joined by steps and ramps."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from romnav.world.solids import Label, SolidsBuilder
from romnav.world.spec import WorldSpec
from romnav.world.tile import Connector, Tile, TileClass
from romnav.world.tiles.furniture import ROAD, STREET, Item, furnish
from romnav.world.tiles.site import Floor, Frame, Span, block, cut, edges
from romnav.world.tiles.stairs import MOUTH, SLAB, Railing, add_flight, add_railing, draw_ramp, draw_stair

EDGE = 0.3
"""Depth of the boundary wall, hedge or fence, m."""
UPPER = 2.4
"""Ground above this height belongs to the upper layer, so that a bridge may lead over the lower one, m."""
LANDING, LANDING_ABOVE = 1.5, 5.0
"""Depth of the landing in the middle of a flight, m, and the rise above which a flight has one, m."""
CURB = (0.08, 0.15)
"""Heights that are stepped over, m."""


@dataclass
class Plot:
    """A level rectangle of terrain, in the tile frame; ``notches`` are cut out of it for inset stairs."""

    u: Span
    v: Span
    z: float = 0.0
    items: tuple[Item, ...] = STREET
    notches: list[tuple[Span, Span]] = field(default_factory=list)

    @property
    def size(self) -> tuple[float, float]:
        """Extents, m."""
        return self.u[1] - self.u[0], self.v[1] - self.v[0]

    @property
    def frame(self) -> Frame:
        """Frame at its corner."""
        return Frame(self.u[0], self.v[0])

    def contains(self, frame: Frame, u: Span, v: Span) -> bool:
        """Whether a rectangle local to ``frame`` lies within."""
        x, y = np.transpose([frame.at(a, b) for a in u for b in v])
        slack = 1e-6
        return bool(
            x.min() > self.u[0] - slack
            and x.max() < self.u[1] + slack
            and y.min() > self.v[0] - slack
            and y.max() < self.v[1] + slack
        )


def outdoor(rng: np.random.Generator, spec: WorldSpec, index: int) -> Tile:
    """A fenced piece of terrain in one of three layouts, with street furniture."""
    layout: Callable[[np.random.Generator, float], list[Plot]] = (_terraces, _street, _park)[int(rng.integers(3))]
    plots = layout(rng, spec.side)
    site = _Site(rng, spec, max(plot.z for plot in plots))
    if layout is _street:
        site.bridge(plots)
    site.join(plots)
    for plot in plots:
        for u, v in cut((plot.u, plot.v), plot.notches):
            block(site.solids, Frame(0.0, 0.0), u, v, (-0.2, plot.z), label=Label.GROUND, layers=site.layers(plot.z))
        if min(plot.size) > 7.0:
            site.podiums(plot)
    site.border(plots)
    for plot in plots:
        count = int(rng.poisson(plot.size[0] * plot.size[1] / 11.0))
        furnish(site.solids, rng, site.floor, plot.frame, plot.size, plot.z, plot.items, count, turn=0.8)
    return Tile(
        kind=TileClass.OUTDOOR,
        index=index,
        side=spec.side,
        solids=site.solids.build(),
        layers=site.heights,
        storeys=tuple(range(len(site.heights))),
        connectors=tuple(site.connectors),
    )


def _terraces(rng: np.random.Generator, side: float) -> list[Plot]:
    """Plots of a recursive bisection at heights that differ by a storey or two, a few steps or a curb."""
    climbs = np.cumsum([0.0, rng.uniform(0.5, 1.5), rng.uniform(2.8, 4.0), rng.uniform(3.5, 4.2)])
    plots = _divide(rng, (0.0, side), (0.0, side), side / 3)
    for plot in plots:
        plot.z = float(climbs[rng.choice(4, p=(0.3, 0.15, 0.3, 0.25))])
        if rng.random() < 0.25:
            plot.z += float(rng.uniform(*CURB))
    return plots


def _divide(rng: np.random.Generator, u: Span, v: Span, most: float) -> list[Plot]:
    """Plots of a rectangle, none longer than ``most`` but by a third."""
    du, dv = u[1] - u[0], v[1] - v[0]
    if max(du, dv) < most or (max(du, dv) < 4 / 3 * most and rng.random() < 0.3):
        return [Plot(u, v)]
    at = float(rng.uniform(0.35, 0.65))
    if du > dv or (du == dv and rng.random() < 0.5):
        middle = u[0] + at * du
        return _divide(rng, (u[0], middle), v, most) + _divide(rng, (middle, u[1]), v, most)
    middle = v[0] + at * dv
    return _divide(rng, u, (v[0], middle), most) + _divide(rng, u, (middle, v[1]), most)


def _street(rng: np.random.Generator, side: float) -> list[Plot]:
    """A road between kerbed pavements; behind them gardens, some as high as the others that are a storey up."""
    road, walks = float(rng.uniform(4.5, 6.5)), rng.uniform(2.2, 3.4, 2)
    spare = side - road - float(walks.sum())
    first = float(rng.uniform(0.35, 0.65)) * spare
    cuts = np.cumsum([0.0, first, walks[0], road, walks[1]])
    lines = [*(float(c) for c in cuts), side]
    curb = float(rng.uniform(*CURB))
    turned = rng.random() < 0.5
    storey = curb + float(rng.uniform(3.5, 4.3))
    plots = []

    def add(along: Span, across: Span, z: float, items: tuple[Item, ...]) -> None:
        plots.append(Plot(across, along, z, items) if turned else Plot(along, across, z, items))

    for k, z in ((1, curb), (2, 0.0), (3, curb)):
        add((0.0, side), (lines[k], lines[k + 1]), z, ROAD if k == 2 else STREET)
    for k in (0, 4):
        count = int(rng.integers(1, 4))
        ends = np.linspace(0.0, side, count + 1)
        for a, b in itertools.pairwise(ends):
            z = float(rng.choice([curb, curb + rng.uniform(0.4, 1.5), storey], p=(0.2, 0.2, 0.6)))
            add((float(a), float(b)), (lines[k], lines[k + 1]), z, STREET)
    return plots


def _park(rng: np.random.Generator, side: float) -> list[Plot]:
    """A hillside: two meadows two storeys apart, or each a climb from a narrower terrace between them."""
    if rng.random() < 0.8:
        lines = np.array([0.0, side * float(rng.uniform(0.4, 0.6)), side])
        heights = np.array([0.0, float(rng.uniform(7.6, 8.4))])
    else:
        terrace = float(rng.uniform(5.5, 9.0))
        first = float(rng.uniform(0.4, 0.6)) * (side - terrace)
        lines = np.array([0.0, first, first + terrace, side])
        rises = [float(rng.choice([rng.uniform(0.5, 2.0), rng.uniform(3.6, 4.3)], p=(0.15, 0.85))) for _ in range(2)]
        heights = np.cumsum([0.0, *rises])
    strips = zip(itertools.pairwise(lines.tolist()), heights.tolist(), strict=True)
    return [Plot((0.0, side), across, z) for across, z in strips]


class _Site:
    """The solids, reservations and connectors of one outdoor tile under construction."""

    def __init__(self, rng: np.random.Generator, spec: WorldSpec, highest: float) -> None:
        self.rng, self.spec = rng, spec
        self.heights = (0.0, 2 * UPPER) if highest > UPPER else (0.0,)
        """Reference heights of its layers, which change half way between, at `UPPER`."""
        self.mouths: list[tuple[float, float]] = []
        """Middles of the ends of bridges, on edges of plots."""
        self.last: tuple[float, float] | None = None
        """Top of the last long flight between plots: the next one often goes on near it."""
        self.solids = SolidsBuilder()
        self.connectors: list[Connector] = []
        self.railing = Railing.draw(rng)
        self.floor = Floor(spec.side)
        self.floor.open(Frame(0.0, 0.0), (EDGE, spec.side - EDGE), (EDGE, spec.side - EDGE))

    def layers(self, low: float, high: float | None = None) -> tuple[int, int]:
        """First and last layer of a surface from height ``low`` to ``high``."""
        return int(low > UPPER), int((low if high is None else high) > UPPER)

    def bridge(self, plots: list[Plot]) -> None:
        """Lead bridges over the lower ground between opposite plots of one height on the upper layer."""
        pairs = [(a, b) for a, b in itertools.permutations([p for p in plots if p.z > UPPER], 2)]
        for a, b in pairs:
            across = a.v[1] < b.v[0] and a.z == b.z
            if not across and not (a.u[1] < b.u[0] and a.z == b.z):
                continue
            one, other = (a.u, b.u) if across else (a.v, b.v)
            low, high = max(one[0], other[0]) + 1.5, min(one[1], other[1]) - 1.5
            width = float(self.rng.uniform(1.8, 2.6))
            if high - low < width or self.rng.random() < 0.35:
                continue
            at = float(self.rng.uniform(low + width / 2, high - width / 2))
            deck = Frame(at, a.v[1], np.pi / 2) if across else Frame(a.u[1], at)
            span = b.v[0] - a.v[1] if across else b.u[0] - a.u[1]
            half = width / 2
            if not self.floor.fits(deck, (-1.5, span + 1.5), (-half, half)):
                continue
            block(
                self.solids, deck, (0.0, span), (-half, half), (a.z - SLAB, a.z),
                label=Label.GROUND, layers=self.layers(a.z),
            )  # fmt: skip
            for side in (-1, 1):
                add_railing(self.solids, deck.sub(0.0, side * (half - 0.04)), (0.0, span), a.z, self.railing)
            self.floor.reserve(deck, (-1.5, span + 1.5), (-half - 0.2, half + 0.2))
            self.mouths += [deck.at(0.0, 0.0), deck.at(span, 0.0)]

    def openings(self, frame: Frame, length: float) -> list[Span]:
        """Stretches of an edge along u that a bridge opens."""
        spans = []
        for x, y in self.mouths:
            u, v = frame.local(x, y)
            if abs(v) < 1e-6 and 0.0 < u < length:
                spans.append((u - 1.4, u + 1.4))
        return spans

    def join(self, plots: list[Plot]) -> None:
        """Join neighbouring plots by flights along their shared edges: all that need one, and more."""
        group = list(range(len(plots)))
        pairs = [(a, b) for a in range(len(plots)) for b in range(a) if _shared(plots[a], plots[b])]
        for k in self.rng.permutation(len(pairs)):
            low, high = sorted(pairs[int(k)], key=lambda i: plots[i].z)
            rise = plots[high].z - plots[low].z
            shared = _shared(plots[high], plots[low])
            assert shared is not None
            if rise <= CURB[1]:
                joined = True
            else:
                wanted = int(self.rng.random() < 0.25)
                if group[low] != group[high]:
                    wanted = 1 + int(self.rng.poisson(shared[1] / (90.0 if rise < LANDING_ABOVE else 14.0)))
                joined = self.climb(*shared, plots[low].z, rise, wanted, (plots[low], plots[high])) > 0
            if joined:
                group = [group[low] if g == group[high] else g for g in group]

    def climb(
        self,
        frame: Frame,
        length: float,
        z: float,
        rise: float,
        wanted: int,
        plots: tuple[Plot, Plot] | None = None,
    ) -> int:
        """Build up to ``wanted`` flights over the edge along u (lower ground at v > 0), perhaps a railing.

        Flights stand before the edge or, between two ``plots`` (lower, upper), in a notch of the upper one.
        Returns how many were built.
        """
        rng = self.rng
        built: list[Span] = []
        for _ in range(8 * wanted):
            if len(built) == wanted:
                break
            widest = length - 0.9
            widths = [rng.uniform(1.4, 2.2), rng.uniform(2.2, 3.5), rng.uniform(3.5, 6.0)]
            width = float(rng.choice(widths, p=(0.65, 0.3, 0.05) if rise < 1.5 else (0.85, 0.15, 0.0)))
            if min(width, widest) < 1.4:
                break
            width = min(width, widest)
            count = 1 + int(rise > LANDING_ABOVE)
            each = rise / count
            flight = (
                draw_ramp(rng, each, width, (9.0, 15.0) if rise < 1.5 else (13.0, 15.0))
                if rng.random() < (0.35 if rise < 1.5 else 0.15 if count == 1 else 0.0)
                else draw_stair(rng, self.spec, each, width, 1.35 if rise < 1.5 else 1.15)
            )
            run = count * flight.length + (count - 1) * LANDING
            inset = plots is not None and (count > 1 or rng.random() < (0.35 if rise < 1.5 else 0.6))
            at = float(rng.uniform(0.4, length - width - 0.4)) + width / 2
            if plots is not None and self.last is not None and rng.random() < 0.7:
                near = frame.local(*self.last)[0] + float(rng.normal(0.0, 3.0))
                at = float(np.clip(near, 0.4 + width / 2, length - 0.4 - width / 2))
            foot = frame.sub(at, 0.0 if inset else run, -np.pi / 2)
            v = (-width / 2, width / 2)
            if not self.floor.fits(foot, (-1.3, run + 1.3), (v[0] - 0.15, v[1] + 0.15)):
                continue
            brink = 0.0 if inset else run
            if plots is not None and not (
                plots[0].contains(foot, (-1.3, brink), v) and plots[1].contains(foot, (brink, run + 1.3), v)
            ):
                continue
            if plots is not None and rise > 1.5:
                self.last = foot.at(run, 0.0)
            layers = self.layers(z, z + rise)
            points = [(-MOUTH, 0.0, z)]
            for k in range(count):
                u, low = k * (flight.length + LANDING), z + k * each
                if k:
                    landing = (u - LANDING, u)
                    block(self.solids, foot, landing, v, (z - 0.1, low), label=Label.GROUND, layers=layers)
                add_flight(self.solids, foot.sub(u, 0.0), low, flight, layers, base=z - 0.1)
                points += [(u, 0.0, low), (u + flight.length, 0.0, low + each)]
            points.append((run + MOUTH, 0.0, z + rise))
            built.append((at - width / 2, at + width / 2))
            self.connectors.append(Connector(flight.kind, foot.path(points), width, layers))
            guarded = rise > 0.5 and rng.random() < 0.6
            if inset and plots is not None:
                corners = [foot.at(u, w) for u in (0.0, run) for w in v]
                xs, ys = zip(*corners, strict=True)
                plots[1].notches.append(((min(xs), max(xs)), (min(ys), max(ys))))
            for side in (-1, 1) if guarded else ():
                if inset:
                    rail = foot.sub(0.0, side * (width / 2 + 0.06))
                    add_railing(self.solids, rail, (0.0, run), z + rise, self.railing)
                else:
                    rail = foot.sub(0.0, side * (width / 2 - 0.04))
                    add_railing(self.solids, rail, (0.0, run), z, self.railing, rise=rise)
            self.floor.reserve(foot, (-1.4, run + 1.4), v, 0.7)
        if rng.random() < 0.6 and rise > 0.3:
            edge = 0.0
            for start, end in [*sorted(built + self.openings(frame, length)), (length, length)]:
                if start - edge > 0.6:
                    add_railing(self.solids, frame.sub(0.0, -0.05), (edge, start), z + rise, self.railing)
                edge = max(edge, end)
        self.floor.reserve(frame, (0.0, length), (-0.8, 0.4))
        return len(built)

    def podiums(self, plot: Plot) -> None:
        """Rotated platforms on a plot: climbed by flights, or islands as high as a curb."""
        for _ in range(int(self.rng.integers(0, 3))):
            for _ in range(6):
                at = plot.frame.sub(*(float(x) for x in self.rng.uniform((0.0, 0.0), plot.size)))
                yaw = float(self.rng.uniform(0.0, 2 * np.pi))
                size = (float(self.rng.uniform(2.5, 7.0)), float(self.rng.uniform(2.5, 5.0)))
                corner = at.sub(0.0, 0.0, yaw).sub(-size[0] / 2, -size[1] / 2)
                if self.floor.fits(corner, (-1.3, size[0] + 1.3), (-1.3, size[1] + 1.3)):
                    self.podium(corner, size, plot.z, tier=0)
                    break

    def podium(self, frame: Frame, size: tuple[float, float], z: float, tier: int) -> None:
        """A platform at ``frame`` on ground at ``z``, perhaps with another on top of it."""
        rng = self.rng
        island = tier == 0 and rng.random() < 0.25
        rise = float(rng.uniform(*CURB)) if island else float(rng.uniform(0.3, 1.3))
        if self.layers(z) != self.layers(z + rise):
            return
        ground = ((0.0, size[0]), (0.0, size[1]))
        block(self.solids, frame, *ground, (z - 0.1, z + rise), label=Label.GROUND, layers=self.layers(z + rise))
        sides = edges(frame, size)
        for k in rng.permutation(4)[: 0 if island else 1]:
            side, length = sides[int(k)]
            self.climb(side, length, z, rise, 1)
        for side, length in sides:
            self.floor.reserve(side, (0.0, length), (-0.5, 0.5))
        if not island and tier == 0 and min(size) > 4.6 and rng.random() < 0.7:
            inner = (size[0] - 3.0, size[1] - 3.0)
            corner = frame.sub(float(rng.uniform(0.6, 2.4)), float(rng.uniform(0.6, 2.4)))
            if self.floor.fits(corner, (0.0, inner[0]), (0.0, inner[1])):
                self.podium(corner, inner, z + rise, tier=1)
        count = int(rng.poisson(size[0] * size[1] / 9.0))
        furnish(self.solids, rng, self.floor, frame, size, z + rise, STREET, count, turn=0.5)
        self.floor.reserve(frame, *ground)

    def border(self, plots: list[Plot]) -> None:
        """Close the tile: on each side a wall, hedge, fence or house front on the plots' own heights."""
        styles = self.rng.choice(["wall", "hedge", "fence", "front"], 4)
        heights = self.rng.uniform((1.2, 1.0, 1.1, 3.5), (2.4, 1.6, 1.5, 6.0))
        fence = Railing(self.railing.spacing, 3, float(heights[2]))
        side = self.spec.side
        for plot in plots:
            for k, (frame, length) in enumerate(edges(plot.frame, plot.size)):
                x, y = frame.sub(0.0, 1e-3).at(length / 2, 0.0)
                if 0.0 < x < side and 0.0 < y < side:
                    continue
                if styles[k] == "fence":
                    add_railing(self.solids, frame.sub(0.0, -EDGE / 2), (0.0, length), plot.z, fence)
                    continue
                height = float(heights[["wall", "hedge", "fence", "front"].index(styles[k])])
                block(self.solids, frame, (0.0, length), (-EDGE, 0.0), (plot.z - 0.1, plot.z + height))


def _shared(a: Plot, b: Plot) -> tuple[Frame, float] | None:
    """Shared edge of two plots: frame at its start with u along it and v towards ``b``, and its length."""
    for frame, length in edges(a.frame, a.size):
        for other, reach in edges(b.frame, b.size):
            du, dv = other.x - frame.x, other.y - frame.y
            c, s = np.cos(frame.yaw), np.sin(frame.yaw)
            end, across = c * du + s * dv, c * dv - s * du
            if abs(across) > 1e-6 or abs(np.cos(frame.yaw - other.yaw) + 1.0) > 1e-6:
                continue
            low, high = max(0.0, end - reach), min(length, end)
            if high - low > 2.4:
                return frame.sub(low, 0.0), high - low
    return None
