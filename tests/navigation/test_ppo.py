"""Averages of weights."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from romnav.navigation.ppo import Average


@settings(max_examples=30, deadline=None)
@given(updates=st.integers(1, 60))
def test_the_average_over_all_updates_is_their_mean(updates: int) -> None:
    drawn = torch.randn(updates, 3, generator=torch.Generator().manual_seed(updates), dtype=torch.float64)
    average = Average(1.0)
    for k, weights in enumerate(drawn):
        average.add({"w": weights, "count": torch.tensor(k)})
    torch.testing.assert_close(average.weights["w"], drawn.mean(0))
    assert int(average.weights["count"]) == updates - 1


@pytest.mark.parametrize("share", [0.05, 0.1, 0.5])
def test_the_average_counts_late_updates_by_a_power(share: float) -> None:
    average = Average(share)
    for k in range(5000):
        average.add({"w": torch.tensor(float(k), dtype=torch.float64)})
    # the mean of a density t ** (1 / share - 1) over [0, 1] is 1 / (1 + share)
    assert float(average.weights["w"]) / 5000 == pytest.approx(1.0 / (1.0 + share), abs=2e-3)
