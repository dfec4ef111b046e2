"""A scripted driver, as a bound: straight to the goal, and along the wall where there is one (Bug0)."""

from __future__ import annotations

import torch
from torch import Tensor

from romnav.evaluation.rollout import View
from romnav.evaluation.scripted import straight_direction, walk

FEELERS = (0.25, 0.5)
"""How far ahead it feels for walls, m."""
TURNS = 16
"""Headings that it tries along a wall."""


class WallFollower:
    """Feels occupied cells at an arm's length and remembers the wall at its right hand, nothing else."""

    def __init__(self) -> None:
        self._along = torch.empty(0)
        self._follows = torch.empty(0, dtype=torch.bool)

    def command(self, view: View) -> Tensor:
        """(A, 3) velocity command."""
        straight = straight_direction(view.robot.position, view.goal_position)
        wanted = torch.atan2(straight[:, 1], straight[:, 0])
        if view.step == 0:
            self._along, self._follows = wanted, torch.zeros_like(wanted, dtype=torch.bool)
        free = self._free(view, wanted[:, None])[:, 0]
        self._along = torch.where(self._follows, self._along, wanted)
        self._follows = ~free
        # from the wall at its right hand to the left, until nothing is in the way
        turns = (torch.arange(TURNS, device=wanted.device) - TURNS // 4) * (2 * torch.pi / TURNS)
        headings = self._along[:, None] + turns
        first = self._free(view, headings).int().argmax(dim=1)
        heading = torch.where(free, wanted, headings.gather(1, first[:, None])[:, 0])
        self._along = heading
        direction = torch.stack([heading.cos(), heading.sin()], dim=1)
        distance = torch.linalg.vector_norm((view.goal_position - view.robot.position)[:, :2], dim=1)
        ahead = torch.where(free, distance, FEELERS[-1])
        return walk(direction, view.robot.yaw, ahead, view.env.command, view.env.period)

    def select(self, keep: Tensor) -> None:
        """Drop the memory of all but the rows ``keep``."""
        self._along, self._follows = self._along[keep], self._follows[keep]

    def _free(self, view: View, heading: Tensor) -> Tensor:
        """(A, K) whether nothing is felt in the directions ``heading`` (A, K), rad in the tile frame."""
        robot, (rows, count) = view.robot, heading.shape
        reach = torch.tensor(FEELERS, device=heading.device)
        offset = torch.stack([heading.cos(), heading.sin()], dim=2)[:, :, None] * reach[:, None]
        points = robot.position[:, None, None, :2] + offset
        tile, layer = (x.repeat_interleave(count * len(reach)) for x in (robot.tile, robot.layer))
        return (view.world.node_at(tile, layer, points.reshape(-1, 2)) >= 0).view(rows, count, -1).all(dim=2)
