"""Spawn and goal sampling (paper, Sec. III-D): stair oversampling, geodesic cap, cross-level goals."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from romnav import random
from romnav.world.geodesic import UNIT
from romnav.world.spec import SamplerSpec
from romnav.world.world import LEVEL_GAP, World

_SPAWN_KIND, _SPAWN, _YAW, _GOAL, _GOAL_YAW, _CROSS, _OFFSET_X, _OFFSET_Y = range(8)


@dataclass(frozen=True)
class Start:
    """Initial conditions of ``E`` episodes, tile frame, metres and radians."""

    tile: Tensor
    """(E,) int64."""
    layer: Tensor
    """(E,) int64."""
    xy: Tensor
    """(E, 2) float32."""
    yaw: Tensor
    """(E,) float32."""
    goal: Tensor
    """(E,) int64 goal index of the world."""
    goal_yaw: Tensor
    """(E,) float32."""


def is_cross_level(spawn_z: Tensor, goal_z: Tensor) -> Tensor:
    """Whether start and goal lie on different levels."""
    return (spawn_z - goal_z).abs() > LEVEL_GAP


def sample(world: World, spec: SamplerSpec, seed: int, tile: Tensor, env: Tensor, episode: Tensor) -> Start:
    """Draw one spawn and goal for each of ``tile`` (E,), as a function of (seed, env, episode) alone.

    A goal is masked where it is nearer than ``min_distance`` or beyond the cap; of the rest one is drawn uniformly,
    from the other levels always on three-story tiles and half of the time elsewhere. Where no goal of another level
    qualifies, the spawn's own level serves, and where none qualifies at all, the nearest goal.
    """

    def u(draw: int) -> Tensor:
        return random.uniform(seed, env, episode, draw)

    start, end = world.node_start[tile], world.node_start[tile + 1]
    spawn = start + ((end - start) * u(_SPAWN)).long()
    low, high = world.spawn_start[tile], world.spawn_start[tile + 1]
    on_stair = (u(_SPAWN_KIND) < spec.stair_probability) & (high > low)
    candidates = torch.cat([world.spawn, start[:1]])  # one beyond, where the last tiles, or all, have no stair
    picked = low + ((high - low) * u(_SPAWN)).long()
    spawn = torch.where(on_stair, candidates[picked], spawn)
    goal = _draw_goal(world, spec, tile, spawn, u(_CROSS), u(_GOAL))
    inside = torch.stack([u(_OFFSET_X), u(_OFFSET_Y)], dim=1) - 0.5
    return Start(
        tile=tile,
        layer=world.layer[spawn],
        xy=world.position[spawn, :2] + 0.98 * world.cell * inside,
        yaw=2.0 * torch.pi * u(_YAW),
        goal=goal,
        goal_yaw=2.0 * torch.pi * u(_GOAL_YAW),
    )


def _draw_goal(
    world: World, spec: SamplerSpec, tile: Tensor, spawn: Tensor, cross_draw: Tensor, goal_draw: Tensor
) -> Tensor:
    first, last = world.goal_start[tile], world.goal_start[tile + 1]
    slot = torch.arange(int((last - first).max()), device=tile.device)
    goals = (first[:, None] + slot).clamp(max=len(world.goal) - 1)
    exists = slot < (last - first)[:, None]
    offset = (spawn - world.node_start[tile])[:, None]
    geodesic = world.fields[world.field_start[goals] + offset * exists].to(torch.float32) * UNIT
    target, source = world.position[world.goal[goals]], world.position[spawn]
    straight = torch.linalg.vector_norm(target - source[:, None], dim=2)
    capped = geodesic if spec.cap == "geodesic" else straight
    valid = exists & (capped <= spec.max_distance) & (geodesic >= spec.min_distance)
    other = valid & is_cross_level(source[:, None, 2], target[..., 2])
    wanted = torch.where(world.storeys[tile] >= 3, 1.0, spec.cross_probability)
    cross = (cross_draw < wanted) & other.any(dim=1)
    same = valid & ~other
    choice = torch.where(cross[:, None], other, torch.where(same.any(dim=1)[:, None], same, valid))
    count = choice.sum(dim=1)
    rank = (goal_draw * count).long() + 1
    drawn = ((choice.cumsum(dim=1) == rank[:, None]) & choice).int().argmax(dim=1)
    nearest = torch.where(exists, geodesic, torch.inf).argmin(dim=1)
    return first + torch.where(count > 0, drawn, nearest)
