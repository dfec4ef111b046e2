"""A small world and a stand-in for the sensors."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from romnav.navigation.spec import EnvSpec, NavigationSpec, PolicySpec, PPOSpec
from romnav.robot.dynamics import Dynamics
from romnav.sensing.encoder import Encoder, untrained
from romnav.sensing.spec import EncoderSpec
from romnav.world.build import build
from romnav.world.spec import WorldSpec
from romnav.world.world import World

TOKENS = (4, 8)


def fake_encoder(latent: int = TOKENS[1]) -> Encoder:
    """Random weights on images of 4 x 8 pixels."""
    directions = torch.nn.functional.normalize(torch.linspace(-1, 1, 96).sin().view(4, 8, 3) + 0.1, dim=2)
    spec = EncoderSpec(widths=(8,), strides=((2, 4),), latent=latent)
    return untrained(spec, directions, 0).encoder.requires_grad_(False)


class FakePerception:
    """Images that are a smooth function of pose and counters, in place of the LiDAR's."""

    def __init__(self) -> None:
        self.encoder = fake_encoder()
        self.depth = None
        self.images = False

    def __call__(self, robot: Dynamics, counters: Tensor) -> dict[str, Tensor]:
        phase = torch.arange(32) * 0.37
        sums = robot.position.sum(dim=1) + robot.yaw + robot.tile + counters[:, 0] + 0.1 * counters[:, 1]
        ranges = 2.5 + 2.0 * torch.sin(sums[:, None] + phase).view(-1, 4, 8)
        return {"lidar": ranges.half() if self.images else self.encoder.tokens(ranges).to(torch.bfloat16)}


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
