"""Export of a policy to one ONNX file, held against PyTorch before it is written."""

from __future__ import annotations

import logging
import warnings
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from romnav import files
from romnav.deploy import card as cards
from romnav.deploy.card import Card
from romnav.deploy.network import PortablePolicy
from romnav.errors import RomnavError
from romnav.navigation.env import to_command
from romnav.navigation.policy import NavigationActor
from romnav.precision import full_precision
from romnav.progress import Progress
from romnav.sensing.encoder import Encoder

STEPS = 1000
"""Steps of the check, with one memory through all of them."""
TOLERANCE = 1e-5
"""Largest difference of a command from PyTorch's, m/s or rad/s."""


def export(
    actor: NavigationActor, lidar: Encoder, depth: Encoder | None, card: Card, path: Path, progress: Progress
) -> Card:
    """Write a policy with its encoders and ``card`` to the ONNX file ``path``; returns the card with the check's error.

    Args:
        actor: The policy, on the CPU.
        lidar: Encoder of its range images.
        depth: Encoder of its depth images, if it sees any.
        card: What a robot has to know of it.
        path: File to write.
        progress: Told how far the check is.

    Raises:
        RomnavError: ONNX is not installed; the network has no ONNX form, or computes something else in it.
    """
    onnx, onnxruntime = need("onnx"), need("onnxruntime")
    need("onnxscript")
    inputs = _inputs(actor, lidar, depth, torch.Generator().manual_seed(0))
    inputs["memory"] = torch.zeros(card.memory)
    model = _convert(PortablePolicy(actor, lidar, depth, card.command).eval(), inputs, card.arm)
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    error = _error(session, actor, lidar, depth, card, progress)
    if not error <= TOLERANCE:
        raise RomnavError(f"{card.arm}: ONNX differs from PyTorch by {error:.1e}, which is more than {TOLERANCE:.0e}")
    card = card.model_copy(update={"error": error})
    onnx.helper.set_model_props(model, {cards.KEY: card.model_dump_json()})
    files.write(path, model.SerializeToString())
    return card


def need(package: str) -> Any:
    """A package that only this part of romnav needs.

    Raises:
        RomnavError: It is not installed.
    """
    from importlib import import_module

    try:
        return import_module(package)
    except ImportError as error:
        raise RomnavError(f"{package} is not installed; run `pip install 'romnav[deploy]'`") from error


def _convert(policy: PortablePolicy, inputs: dict[str, Tensor], name: str) -> Any:
    told = logging.getLogger("torch.onnx")
    before = told.level
    told.setLevel(logging.ERROR)  # it tells of packages that it could do with
    try:
        with torch.no_grad(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            program = torch.onnx.export(
                policy,
                kwargs=inputs,
                input_names=list(inputs),
                output_names=list(cards.OUTPUTS),
                dynamo=True,
                verbose=False,
            )
    except torch.onnx.OnnxExporterError as error:
        raise RomnavError(f"{name}: its network has no ONNX form ({str(error).strip().splitlines()[0]})") from error
    finally:
        told.setLevel(before)
    assert program is not None
    return program.model_proto


def _inputs(
    actor: NavigationActor, lidar: Encoder, depth: Encoder | None, generator: torch.Generator
) -> dict[str, Tensor]:
    """Random images, some pixels without a return, and a random state."""
    encoders = {"lidar": actor.encoder or lidar} | ({"depth": depth} if depth is not None else {})
    seen = {}
    for sensor, encoder in encoders.items():
        ranges = encoder.spec.scale * torch.randn(1, *encoder.image_shape, generator=generator)
        seen[sensor] = ranges.clamp(min=0.0)
    scale = torch.ones(actor.obs_dim)
    scale[:2] = 10.0
    return seen | {"state": scale * torch.randn(1, actor.obs_dim, generator=generator)}


@torch.inference_mode()
def _error(
    session: Any, actor: NavigationActor, lidar: Encoder, depth: Encoder | None, card: Card, progress: Progress
) -> float:
    """Largest difference of the commands of one robot over `STEPS`."""
    generator = torch.Generator().manual_seed(1)
    memory = torch.zeros(card.memory).numpy()
    actor.reset()
    worst = 0.0
    with full_precision():
        for step in range(STEPS):
            inputs = _inputs(actor, lidar, depth, generator)
            fed = {name: value.numpy() for name, value in inputs.items()}
            command, memory = session.run(list(cards.OUTPUTS), fed | {"memory": memory})
            seen = {"state": inputs["state"], "lidar": inputs["lidar"]}
            if actor.encoder is None:
                seen["lidar"] = lidar.tokens(inputs["lidar"])
            if depth is not None:
                seen["depth"] = depth.tokens(inputs["depth"])
            expected = to_command(actor(TensorDict(seen, batch_size=[1])), card.command)
            worst = max(worst, float((torch.from_numpy(command) - expected).abs().max()))
            if step % 100 == 99:
                progress(step + 1, STEPS, f"differs by {worst:.0e}")
    actor.reset()
    return worst
