from __future__ import annotations

import pytest
import torch

from romnav import precision
from romnav.precision import product_dtype, reduced_precision
from romnav.sensing.encoder import Autoencoder
from romnav.sensing.spec import EncoderSpec

CPU = torch.device("cpu")


@pytest.mark.parametrize(("native", "dtype"), [(True, torch.bfloat16), (False, torch.float32)])
def test_products_are_of_the_native_type(monkeypatch: pytest.MonkeyPatch, native: bool, dtype: torch.dtype) -> None:
    monkeypatch.setattr(precision, "multiplies_bfloat16", lambda device: native)
    layer = torch.nn.Linear(3, 3)
    assert product_dtype(CPU) is dtype
    with reduced_precision(CPU):
        assert layer(torch.ones(2, 3)).dtype is dtype
    with reduced_precision(CPU, wanted=False):
        assert layer(torch.ones(2, 3)).dtype is torch.float32


def test_tokens_agree_in_both_types(monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(16, 16, 3), dim=2)
    encoder = Autoencoder(EncoderSpec(), directions).encoder
    ranges = 10.0 * torch.rand(8, 16, 16)
    tokens = []
    for native in (True, False):
        monkeypatch.setattr(precision, "multiplies_bfloat16", lambda device, native=native: native)
        tokens.append(encoder.tokens(ranges))
    torch.testing.assert_close(tokens[0], tokens[1], rtol=0.05, atol=0.02)


def test_this_processor_is_asked() -> None:
    can = torch.cpu.get_capabilities()
    assert precision.multiplies_bfloat16("cpu") == any(can.get(k) for k in ("avx512_bf16", "amx_bf16", "bf16"))
    assert precision.multiplies_bfloat16("cuda")
