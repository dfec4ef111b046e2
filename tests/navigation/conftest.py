"""A small world and a stand-in for the sensors."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from romnav.navigation.spec import EnvSpec, NavigationSpec, PolicySpec, PPOSpec
from romnav.world.spec import WorldSpec
from romnav.world.world import World, build

TOKENS = (4, 8)


class FakeEncoder:
    """Names itself as an encoder does."""

    def digest(self) -> str:
        return "fake"


class FakePerception:
    """Tokens that are a smooth function of pose and counters, in place of LiDAR and encoder."""

    encoder = FakeEncoder()

    def __call__(self, tile: Tensor, position: Tensor, yaw: Tensor, counters: Tensor) -> Tensor:
        phase = torch.arange(TOKENS[0] * TOKENS[1]) * 0.37
        sums = position.sum(dim=1) + yaw + tile + counters[:, 0] + 0.1 * counters[:, 1]
        return torch.sin(sums[:, None] + phase).view(-1, *TOKENS).to(torch.bfloat16)


@pytest.fixture(scope="session")
def world() -> World:
    return build(WorldSpec(tiles=4, seed=5, goals_per_tile=12))


@pytest.fixture
def perception() -> FakePerception:
    return FakePerception()


@pytest.fixture
def spec() -> NavigationSpec:
    return NavigationSpec(
        env=EnvSpec(envs=12, duration=4.0, stay=1.0),
        policy=PolicySpec(attention=16, heads=2, queries=2, recurrent=16, hidden=16, critic=(16,)),
        ppo=PPOSpec(iterations=4, steps=6, epochs=2, minibatches=3),
    )
