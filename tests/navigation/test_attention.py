from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.nn import functional as F

from romnav.navigation.attention import Attend


def reference(query: Tensor, key: Tensor, value: Tensor) -> Tensor:
    heads = (x.transpose(1, 2) for x in (query, key, value))
    return F.scaled_dot_product_attention(*heads).transpose(1, 2)


def assert_equal(inputs: list[Tensor], ours: Tensor, expected: Tensor) -> None:
    """Values and gradients."""
    torch.testing.assert_close(ours, expected, atol=1e-5, rtol=1e-5)
    grad = torch.randn_like(ours)
    pairs = zip(torch.autograd.grad(ours, inputs, grad), torch.autograd.grad(expected, inputs, grad), strict=True)
    for a, b in pairs:
        torch.testing.assert_close(a, b, atol=1e-4, rtol=1e-4)


@settings(max_examples=25, deadline=None)
@given(
    batch=st.integers(1, 9),
    queries=st.integers(1, 6),
    tokens=st.integers(1, 15),
    heads=st.integers(1, 5),
    size=st.sampled_from([0.1, 1.0, 3.0]),
    seed=st.integers(0, 99),
)
def test_equals_torch(batch: int, queries: int, tokens: int, heads: int, size: float, seed: int) -> None:
    torch.manual_seed(seed)
    packed = (size * torch.randn(batch, tokens, 3, heads, 8)).requires_grad_()
    assert_equal([packed], Attend.apply(packed, None), reference(*packed.unbind(2)))
    pairs = (size * torch.randn(batch, tokens, 2, heads, 8)).requires_grad_()
    query = torch.randn(batch, queries, heads, 8, requires_grad=True)
    assert_equal([pairs, query], Attend.apply(pairs, query), reference(query, *pairs.unbind(2)))


@pytest.mark.parametrize("scores", [1e4, -1e4])
def test_large_scores_do_not_overflow(scores: float) -> None:
    packed = torch.ones(2, 3, 3, 1, 8)
    packed[:, :, 0] *= scores
    packed[:, 1, 1] *= 2.0
    torch.testing.assert_close(Attend.apply(packed, None), reference(*packed.unbind(2)))


def test_independent_of_threads() -> None:
    packed = torch.randn(33, 8, 3, 4, 8)
    before = torch.get_num_threads()
    try:
        results = []
        for threads in (1, 2, 5):
            torch.set_num_threads(threads)
            results.append(Attend.apply(packed, None))
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(results[0], other) for other in results[1:])
