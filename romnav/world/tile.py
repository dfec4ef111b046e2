"""A tile: solids plus what the generator knows about their layers and connectors."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from romnav.world.solids import Solids
from romnav.world.spec import WorldSpec


class TileClass(StrEnum):
    """The paper's classes of tiles (Sec. III-D)."""

    OUTDOOR = "outdoor"
    ROOM = "room"
    BUILDING = "building"


@dataclass(frozen=True)
class Connector:
    """A staircase or ramp between two heights.

    ``path`` (K, 3) is its centre line over the walking surface from the lower mouth to the upper one, m: the
    mouths themselves are its first and last point, on flat ground. ``layers`` are the layers that it joins
    (equal where both ends lie on one layer, as outdoors).
    """

    kind: str
    """"stair", "u-stair" or "ramp"."""
    path: NDArray[np.float64]
    width: float
    layers: tuple[int, int]


@dataclass(frozen=True)
class Tile:
    """One generated tile of side ``side`` (m); frame: origin at a corner, z up, ground floor z = 0.

    Layers are single-valued walking surfaces, lowest first; ``layers[l]`` is the reference height of layer l.
    The robot's layer changes where its height crosses the midpoint of two reference heights (the paper's height
    threshold); around it both layers show the same connector surface. The floors of a building are its layers;
    the half landing of a stacked staircase may be a layer of its own, then ``storeys`` leaves it out.
    """

    kind: str
    """A `TileClass`, or the name of one from outside."""
    index: int
    """Number of the tile within its world."""
    side: float
    solids: Solids
    layers: tuple[float, ...]
    storeys: tuple[int, ...]
    """Layers that are floors, every one of them to be reachable from every other."""
    connectors: tuple[Connector, ...]
    draws: int = 1
    """Number of draws that it took until all of it was reachable."""

    @property
    def multi_story(self) -> bool:
        """Whether it has several floors; outdoors layers a storey apart, which need not lie above one another."""
        return len(self.storeys) > 1


class TileGenerator(Protocol):
    """A tile class: draws tiles from random numbers."""

    smallest: float
    """Least side at which it finds room for what belongs to it, m."""

    def __call__(self, rng: np.random.Generator, spec: WorldSpec, index: int) -> Tile:
        """Tile ``index`` of a world; it is drawn again until all of it is reachable."""
        ...
