"""Configuration of the world."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from romnav.config import Config


class GridSpec(Config):
    """How solids become occupancy grids."""

    cell: float = 0.2
    """Cell side, m (P)."""
    robot_radius: float = 0.3
    """Radius by which obstacles and drop-offs are inflated, m (A: half the width of a G1 with its arms)."""
    robot_height: float = 1.4
    """Clearance that the robot needs above the walking surface, m (A: a G1 stands 1.32 m tall)."""
    max_step: float = 0.25
    """Height difference between neighbouring cells that is still walked over, m (A: above the highest riser)."""


class WorldSpec(Config):
    """A set of tiles made from one seed."""

    tiles: int = 48
    """Number of tiles; classes take turns."""
    seed: int = 0
    """Seed of the generator; evaluation uses another one (P)."""
    side: float = 40.0
    """Tile side, m (A: beyond the paper's cap of 30 m, so that the caps differ and stairs are to be searched for)."""
    classes: tuple[str, ...] = ("building", "outdoor", "building", "room")
    """Tile classes in turn (A: half of the tiles are multi-story, where the paper's question lies)."""
    riser: tuple[float, float] = (0.10, 0.18)
    """Range of stair risers, m (A)."""
    tread: tuple[float, float] = (0.26, 0.32)
    """Range of stair treads, m (A)."""
    storey_height: float = 4.0
    """Height between floors, m (P)."""
    max_storeys: int = Field(default=3, ge=1, le=3)
    """Most floors of a building (P)."""
    goals_per_tile: int = 96
    """Goal cells per tile, each with its own geodesic field (A: memory, 2 bytes per free cell and goal)."""
    grid: GridSpec = GridSpec()
    """Occupancy grids."""


class SamplerSpec(Config):
    """Spawn and goal distribution (paper, Sec. III-D)."""

    stair_probability: float = 0.3
    """Share of spawns on or at the mouth of a stair or ramp (P); 0 is the paper's Uniform arm."""
    cap: Literal["geodesic", "euclidean"] = "geodesic"
    """Distance by which goals are capped (P); "euclidean" is the paper's NoCap arm."""
    max_distance: float = 30.0
    """Cap, m (P)."""
    min_distance: float = 1.0
    """Nearest goal, geodesic, m (A: nearer ones are reached by standing still)."""
    cross_probability: float = 0.5
    """Share of cross-level goals where a tile has any (P); three-story tiles always draw them (P)."""
