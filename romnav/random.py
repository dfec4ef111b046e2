"""Counter-based random numbers: a pure function of a seed and counters, the same on every device and thread count."""

from __future__ import annotations

import torch
from torch import Tensor

_MASK = 0xFFFFFFFF


def _mix(x: Tensor) -> Tensor:
    """One round of the 32-bit finaliser "lowbias32" (C. Wellons' hash prospector), on int64 tensors below 2**32."""
    x = x ^ (x >> 16)
    x = (x * 0x7FEB352D) & _MASK
    x = x ^ (x >> 15)
    x = (x * 0x846CA68B) & _MASK
    return x ^ (x >> 16)


def bits(seed: int, *counters: Tensor | int) -> Tensor:
    """32 random bits as int64 for each element of the broadcast ``counters`` (integers, taken modulo 2**32)."""
    h = _mix(torch.tensor((seed ^ 0x9E3779B9) & _MASK))
    for k, counter in enumerate(counters):
        c = torch.as_tensor(counter).to(torch.int64) & _MASK
        h = _mix((h.to(c.device) + c * 0x9E3779B1 + k + 1) & _MASK)
    return h


def uniform(seed: int, *counters: Tensor | int) -> Tensor:
    """Uniform float32 in [0, 1) for each element of the broadcast ``counters``; one counter may name the draw."""
    return (bits(seed, *counters) >> 8).to(torch.float32) * (1.0 / (1 << 24))


def normal(seed: int, *counters: Tensor | int) -> Tensor:
    """Standard normal float32 for each element of the broadcast ``counters`` (Box-Muller on two draws)."""
    radius = torch.sqrt(-2.0 * torch.log1p(-uniform(seed, *counters, 1)))
    return radius * torch.cos(2.0 * torch.pi * uniform(seed, *counters, 2))


def integers(high: Tensor | int, seed: int, *counters: Tensor | int) -> Tensor:
    """Uniform int64 in [0, high), elementwise; ``high`` up to 2**31."""
    return (bits(seed, *counters) * torch.as_tensor(high).to(torch.int64)) >> 32
