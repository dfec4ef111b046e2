"""Softmax attention among few tokens: a kernel that keeps one sample's heads in the registers.

Library kernels are made for long sequences; among ten tokens of eight channels they spend their time on packing.
"""
# ruff: noqa: UP018 - in Warp, float() declares a variable that changes in a loop

from __future__ import annotations

from functools import cache
from typing import Any

import torch
from torch import Tensor

from romnav.kernels import over_threads, wp

wp.set_module_options(
    {"enable_backward": False, "optimization_level": 3, "cpu_compiler_flags": "-march=native -ffast-math -w"}
)


@wp.kernel
def _forward(
    scale: float,
    share: wp.array4d(dtype=float),
    query: wp.array3d(dtype=Any),
    key: wp.array3d(dtype=Any),
    value: wp.array3d(dtype=Any),
    out: wp.array3d(dtype=Any),
):
    b, h = wp.tid()
    for i in range(query.shape[1]):
        q = query[b, i, h] * scale
        top = float(-1.0e30)
        for j in range(key.shape[1]):
            score = wp.dot(q, key[b, j, h])
            share[b, h, i, j] = score
            top = wp.max(top, score)
        total = float(0.0)
        mix = q * 0.0
        for j in range(key.shape[1]):
            weight = wp.exp(share[b, h, i, j] - top)
            share[b, h, i, j] = weight
            total += weight
            mix += weight * value[b, j, h]
        for j in range(key.shape[1]):
            share[b, h, i, j] = share[b, h, i, j] / total
        out[b, i, h] = mix / total


@wp.kernel
def _backward(
    scale: float,
    share: wp.array4d(dtype=float),
    query: wp.array3d(dtype=Any),
    key: wp.array3d(dtype=Any),
    value: wp.array3d(dtype=Any),
    out: wp.array3d(dtype=Any),
    grad: wp.array3d(dtype=Any),
    d_query: wp.array3d(dtype=Any),
    d_key: wp.array3d(dtype=Any),
    d_value: wp.array3d(dtype=Any),
):
    b, h = wp.tid()
    for i in range(query.shape[1]):
        q = query[b, i, h] * scale
        g = grad[b, i, h]
        mean = wp.dot(g, out[b, i, h])
        d_q = q * 0.0
        for j in range(key.shape[1]):
            weight = share[b, h, i, j]
            d_score = weight * (wp.dot(g, value[b, j, h]) - mean)
            d_q += d_score * key[b, j, h]
            d_key[b, j, h] = d_key[b, j, h] + d_score * q
            d_value[b, j, h] = d_value[b, j, h] + weight * g
        d_query[b, i, h] = d_q * scale


@cache
def _for_width(kernel: Any, vectors: int, kind: Any, device: str) -> Any:
    """The kernel for vectors of one kind, compiled and loaded: two threads must not do that at once."""
    concrete = wp.overload(kernel, [float, wp.array4d(dtype=float), *[wp.array3d(dtype=kind)] * vectors])
    wp.load_module(device=device)
    return concrete


def _launch(kernel: Any, share: Tensor, *vectors: Tensor) -> None:
    """Run ``kernel`` on shares (B, heads, I, J) and tensors (B, tokens, heads, D), split over the threads on a CPU."""
    batch, heads = share.shape[:2]
    width = vectors[0].shape[3]
    device = str(share.device)
    kind = wp.types.vector(length=width, dtype=float)
    of_width = _for_width(kernel, len(vectors), kind, device)

    def run(part: slice) -> None:
        arrays = [wp.from_torch(x[part], dtype=kind, requires_grad=False) for x in vectors]
        inputs = [width**-0.5, wp.from_torch(share[part]), *arrays]
        stream = wp.stream_from_torch(share.device) if share.is_cuda else None
        wp.launch(of_width, (part.stop - part.start, heads), inputs, device=device, stream=stream)

    over_threads(run, batch, device)


class Attend(torch.autograd.Function):
    """Multi-head attention of queries (B, I, H, D) over tokens, float32.

    ``packed`` (B, J, 2, H, D) holds keys and values; without ``query`` it is (B, J, 3, H, D) and holds the queries
    as well. Returns (B, I, H, D).
    """

    @staticmethod
    def forward(ctx: Any, packed: Tensor, query: Tensor | None) -> Tensor:
        """Attend; equal to `torch.nn.functional.scaled_dot_product_attention`."""
        q, k, v = packed.unbind(2) if query is None else (query, *packed.unbind(2))
        out = torch.empty_like(q, memory_format=torch.contiguous_format)
        share = q.new_empty(len(q), q.shape[2], q.shape[1], k.shape[1])
        _launch(_forward, share, q, k, v, out)
        ctx.save_for_backward(packed, query, share, out)
        return out

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor | None]:
        """Gradients with respect to ``packed`` and ``query``."""
        packed, query, share, out = ctx.saved_tensors
        d_packed = torch.zeros_like(packed)
        if query is None:
            inputs, d_query, gradients = packed.unbind(2), None, d_packed.unbind(2)
        else:
            d_query = torch.empty_like(query)
            inputs, gradients = (query, *packed.unbind(2)), (d_query, *d_packed.unbind(2))
        _launch(_backward, share, *inputs, out, grad.contiguous(), *gradients)
        return d_packed, d_query
