"""Numbers of the Poisson safety filter (paper, Sec. III-E "Poisson Safety Filter")."""

from __future__ import annotations

from typing import Self

from pydantic import Field, model_validator

from romnav.config import Config, Count, NonNegative, Positive

GROUND_CELLS = 2
"""Cells along the side of a patch of which the ground's height is kept."""
MOST_CELLS = 1024
"""Along the grid's side: its solution still fits into memory."""


class OccupancySpec(Config):
    """How a point cloud becomes a local occupancy grid."""

    cell: Positive = 0.05
    """Side of a cell, m (P)."""
    size: Positive = 6.0
    """Side of the square grid around the robot, m (A: three seconds of travel either way)."""
    radius: Positive = 0.26
    """Radius of the disc that holds the robot, m (A: the G1's meshes with its arms hanging; `robot.spec.BodySpec`)."""
    margin: NonNegative = 0.107
    """Added to the radius, m (A: 1.5 sqrt(2) cells, the least for which h > 0 proves that the disc is clear
    of every point, whatever the rounding to cells; 0 is the paper's plain convolution)."""
    step: Positive = 0.3
    """Height above the ground up to which a return is ground, m (A: the highest riser, 0.18 m, and three
    standard deviations of 0.02 m at either edge of it). Lower obstacles are the policy's to see."""
    slope: NonNegative = 0.7
    """Steepest rise per metre across ground that was not seen (A: the steepest stair, 0.18 / 0.26)."""
    height: Positive = 1.4
    """Height above the ground from which the robot passes beneath a return, m (A: the G1 stands 1.32 m)."""
    memory: int = Field(25, ge=1, lt=2**14)
    """Calls for which a return is remembered where the robot's motion is told (A: 5 s; 1 remembers nothing, as the
    paper, which mentions no memory)."""
    blind: NonNegative = 0.7
    """Distance within which a remembered return ages by the robot's way in place of time, m (A: the mounted LiDAR loses
    what is 0.3 m high at 0.68 m; a robot held in front of a bench would walk into it once it were forgotten)."""
    still: NonNegative = 0.2
    """Way counts once a robot is so far from where it was last counted, m (A: pressed against the boundary it trembles
    by a decimetre, 12 m in two minutes without leaving)."""
    travel: Positive = 3.0
    """Way after which what is near is forgotten, m (A: some 4 s of walking; not more, since what was a ledge from below
    is in the way of a robot that has climbed the stair)."""

    @property
    def cells(self) -> int:
        """Along the grid's side."""
        return GROUND_CELLS * round(self.size / (GROUND_CELLS * self.cell))

    @model_validator(mode="after")
    def _holds_the_robot(self) -> Self:
        if self.radius < self.cell:
            raise ValueError(
                f"radius: {self.radius} m, smaller than a cell (cell), {self.cell} m; choose smaller cells"
            )
        if self.size > MOST_CELLS * self.cell:
            raise ValueError(f"cell: {self.size} m (size) are more than {MOST_CELLS} cells of {self.cell} m; widen it")
        if self.cells * self.cell <= 4 * (self.radius + self.margin):
            raise ValueError(
                f"size: {self.size} m, too small for a radius of {self.radius} m and a margin of {self.margin} m; "
                "at least four times their sum is needed"
            )
        return self


class PoissonSpec(Config):
    """How Poisson's equation is solved: red-black successive over-relaxation, warm-started."""

    omega: float = Field(1.92, gt=0, lt=2)
    """Over-relaxation factor (A: near the best of 1.5-1.96 both in clutter and on an empty grid)."""
    sweeps: Count = 80
    """Sweeps from the previous solution (A: walking and turning among poles, 0.2 % of max h on average, 2 %
    at most, and the command to 2 mm/s)."""
    cold_sweeps: Count = 400
    """Sweeps from nothing: a robot's first solve, or its first after a reset (A)."""


class FilterSpec(Config):
    """The barrier and the limits of the command."""

    alpha: Positive = 0.75
    """Decay rate of the barrier condition ``dh/dt >= -alpha h``, 1/s (P)."""
    period: Positive = 0.2
    """Time for which a command is held, s (A: navigation's 5 Hz)."""
    retain: float = Field(0.5, gt=0, lt=1)
    """Share of h that must remain at every instant of that time (A: any share in (0, 1) keeps h positive;
    less than ``1 - alpha period``, so that it only acts where h is strongly curved)."""
    escape: NonNegative = 0.1
    """Speed at which a robot inside the inflated region is led out, m/s (A: the barrier condition alone
    approaches the boundary, but reaches it never)."""
    forward: Positive = 1.0
    """Largest velocity ahead, m/s (P)."""
    reverse: NonNegative = 0.5
    """Largest velocity backwards, m/s (A)."""
    lateral: NonNegative = 0.25
    """Largest velocity to either side, m/s (P)."""
    box: bool = True
    """Whether the filtered command must keep these limits, too; else it is the paper's single half-plane."""


class SafetySpec(Config):
    """The whole filter, from points to command."""

    occupancy: OccupancySpec = OccupancySpec()
    poisson: PoissonSpec = PoissonSpec()
    filter: FilterSpec = FilterSpec()
