from __future__ import annotations

import json
from pathlib import Path

import onnx
import onnxruntime
import pytest
import torch

from romnav.deploy import export as module
from romnav.deploy.card import Card
from romnav.deploy.export import TOLERANCE, export
from romnav.errors import RomnavError
from romnav.navigation.policy import NavigationActor
from tests.deploy.conftest import DEPTH, FELT, actor, card, encoders, humanoids


def told(file: Path) -> Card:
    props = {p.key: p.value for p in onnx.load(file).metadata_props}
    assert json.loads(props["romnav"])["command"]["lateral"] == 0.25
    return Card.model_validate_json(props["romnav"])


def test_a_humanoids_policy_is_that_of_pytorch(exported: Path) -> None:
    """With depth, proprioception and an encoder of its own: `export` held it against PyTorch."""
    card = told(exported)
    assert card.error is not None
    assert 0.0 < card.error <= TOLERANCE
    assert card.measured is not None
    assert card.measured.metrics == {"sr_45": 60.3, "t2g": None}
    inputs = onnx.load(exported).graph.input
    shapes = {i.name: [d.dim_value for d in i.type.tensor_type.shape.dim] for i in inputs}
    assert shapes == {"lidar": [1, 15, 55], "depth": [1, 26, 30], "state": [1, 16], "memory": [2, 1, 16]}


@pytest.mark.slow
def test_a_policy_of_the_reduced_order_model_is_that_of_pytorch(tmp_path: Path) -> None:
    """Over 1,000 steps."""
    assert module.STEPS == 1000
    lidar, _ = encoders()
    card_ = card()
    assert export(actor(lidar), lidar, None, card_, tmp_path / "p.onnx", lambda *_: None).error <= TOLERANCE  # type: ignore[operator]
    assert told(tmp_path / "p.onnx").inputs.keys() == {"lidar", "state", "memory"}


class Forgetful(NavigationActor):
    """Another network than the one that was exported: it forgets everything at once."""

    def forward(self, *args: object, **settings: object) -> torch.Tensor:
        self.reset()
        return super().forward(*args, **settings)


@pytest.mark.parametrize(("kind", "same"), [(NavigationActor, True), (Forgetful, False)])
def test_the_check_tells_another_network(
    exported: Path, monkeypatch: pytest.MonkeyPatch, kind: type, same: bool
) -> None:
    monkeypatch.setattr(module, "STEPS", 8)
    policy, lidar, depth = humanoids()
    policy.__class__ = kind
    session = onnxruntime.InferenceSession(exported)
    of = card(depth=DEPTH, proprioception=FELT)
    assert (module._error(session, policy, lidar, depth, of, lambda *_: None) <= TOLERANCE) == same


def test_what_computes_something_else_is_not_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lidar, _ = encoders()
    monkeypatch.setattr(module, "_convert", lambda *_: onnx.ModelProto())
    monkeypatch.setattr(onnxruntime, "InferenceSession", lambda *_, **__: None)
    monkeypatch.setattr(module, "_error", lambda *_: float("nan"))
    with pytest.raises(RomnavError, match=r"test: ONNX differs from PyTorch by nan, which is more than 1e-05"):
        export(actor(lidar), lidar, None, card(), tmp_path / "p.onnx", lambda *_: None)
    assert not (tmp_path / "p.onnx").exists()


def test_a_missing_package_is_one_clear_line(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(RomnavError, match=r"nowhere is not installed; run `pip install 'romnav\[deploy\]'`"):
        module.need("nowhere")
