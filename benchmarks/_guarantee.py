"""The safety filter's guarantee in random worlds: a single integrator that obeys it touches nothing."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from romnav.safety.filter import SafetyFilter
from romnav.safety.spec import OccupancySpec, SafetySpec

SPEC = SafetySpec(occupancy=OccupancySpec(size=4.0))
WORLDS = 200
"""Of a batch, one robot in each."""
STEPS = 25
POLES = 16
HEIGHTS = np.linspace(0.35, 1.2, 3)
BETWEEN = np.linspace(0.0, 1.0, 9)
"""Instants of a step at which the distance is measured."""


def batch(seed: int, workers: int) -> tuple[float, float]:
    """Drives robots ahead among poles and walls in worlds of their own.

    A third of the obstacles is in rows, as walls with gaps. The grid sees them anew in every step, from where the robot
    is and however it has turned meanwhile.

    Returns:
        The least clearance of any robot at any instant, m, negative where one collided, and the mean way of a robot, m.
    """
    luck = np.random.default_rng([0xFA17, seed])
    poles = _obstacles(luck)
    safe = SafetyFilter(WORLDS, SPEC, workers=workers)
    position, yaw = np.zeros((WORLDS, 2)), luck.uniform(-np.pi, np.pi, WORLDS)
    closest, way = np.inf, 0.0
    for _ in range(STEPS):
        wish = torch.from_numpy(np.stack([np.ones(WORLDS), luck.uniform(-0.25, 0.25, WORLDS)], 1)).float()
        velocity = safe(_points(poles, position, yaw), wish).velocity.double().numpy()
        step = SPEC.filter.period * _turn(velocity, yaw)
        for share in BETWEEN:
            distance = np.linalg.norm(poles - (position + share * step)[:, None], axis=2)
            closest = min(closest, float(distance.min()) - SPEC.occupancy.radius)
        position = position + step
        way += float(np.linalg.norm(step, axis=1).mean())
        yaw = yaw + luck.uniform(-0.2, 0.2, WORLDS)
    return closest, way


def _obstacles(luck: np.random.Generator) -> NDArray[np.float64]:
    """(worlds, K, 2) thin poles, none of them within 0.6 m of the start."""
    single = luck.uniform(-3.5, 3.5, (WORLDS, POLES, 2))
    angle = luck.uniform(-np.pi, np.pi, (WORLDS, 1))
    along = np.linspace(-1.0, 1.0, POLES)[None] * luck.uniform(0.5, 2.5, (WORLDS, 1))
    away = luck.uniform(0.8, 2.5, (WORLDS, 1))
    c, s = np.cos(angle), np.sin(angle)
    row = np.stack([away * c - along * s, away * s + along * c], 2)
    poles = np.concatenate([single, row], 1)
    poles[np.linalg.norm(poles, axis=2) < 0.6] = 50.0
    return poles


def _points(poles: NDArray, position: NDArray, yaw: NDArray) -> torch.Tensor:
    """(worlds, N, 3) returns from the poles at some heights and from the floor, in the robots' frames."""
    local = _turn_all(poles - position[:, None], -yaw)
    posts = np.repeat(local, len(HEIGHTS), 1)
    z = np.tile(HEIGHTS, local.shape[1])[None, :, None].repeat(WORLDS, 0)
    x = np.linspace(-2.0, 2.0, 9)
    floor = np.stack([*(g.ravel() for g in np.meshgrid(x, x)), np.zeros(81)], 1)
    cloud = np.concatenate([np.concatenate([posts, z], 2), np.broadcast_to(floor, (WORLDS, 81, 3))], 1)
    return torch.from_numpy(cloud).float()


def _turn(v: NDArray, yaw: NDArray) -> NDArray:
    c, s = np.cos(yaw), np.sin(yaw)
    return np.stack([c * v[:, 0] - s * v[:, 1], s * v[:, 0] + c * v[:, 1]], 1)


def _turn_all(v: NDArray, yaw: NDArray) -> NDArray:
    c, s = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    return np.stack([c * v[..., 0] - s * v[..., 1], s * v[..., 0] + c * v[..., 1]], -1)
