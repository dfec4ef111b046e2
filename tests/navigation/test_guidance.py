from __future__ import annotations

import math
from pathlib import Path

import torch
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict

from romnav.navigation import checkpoint, train
from romnav.navigation.guidance import Guidance
from romnav.navigation.observations import PRIVILEGED_SIZE
from romnav.navigation.ppo import make_actor
from romnav.navigation.spec import NavigationSpec, PolicySpec
from romnav.world.world import World

from .conftest import TOKENS, FakePerception, fake_encoder


def batch(direction: list[float], length: float) -> RolloutStorage.Batch:
    critic = torch.zeros(3, 2, 9 + PRIVILEGED_SIZE)
    critic[..., 9 + 1] = math.log(length)
    critic[..., 9 + 6 : 9 + 8] = torch.tensor(direction)
    return RolloutStorage.Batch(observations=TensorDict({"critic": critic}, batch_size=[3, 2]))


def test_only_the_right_guess_costs_nothing() -> None:
    actor = make_actor(
        TensorDict({"lidar": torch.zeros(1, *TOKENS), "state": torch.zeros(1, 9)}, batch_size=[1]), PolicySpec(), True
    )
    loss = Guidance(1.0)
    for guess, cost in (([0.6, 0.8, math.log(5.0)], 0.0), ([0.6, -0.8, math.log(5.0)], 2.56), ([0.0, 0.0, 0.0], None)):
        actor.guess = torch.tensor(guess).expand(3, 2, 3)
        expected = 1.0 + 0.25 * math.log(5.0) ** 2 if cost is None else cost
        torch.testing.assert_close(loss.loss(actor, batch([0.6, 0.8], 5.0)).item(), expected)
    # at the goal there is no direction to guess
    assert loss.loss(actor, batch([0.6, 0.8], 0.3)).item() == 0.0


def test_guesses_get_better_and_stay_with_the_policy(
    world: World, perception: FakePerception, spec: NavigationSpec, tmp_path: Path
) -> None:
    ppo = spec.ppo.model_copy(update={"guidance": 0.5, "iterations": 12})
    path = train.train(spec.model_copy(update={"ppo": ppo}), world, perception, tmp_path, 1)
    losses = [float(line.split(",")[column]) for line, column in _column(tmp_path / "curve.csv", "loss_guidance")]
    assert sum(losses[-3:]) < 0.9 * sum(losses[:3])
    actor = checkpoint.load_actor(path, fake_encoder())
    assert actor.way is not None
    assert torch.equal(actor.way.weight, checkpoint.read(path)["actor"]["way.weight"])


def _column(path: Path, name: str) -> list[tuple[str, int]]:
    header, *lines = path.read_text().splitlines()
    column = header.split(",").index(name)
    return [(line, column) for line in lines]
