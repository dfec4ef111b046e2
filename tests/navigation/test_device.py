"""What a GPU would have to wait for: copies of its numbers to the host, in the loop of training."""

from __future__ import annotations

import traceback
from collections import Counter
from typing import Any

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from romnav.navigation.env import NavigationEnv
from romnav.navigation.perception import Eye, Perception
from romnav.navigation.ppo import BoundedPPO, make_ppo
from romnav.navigation.spec import EnvSpec, PolicySpec, PPOSpec
from romnav.robot.rom import ReducedOrderModel
from romnav.sensing.corruption import Corruption
from romnav.sensing.encoder import Autoencoder
from romnav.sensing.lidar import Lidar
from romnav.sensing.spec import CorruptionSpec, EncoderSpec, LidarSpec
from romnav.world.build import build
from romnav.world.spec import WorldSpec

ENVS, STEPS, MINIBATCHES = 16, 6, 2
WAITS = tuple(f"aten.{op}" for op in ("_local_scalar_dense", "is_nonzero", "nonzero", "masked_select", "_unique"))
INDEXED = ("aten.index.Tensor", "aten.index_put")


class Waits(TorchDispatchMode):
    """Counts operations whose result the host has to know, by file and line of ours or rsl-rl's."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: Counter[str] = Counter()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = str(func)
        waits = name.startswith(WAITS)
        if name.startswith(INDEXED):
            waits = any(index is not None and index.dtype == torch.bool for index in args[1])
        if waits:
            frames = [f for f in traceback.extract_stack() if "/romnav/" in f.filename or "/rsl_rl/" in f.filename]
            self.seen[f"{frames[-1].filename.rsplit('/', 2)[-2]}: {frames[-1].line}"] += 1
        return func(*args, **(kwargs or {}))


@pytest.fixture(scope="module")
def learner() -> tuple[NavigationEnv, BoundedPPO]:
    world = build(WorldSpec(tiles=1, side=22.0, classes=("building",), goals_per_tile=8))
    lidar = Lidar([tile.solids for tile in world.tiles], LidarSpec(rows=15, columns=55))
    encoder = Autoencoder(EncoderSpec(), lidar.directions).encoder.eval().requires_grad_(False)
    perception = Perception(Eye(lidar, Corruption(CorruptionSpec(), 0), encoder))
    env = NavigationEnv(world, ReducedOrderModel(world, ENVS, 0.2), perception, EnvSpec(envs=ENVS), 0, "cpu")
    spec = PPOSpec(steps=STEPS, minibatches=MINIBATCHES, epochs=1, guidance=0.2)
    ppo: BoundedPPO = make_ppo(env.get_observations(), PolicySpec(attention=16, recurrent=16), spec, ENVS, "cpu")
    ppo.train_mode()
    return env, ppo


def test_the_host_waits_once_a_step_and_where_rsl_rl_reports(
    learner: tuple[NavigationEnv, BoundedPPO], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Once a step: which episodes have ended. Nothing is brought to the host as an array or a list."""
    env, ppo = learner

    def refuse(*_: Any, **__: Any) -> Any:
        raise AssertionError("a tensor of the loop was copied to the host")

    for name in ("numpy", "cpu", "tolist", "__array__"):
        monkeypatch.setattr(torch.Tensor, name, refuse)
    obs = env.get_observations()
    with torch.inference_mode(), Waits() as rollout:
        for _ in range(STEPS):
            obs, reward, dones, extras = env.step(ppo.act(obs))
            ppo.process_env_step(obs, reward, dones, extras)
        ppo.compute_returns(obs)
    with Waits() as update:
        super(BoundedPPO, ppo).update()
    assert rollout.seen == {"navigation: ended = done.nonzero()[:, 0]": STEPS}
    ours = {line: count for line, count in update.seen.items() if not line.startswith("algorithms: ")}
    # bounds of a minibatch, whose indices lie on the host anyway
    assert ours == {"navigation: part = slice(int(envs[0]), int(envs[-1]) + 1)": 2 * MINIBATCHES}
