"""The reduced-order model: a single integrator with heading that slides along occupied cells (paper, Sec. III-C)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from romnav.robot.dynamics import Head
from romnav.world.spawns import Start
from romnav.world.world import World

SUBSTEPS = 2
"""Half cells at top speed: a step never jumps over an occupied cell."""
_STATE = ("tile", "layer", "position", "yaw", "contacts", "fallen")


class ReducedOrderModel:
    """``E`` disc robots on the occupancy grids of a world; the `Dynamics` of the RoM stage.

    A command into an occupied cell loses its penetrating component, which on a grid is the axis of the crossed
    cell border, and the robot slides along the other one.
    """

    def __init__(self, world: World, envs: int, period: float) -> None:
        device = world.node.device
        self.world = world
        self.period = period
        self.tile = torch.zeros(envs, dtype=torch.int64, device=device)
        self.layer = torch.zeros(envs, dtype=torch.int64, device=device)
        self.position = torch.zeros(envs, 3, device=device)
        self.yaw = torch.zeros(envs, device=device)
        self.contacts = torch.zeros(envs, device=device)
        self.fallen = torch.zeros(envs, dtype=torch.bool, device=device)

    head: Head | None = None
    """Sensors stand upright above the ground, as on a standing humanoid (P)."""
    joints: Tensor | None = None

    @property
    def proprioception(self) -> Tensor:
        """(E, 0): it feels nothing."""
        return self.yaw.new_empty(len(self.yaw), 0)

    def reset(self, envs: Tensor, start: Start) -> None:
        """Put the robots ``envs`` (K,) at their starts."""
        self.tile[envs] = start.tile
        self.layer[envs] = start.layer
        self.yaw[envs] = start.yaw
        self.position[envs, :2] = start.xy
        self.position[envs, 2] = self.world.surface(start.tile, start.layer, start.xy)
        self.contacts[envs] = 0.0

    def select(self, envs: Tensor) -> None:
        """Keep only the robots ``envs`` (K,), in that order."""
        for name in _STATE:
            setattr(self, name, getattr(self, name)[envs])

    def state_dict(self) -> dict[str, Any]:
        """Everything that changes while stepping."""
        return {name: getattr(self, name).clone() for name in _STATE}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue where `state_dict` was taken."""
        for name in _STATE:
            setattr(self, name, state[name].clone())

    def step(self, command: Tensor) -> None:
        """Integrate the command (E, 3) for one period."""
        dt = self.period / SUBSTEPS
        touched = torch.zeros_like(self.fallen)
        for _ in range(SUBSTEPS):
            c, s = torch.cos(self.yaw), torch.sin(self.yaw)
            vx, vy = command[:, 0], command[:, 1]
            move = torch.stack([vx * c - vy * s, vy * c + vx * s], dim=1) * dt
            touched |= self._slide(move)
            self.yaw = self.yaw + command[:, 2] * dt
        self.yaw = torch.remainder(self.yaw + torch.pi, 2 * torch.pi) - torch.pi
        self.contacts = touched.to(torch.float32)

    def _slide(self, move: Tensor) -> Tensor:
        """Move by (E, 2), dropping penetrating components; whether anything was dropped."""
        world, here = self.world, self.position[:, :2]
        along_x, along_y = move.clone(), move.clone()
        along_x[:, 1] = 0.0
        along_y[:, 0] = 0.0
        x_first = move[:, 0].abs() >= move[:, 1].abs()
        tries = torch.stack(
            [
                move,
                torch.where(x_first[:, None], along_x, along_y),
                torch.where(x_first[:, None], along_y, along_x),
                torch.zeros_like(move),
            ]
        )
        target = here + tries
        node = world.node_at(self.tile.repeat(4), self.layer.repeat(4), target.flatten(0, 1)).view(4, -1)
        free = node >= 0
        # two occupied cells that touch at a corner let nothing through between them, as in `Grids.neighbours`
        diagonal = (world.index(target[0]) != world.index(here)).all(dim=1)
        free[0] &= ~diagonal | (free[1] & free[2])
        first = free.int().argmax(dim=0)
        row = torch.arange(len(first), device=first.device)
        xy = target[first, row]
        # no free candidate (a start in an occupied cell): argmax says 0, and the robot must stay
        stuck = ~free.any(dim=0)
        self._place(torch.where(stuck[:, None], here, xy))
        return (first > 0) | stuck

    def _place(self, xy: Tensor) -> None:
        """Stand on the surface at (E, 2), and on the other layer where the height crosses the threshold."""
        world = self.world
        z = world.surface(self.tile, self.layer, xy)
        up = (z > world.switch[self.tile, self.layer + 1]).long()
        down = (z <= world.switch[self.tile, self.layer]).long()
        layer = self.layer + up - down
        changed = world.node_at(self.tile, layer, xy) >= 0
        self.layer = torch.where(changed, layer, self.layer)
        self.position = torch.cat([xy, z[:, None]], dim=1)
