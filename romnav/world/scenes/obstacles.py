"""The three obstacle sets of the safety experiment, in one hall (paper, Sec. IV-C and Fig. 5)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from romnav.world.scenes.scene import Area, Scene
from romnav.world.solids import Label, SolidsBuilder
from romnav.world.tile import Tile, TileClass
from romnav.world.tiles.site import Frame, block, edges

SIDE = 12.0
WALL = 0.2
HALL = Frame(0.8, 2.0), (10.4, 8.0)
"""Inner corner and extents of the hall, m (A: a laboratory of the size that the paper's times to goal suggest)."""
TUBE = 0.05
"""Diameter of a tube, m (A: cardboard, as posters are sent in)."""


def obstacle_scenes() -> tuple[Scene, ...]:
    """In-distribution, out-of-distribution and adversarial obstacles between the same starts and goals."""
    return (
        _scene("in-distribution", "In-Distribution", 0, _solid_and_convex),
        _scene("out-of-distribution", "Out-of-Distribution", 1, _ladders),
        _scene("adversarial", "Adversarial", 2, _hanging_tubes),
    )


def _scene(name: str, label: str, index: int, add_obstacles: Callable[[SolidsBuilder], None]) -> Scene:
    solids = SolidsBuilder()
    corner, (length, depth) = HALL
    margin = (-WALL, length + WALL), (-WALL, depth + WALL)
    block(solids, corner, *margin, (-0.2, 0.0), label=Label.GROUND, layers=(0, 0))
    for side, run in edges(corner, (length, depth)):
        block(solids, side, (-WALL, run), (0.0, WALL), (-0.2, 3.0))
    add_obstacles(solids)
    tile = Tile(TileClass.ROOM, index, SIDE, solids.build(), layers=(0.0,), storeys=(0,), connectors=())
    start, goal = (Area(Frame(x, 6.0), (0.8, 5.6)) for x in (2.2, 9.8))
    return Scene(name, label, tile, start, goal, both_ways=True)


def _solid_and_convex(solids: SolidsBuilder) -> None:
    solids.box((4.5, 4.4), (0.7, 0.7), (0.0, 1.2), yaw=0.4)
    solids.cylinder((4.9, 7.3), 0.35, (0.0, 1.5))
    solids.box((6.1, 5.9), (1.1, 0.5), (0.0, 1.0), yaw=1.2)
    solids.cylinder((6.3, 3.3), 0.3, (0.0, 1.8))
    solids.box((7.2, 8.2), (0.6, 0.6), (0.0, 0.8), yaw=0.7)
    solids.box((7.7, 4.6), (0.8, 0.6), (0.0, 1.4), yaw=-0.3)
    solids.cylinder((7.9, 6.5), 0.25, (0.0, 1.1))


def _ladders(solids: SolidsBuilder) -> None:
    for ladder in (Frame(4.9, 4.6, 0.5), Frame(7.0, 7.0, -1.0)):
        _stepladder(solids, ladder)
        _tube(solids, ladder.sub(0.05, 0.25, np.pi / 2), 1.9, 1.22)
        _tube(solids, ladder.sub(-0.6, 0.0, 0.15), 1.3, 0.95)
        _tube(solids, ladder.sub(0.45, -0.2, -0.5), 1.2, 0.62)


def _stepladder(solids: SolidsBuilder, frame: Frame) -> None:
    """Rails of 6 x 3 cm that lean together at 1.8 m, steps in front, two bars behind."""
    height, reach, half = 1.8, 0.5, 0.24
    slope = height / reach
    tall = 0.06 * float(np.hypot(1.0, slope))
    for turn in (0.0, np.pi):
        side = frame.sub(0.0, 0.0, turn)
        for v in (-half, half):
            middle = (height - tall) / 2
            block(
                solids, side, (-reach, 0.0), (v - 0.015, v + 0.015), (middle, middle + tall),
                slope=slope, slope_bottom=slope,
            )  # fmt: skip
        for z, deep in [(0.3 * k, 0.08) for k in range(1, 6)] if turn == 0.0 else [(0.45, 0.03), (1.05, 0.03)]:
            u = -reach + z / slope + 0.03
            block(solids, side, (u - deep / 2, u + deep / 2), (-half + 0.015, half - 0.015), (z - 0.015, z + 0.015))


def _hanging_tubes(solids: SolidsBuilder) -> None:
    across = ((4.3, 3.9, 1.3), (4.5, 7.1, 1.9), (6.0, 5.6, 1.5), (7.3, 8.0, 0.9), (7.6, 4.4, 1.2))
    for x, y, yaw in across:
        _tube(solids, Frame(x, y, yaw), 1.1, 1.18)
    for x, y in ((4.4, 5.5), (5.6, 8.6), (5.7, 3.3), (7.2, 6.3)):
        solids.cylinder((x, y), TUBE / 2, (0.95, 1.6))


def _tube(solids: SolidsBuilder, middle: Frame, length: float, z: float) -> None:
    """A level tube along u at height ``z`` of its axis, as a bar of square section."""
    block(solids, middle, (-length / 2, length / 2), (-TUBE / 2, TUBE / 2), (z - TUBE / 2, z + TUBE / 2))
