"""Configuration of the world."""

from __future__ import annotations

import math
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from romnav.config import Config, Count, NonNegative, Positive, Range, Seed, Share
from romnav.parts import Kind

SMALLEST = {"building": 12.0, "outdoor": 20.0, "room": 10.0}
"""Least side at which the generator of a class finds room for what belongs to it, m."""
TILES = Kind("tile class", "romnav.tiles", "romnav.world.tile:TileGenerator", builtin=tuple(SMALLEST))
TileName = Annotated[str, TILES]
LARGEST = 100.0
"""Largest side, m: geodesics are kept up to 255 m."""
DOORWAY = 1.2
"""Narrowest doorway of the generators, m."""
LEAST_RISER, LEAST_TREAD = 0.05, 0.15
"""Flatter and shorter steps are no stairs, m."""
MOST_TREAD = 1.0
"""So that a flight fits into a building, m."""
MOST_CELLS = 1000
"""Cells along a tile's side that still fit into memory."""


class GridSpec(Config):
    """How solids become occupancy grids."""

    cell: Positive = 0.2
    """Cell side, m (P)."""
    robot_radius: Positive = 0.3
    """Radius by which obstacles and drop-offs are inflated, m (A: half the width of a G1 with its arms)."""
    robot_height: float = Field(default=1.4, gt=0.0, le=2.0)
    """Clearance that the robot needs above the walking surface, m (A: a G1 is 1.32 m tall, lintels 2.05 m)."""
    max_step: Positive = 0.25
    """Height difference between neighbouring cells that is still walked over, m (A: above the highest riser)."""


class WorldSpec(Config):
    """A set of tiles made from one seed."""

    tiles: int = Field(default=48, ge=1, le=2**16)
    """Number of tiles; classes take turns."""
    seed: Seed = 0
    """Seed of the generator; evaluation uses another one (P)."""
    side: float = Field(default=40.0, ge=min(SMALLEST.values()), le=LARGEST)
    """Tile side, m (A: beyond the paper's cap of 30 m, so that the caps differ and stairs are to be searched for)."""
    classes: tuple[TileName, ...] = Field(default=("building", "outdoor", "building", "room"), min_length=1)
    """Tile classes in turn, one from outside as "pkg.mod:Name" (A: half of the tiles are multi-story, where the paper's
    question lies)."""
    riser: Range[float] = (0.10, 0.18)
    """Range of stair risers, m (A)."""
    tread: Range[float] = (0.26, 0.32)
    """Range of stair treads, m (A)."""
    storey_height: float = Field(default=4.0, ge=3.0, le=5.0)
    """Height between floors, m (P)."""
    max_storeys: int = Field(default=3, ge=1, le=3)
    """Most floors of a building (P)."""
    goals_per_tile: Count = 96
    """Goal cells per tile, each with its own geodesic field (A: memory, 2 bytes per free cell and goal)."""
    grid: GridSpec = GridSpec()
    """Occupancy grids."""

    @model_validator(mode="after")
    def _can_be_built(self) -> Self:
        if fault := self._fault():
            raise ValueError(fault)
        return self

    def _fault(self) -> str | None:
        """Why no generator could build this, and what to change."""
        cell, step, radius = self.grid.cell, self.grid.max_step, self.grid.robot_radius
        for name in dict.fromkeys(self.classes):
            smallest = SMALLEST.get(name) or TILES.load(name).smallest
            if self.side < smallest:
                return f"side: {self.side} m; a tile of class {name} takes {smallest} m or more"
        cells = self.side / cell
        if cells > MOST_CELLS:
            return f"grid.cell: {self.side} m are {cells:.0f} cells of {cell} m; {MOST_CELLS} are the most, widen it"
        if abs(cells - round(cells)) > 1e-6:
            return f"side: {self.side} m are {cells:.2f} cells of {cell} m (grid.cell); make it a whole number of them"
        if self.riser[0] < LEAST_RISER:
            return f"riser: {self.riser[0]} m; set both ends of the range to {LEAST_RISER} m or more"
        if self.tread[0] < LEAST_TREAD:
            return f"tread: {self.tread[0]} m; set both ends of the range to {LEAST_TREAD} m or more"
        if self.tread[1] > MOST_TREAD:
            return f"tread: {self.tread[1]} m; set both ends of the range to {MOST_TREAD} m or less"
        if self.riser[1] > step:
            return f"riser: up to {self.riser[1]} m, above grid.max_step, {step} m: no stair could be walked; lower it"
        climb = math.ceil(cell / self.tread[0] - 1e-9) * self.riser[1]
        if climb > step:
            return (
                f"grid.cell: treads of {self.tread[0]} m and risers of {self.riser[1]} m climb {climb:.2f} m from one "
                f"cell of {cell} m to the next, above grid.max_step, {step} m; lower grid.cell"
            )
        if 2 * radius + math.sqrt(2) * cell > DOORWAY:
            return (
                f"grid.robot_radius: {radius} m and cells of {cell} m (grid.cell) leave no way through a door of "
                f"{DOORWAY} m; lower one of them"
            )
        return None


class SamplerSpec(Config):
    """Spawn and goal distribution (paper, Sec. III-D)."""

    stair_probability: Share = 0.3
    """Share of spawns on or at the mouth of a stair or ramp (P); 0 is the paper's Uniform arm."""
    cap: Literal["geodesic", "euclidean"] = "geodesic"
    """Distance by which goals are capped (P); "euclidean" is the paper's NoCap arm."""
    max_distance: Positive = 30.0
    """Cap, m (P)."""
    min_distance: NonNegative = 1.0
    """Nearest goal, geodesic, m (A: nearer ones are reached by standing still)."""
    cross_probability: Share = 0.5
    """Share of cross-level goals where a tile has any (P); three-story tiles always draw them (P)."""

    @model_validator(mode="after")
    def _leaves_goals(self) -> Self:
        if self.min_distance >= self.max_distance:
            raise ValueError(
                f"min_distance: {self.min_distance} m, not below max_distance, {self.max_distance} m; lower it"
            )
        return self
