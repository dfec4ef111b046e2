"""Policies that were never trained, one of them exported."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

from romnav.deploy import export as exporting
from romnav.deploy.card import INPUTS, Card, Measured
from romnav.deploy.export import export
from romnav.navigation.policy import NavigationActor
from romnav.navigation.ppo import make_actor
from romnav.navigation.spec import CommandSpec, PolicySpec
from romnav.sensing.encoder import Encoder, untrained
from romnav.sensing.image import directions
from romnav.sensing.spec import DepthEncoderSpec, DepthSpec, EncoderSpec, LidarSpec

LIDAR = LidarSpec(rows=15, columns=55)
DEPTH = DepthSpec()
FELT = 7


def card(**changes: object) -> Card:
    return Card(
        **{
            "arm": "test",
            "seed": 0,
            "scale": "smoke",
            "steps": 0,
            "checkpoint": "f00d",
            "commit": "unknown",
            "period": 0.2,
            "command": CommandSpec(),
            "max_goal_distance": 30.0,
            "lidar": LIDAR,
            "depth": None,
            "proprioception": 0,
            "memory": (2, 1, 16),
            "inputs": {name: told for name, told in INPUTS.items() if name != "depth"},
            **changes,
        }
    )


def encoders() -> tuple[Encoder, Encoder]:
    lidar = untrained(EncoderSpec(widths=(8, 8), strides=((4, 4), (2, 4)), latent=8), directions(LIDAR), 0).encoder
    spec = DepthEncoderSpec(widths=(4, 4), strides=((4, 4), (4, 4)), latent=4)
    return lidar, untrained(spec, torch.zeros(DEPTH.rows, DEPTH.columns, 3), 1).encoder


def actor(lidar: Encoder, depth: Encoder | None = None, state: int = 9) -> NavigationActor:
    torch.manual_seed(0)
    seen = {"lidar": torch.zeros(1, *lidar.token_shape), "state": torch.zeros(1, state)}
    if depth is not None:
        seen["depth"] = torch.zeros(1, *depth.token_shape)
    spec = PolicySpec(attention=16, heads=2, queries=2, recurrent=16, hidden=16)
    made = make_actor(TensorDict(seen, batch_size=[1]), spec, guided=True)
    with torch.no_grad():  # an untrained head is all but constant
        made.mlp[2].weight.normal_()
    return made.eval()


def humanoids() -> tuple[NavigationActor, Encoder, Encoder]:
    """A policy with an encoder of its own, the pretrained one, and that of its depth images."""
    lidar, depth = encoders()
    policy = actor(lidar, depth, 9 + FELT)
    policy.encoder = encoders()[0]
    with torch.no_grad():
        policy.encoder.mean.weight += 0.1
    return policy, lidar, depth


@pytest.fixture(scope="session")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A policy of the humanoid."""
    path = tmp_path_factory.mktemp("deploy") / "policy.onnx"
    measured = Measured(episode_set="paired-2", digest="feed", metrics={"sr_45": 60.3, "t2g": None})
    told = card(depth=DEPTH, proprioception=FELT, measured=measured, inputs=INPUTS)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(exporting, "STEPS", 200)  # all of them in a slow test
        export(*humanoids(), told, path, lambda *_: None)
    return path
