"""The reduced-order stage as a benchmark drives it: one rollout and one update at a time."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from _common import ROOT

from romnav.experiment.scales import Scale, ScaleFile
from romnav.navigation.env import NavigationEnv
from romnav.navigation.observations import Perceive
from romnav.navigation.perception import Eye, Perception
from romnav.navigation.ppo import make_ppo
from romnav.robot.rom import ReducedOrderModel
from romnav.sensing.corruption import Corruption
from romnav.sensing.encoder import Autoencoder
from romnav.sensing.lidar import Lidar
from romnav.world.build import build
from romnav.world.spec import WorldSpec
from romnav.world.world import World

CACHE = ROOT / ".cache/bench"


def scale(name: str = "cpu", envs: int | None = None, tiles: int | None = None) -> Scale:
    """A scale of the experiments, with another number of environments or tiles."""
    s = ScaleFile(ROOT / "experiments/scales", name).settings
    world = s.world.model_copy(update={"tiles": tiles or s.world.tiles})
    env = s.navigation.env.model_copy(update={"envs": envs or s.navigation.env.envs})
    navigation = s.navigation.model_copy(update={"env": env})
    return s.model_copy(update={"world": world, "navigation": navigation})


def load_world(spec: WorldSpec, cache: Path = CACHE) -> World:
    """Terrain, built at most once."""
    return build(spec, cache)


def sensors(s: Scale, world: World, *, bfloat16: bool = True) -> Perception:
    """LiDAR, corruption and an encoder with random weights: what it computes costs the same as a trained one."""
    torch.manual_seed(0)
    lidar = Lidar([tile.solids for tile in world.tiles], s.lidar)
    spec = s.pretrain.encoder.model_copy(update={"bfloat16": bfloat16})
    encoder = Autoencoder(spec, lidar.directions).encoder.eval().requires_grad_(False)
    return Perception(Eye(lidar, Corruption(s.navigation.corruption, 0), encoder))


def environment(s: Scale, world: World, perceive: Perceive) -> NavigationEnv:
    """Robots on ``world`` that see through ``perceive``."""
    spec = s.navigation.env
    return NavigationEnv(world, ReducedOrderModel(world, spec.envs, spec.period), perceive, spec, 0, "cpu")


class Learner:
    """An environment and an algorithm of rsl-rl's, ours or a peer."""

    def __init__(self, env: NavigationEnv, algorithm: Any, steps: int) -> None:
        self.env = env
        self.algorithm = algorithm
        self.steps = steps
        self.obs = env.get_observations()
        self.losses: dict[str, float] = {}
        algorithm.train_mode()

    def rollout(self) -> None:
        """Collect ``steps`` steps of every environment."""
        with torch.inference_mode():
            for _ in range(self.steps):
                self.obs, reward, dones, extras = self.env.step(self.algorithm.act(self.obs))
                self.algorithm.process_env_step(self.obs, reward, dones, extras)
            self.algorithm.compute_returns(self.obs)

    def iterate(self, clock: Callable[[], float] = time.perf_counter) -> float:
        """One rollout and one update; nav-steps/s of ``clock``, learning included."""
        start = clock()
        self.rollout()
        self.losses = self.algorithm.update()
        return self.steps * self.env.num_envs / (clock() - start)


def ours(s: Scale, world: World) -> Learner:
    """The learner of `romnav.navigation.train`."""
    env = environment(s, world, sensors(s, world))
    torch.manual_seed(0)
    ppo = make_ppo(env.get_observations(), s.navigation.policy, s.navigation.ppo, env.num_envs, "cpu")
    return Learner(env, ppo, s.navigation.ppo.steps)
