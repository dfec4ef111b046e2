"""Reduced precision where the processor multiplies it natively."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache

import torch

_FULL = ContextVar("full precision", default=False)


@cache
def multiplies_bfloat16(device: str) -> bool:
    """Whether products in bfloat16 are faster than in float32: on GPUs, and on CPUs with AVX512-BF16 or AMX.

    Elsewhere PyTorch emulates them, four times slower than float32.
    """
    if device != "cpu":
        return True
    can = torch.cpu.get_capabilities()
    return bool(can.get("avx512_bf16") or can.get("amx_bf16") or can.get("bf16"))


def product_dtype(device: torch.device) -> torch.dtype:
    """Type in which dense products are fastest on ``device``: bfloat16 or float32."""
    return torch.bfloat16 if multiplies_bfloat16(device.type) and not _FULL.get() else torch.float32


@contextmanager
def full_precision() -> Iterator[None]:
    """Within it, every product is in float32, as on other machines."""
    before = _FULL.set(True)
    try:
        yield
    finally:
        _FULL.reset(before)


def reduced_precision(device: torch.device, wanted: bool = True) -> torch.autocast:
    """Context in which dense products are of `product_dtype` if ``wanted``, else float32."""
    return torch.autocast(device.type, torch.bfloat16, enabled=wanted and product_dtype(device) is torch.bfloat16)
