"""What policies are judged by for choices."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy import stats
from tensordict import TensorDict

from romnav.evaluation import episodes
from romnav.evaluation.rollout import Policy, View
from romnav.evaluation.spec import EpisodeSetSpec
from romnav.navigation.ppo import make_actor
from romnav.navigation.spec import EnvSpec, PolicySpec
from romnav.world.build import build
from romnav.world.spec import WorldSpec
from tests.navigation.conftest import TOKENS, FakePerception

sys.path.append(str(Path(__file__).parents[1] / "tools"))
from choose import Altered

COUNT, ENV = 6, EnvSpec()


@pytest.fixture(scope="module")
def view() -> View:
    spec = EpisodeSetSpec(world=WorldSpec(tiles=4, seed=5, goals_per_tile=12), episodes=COUNT, cross=COUNT)
    world = build(spec.world)
    return View(world, episodes.draw("test", spec, world), ENV)


def make(kind: type[Policy]) -> Policy:
    torch.manual_seed(0)
    obs = TensorDict({"lidar": torch.zeros(1, *TOKENS), "state": torch.zeros(1, 9)}, batch_size=[1])
    spec = PolicySpec(attention=16, recurrent=16, support=1.2)
    return kind(make_actor(obs, spec), FakePerception())


@torch.inference_mode()
def commands(driver: Policy, view: View, steps: range) -> list[torch.Tensor]:
    out = []
    for view.step in steps:
        out.append(driver.command(view))
    return out


def test_unaltered_it_acts_as_it_is_evaluated(view: View) -> None:
    one, other = commands(make(Policy), view, range(8)), commands(make(Altered), view, range(8))
    torch.testing.assert_close(one, other, atol=1e-6, rtol=1e-5)


def test_it_forgets_every_second_and_begins_anew(view: View) -> None:
    driver = make(Altered)
    driver.forget = 1.0
    altered = commands(driver, view, range(12))
    second = round(1.0 / ENV.period)
    for begin in (0, second, 2 * second):
        steps = range(begin, min(begin + second, 12))
        torch.testing.assert_close(
            altered[begin : steps.stop], commands(make(Policy), view, steps), atol=1e-6, rtol=1e-5
        )
    remembered = commands(make(Policy), view, range(12))
    assert not torch.allclose(altered[second], remembered[second], atol=1e-6)


@torch.inference_mode()
def test_the_mode_is_the_densest_action_and_the_factor_is_on_it(view: View) -> None:
    driver = make(Altered)
    driver.act = "mode"
    forward, *_ = commands(driver, view, range(1))[0].T
    alpha, beta = make(Policy).actor.beta(driver.observe(view)).unbind(-2)
    grid = np.linspace(-1.2, 1.2, 48001)
    for k in range(COUNT):
        action = grid[np.argmax(stats.beta.pdf(grid, alpha[k, 0].item(), beta[k, 0].item(), -1.2, 2.4))]
        assert forward[k].item() == pytest.approx(0.25 + 0.75 * np.clip(action, -1, 1), abs=1e-3)
    driver.factor = 1e6
    driver.actor.reset()
    cut = commands(driver, view, range(1))[0][:, 0]
    assert set(cut.tolist()) == {1.0, -0.5}
