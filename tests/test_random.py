from __future__ import annotations

import math

import torch
from scipy import stats

from romnav import random


def test_uniform_passes_a_kolmogorov_smirnov_test() -> None:
    for seed in range(3):
        sample = random.uniform(seed, torch.arange(200)[:, None], torch.arange(200)[None]).flatten()
        assert stats.kstest(sample.numpy(), "uniform").pvalue > 1e-3
        assert 0.0 <= sample.min() <= sample.max() < 1.0


def test_neighbouring_counters_and_seeds_are_uncorrelated() -> None:
    count = 40_000
    steps = torch.arange(count)
    base = random.uniform(7, 3, steps)
    for other in (random.uniform(7, 4, steps), random.uniform(8, 3, steps), random.uniform(7, 3, steps + 1)):
        correlation = torch.corrcoef(torch.stack([base, other]))[0, 1].abs().item()
        assert correlation < 4 / math.sqrt(count)


def test_normal_is_normal() -> None:
    assert stats.kstest(random.normal(1, torch.arange(40_000)).numpy(), "norm").pvalue > 1e-3


def test_integers_are_even_and_within_range() -> None:
    counts = random.integers(7, 1, torch.arange(70_000)).bincount(minlength=7)
    assert len(counts) == 7
    assert stats.chisquare(counts.numpy()).pvalue > 1e-3


def test_a_number_depends_on_its_counters_alone() -> None:
    whole = random.uniform(5, torch.arange(100), 9)
    assert torch.equal(random.uniform(5, torch.tensor([42, 7]), 9), whole[[42, 7]])
