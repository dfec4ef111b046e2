"""Corruption: a pure function of (seed, environment, step) with the statistics it promises."""

from __future__ import annotations

import pytest
import torch

from romnav import random
from romnav.sensing.corruption import Corruption
from romnav.sensing.spec import CorruptionSpec

CLEAN = torch.full((64, 15, 55), 4.0)
ENV = torch.arange(64)
STEP = torch.full((64,), 7)
NOTHING = CorruptionSpec(noise=(0.0, 0.0, 0.0), dropout=(0.0, 0.0), occlusion=())


def spec(**changes: object) -> CorruptionSpec:
    return CorruptionSpec(**{**dict(NOTHING), **changes})


def test_nothing_is_the_identity() -> None:
    ranges = CLEAN.clone()
    ranges[:, 3] = 0.0
    torch.testing.assert_close(Corruption(NOTHING, 1)(ranges, ENV, STEP), ranges)


def test_noise_grows_with_range_as_specified() -> None:
    corrupt = Corruption(spec(noise=(0.02, 0.001, 0.003)), 1)
    for r in (1.0, 3.0, 10.0):
        error = corrupt(torch.full_like(CLEAN, r), ENV, STEP) - r
        expected = 0.02 + 0.001 * r + 0.003 * r * r
        assert abs(error.mean()) < 5 * expected / error.numel() ** 0.5
        assert error.std() == pytest.approx(expected, rel=0.02)
        neighbours = (error[:, :, 1:] * error[:, :, :-1]).mean() / expected**2
        assert abs(neighbours) < 0.03


def test_each_image_draws_its_own_share_of_lost_pixels() -> None:
    many = torch.full((2048, 15, 55), 4.0)
    env = torch.arange(2048)
    lost = (Corruption(spec(dropout=(0.0, 0.8)), 1)(many, env, env) == 0).float().mean((1, 2))
    assert lost.mean() == pytest.approx(0.4, abs=0.02)
    quantiles = torch.quantile(lost, torch.tensor([0.25, 0.75]))
    torch.testing.assert_close(quantiles, torch.tensor([0.2, 0.6]), atol=0.03, rtol=0.0)


def test_share_and_pixels_follow_the_packages_random_numbers() -> None:
    out = Corruption(spec(dropout=(0.1, 0.5)), 3)(CLEAN, ENV, STEP)
    share = 0.1 + 0.4 * random.uniform(3, ENV, STEP, 0)
    lost = (random.bits(3, ENV[:, None], STEP[:, None], torch.arange(1, 826)) >> 20) < (share * 4096 + 0.5).long()[
        :, None
    ]
    assert torch.equal(out.flatten(1) == 0, lost)


def test_the_head_belongs_to_the_environment_not_to_the_step() -> None:
    corrupt = Corruption(spec(occlusion=((0.2, 0.4, 0.3, 0.9),), occlusion_jitter=0.05), 1)
    now, later = corrupt(CLEAN, ENV, STEP), corrupt(CLEAN, ENV, STEP + 1)
    assert torch.equal(now, later)
    hidden = now == 0
    assert len({tuple(h.flatten().tolist()) for h in hidden}) > 32
    certain, possible = torch.zeros(15, 55, dtype=torch.bool), torch.zeros(15, 55, dtype=torch.bool)
    certain[6:12, 14:19] = True
    possible[3:15, 7:26] = True
    assert (hidden >= certain).all()
    assert (hidden <= possible).all()


def test_environments_do_not_depend_on_each_other() -> None:
    corrupt = Corruption(CorruptionSpec(), 5)
    order = torch.randperm(64, generator=torch.Generator().manual_seed(0))
    ranges = CLEAN + torch.rand(64, 15, 55, generator=torch.Generator().manual_seed(1))
    whole = corrupt(ranges, ENV, STEP)
    assert torch.equal(whole[order], corrupt(ranges[order], ENV[order], STEP[order]))
    assert not torch.equal(whole, corrupt(ranges, ENV, STEP + 1))
    assert not torch.equal(whole, Corruption(CorruptionSpec(), 6)(ranges, ENV, STEP))


def test_what_had_no_return_gets_none_and_what_had_one_stays_positive() -> None:
    ranges = torch.full((8, 4, 4), 0.01)
    ranges[:, 0] = 0.0
    out = Corruption(spec(noise=(0.1, 0.0, 0.0)), 1)(ranges, ENV[:8], STEP[:8])
    assert torch.equal(out > 0, ranges > 0)
