"""What the navigation task asks of a body, reduced-order or humanoid."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

from torch import Tensor

from romnav.world.spawns import Start
from romnav.world.world import World


class Head(NamedTuple):
    """Where the sensors in the heads of ``E`` robots are, tile frame."""

    origin: Tensor
    """(E, 3) m."""
    yaw: Tensor
    """(E,) rad."""
    tilt: Tensor
    """(E, 2) roll and pitch, rad."""


class Dynamics(Protocol):
    """A batch of ``E`` robots driven by velocity commands at the navigation rate.

    Poses are in the tile frame, metres and radians; ``position`` lies on the walking surface under the robot.
    """

    tile: Tensor
    """(E,) int64."""
    layer: Tensor
    """(E,) int64."""
    position: Tensor
    """(E, 3) float32."""
    yaw: Tensor
    """(E,) float32."""
    contacts: Tensor
    """(E,) float32 bodies in contact with obstacles during the last step."""
    fallen: Tensor
    """(E,) bool."""

    @property
    def proprioception(self) -> Tensor:
        """(E, P) what the robot feels of its own motion; P is 0 for a body that has none (paper, Sec. III-B)."""
        ...

    @property
    def head(self) -> Head | None:
        """Where its sensors are; None for a body whose head never sways."""
        ...

    @property
    def joints(self) -> Tensor | None:
        """(E, Q) float64 generalised positions in MuJoCo's order, m, wxyz and rad; None of a body without joints."""
        ...

    def reset(self, envs: Tensor, start: Start) -> None:
        """Put the robots ``envs`` (K,) at their starts."""
        ...

    def step(self, command: Tensor) -> None:
        """Track the command (E, 3) of (vx, vy, wz), m/s and rad/s in the robot's yaw frame, for one period."""
        ...

    def select(self, envs: Tensor) -> None:
        """Keep only the robots ``envs`` (K,), in that order."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Everything that changes while stepping, as tensors."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue where `state_dict` was taken, to the bit."""
        ...


Body = Callable[[World, int, float], Dynamics]
"""Makes the dynamics of a world, a number of robots and a control period, s."""
