"""Memory of a training run, told before it starts: what a few robots on a few tiles take, scaled up."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict

from romnav.experiment.scales import Scale
from romnav.navigation.env import NavigationEnv
from romnav.navigation.perception import Eye, Perception
from romnav.navigation.ppo import BoundedPPO, make_ppo
from romnav.robot.rom import ReducedOrderModel
from romnav.sensing.corruption import Corruption
from romnav.sensing.encoder import Autoencoder
from romnav.sensing.lidar import Lidar
from romnav.world.build import build

ROBOTS = 8
FLOAT = 4


def footprint(settings: Scale) -> dict[str, float]:
    """Megabytes of the largest parts of training on the reduced-order model at a scale, on whatever device.

    The activations of an update are not among them: they depend on the library's kernels.

    Args:
        settings: Of the scale, or of an arm at it.

    Returns:
        By part: the world, the robots (state and observation), the images of one step, the rollout (observations,
        actions, values and the like), one in which the policy trains its encoder on images as well, and the networks
        with their gradients and Adam's moments.
    """
    spec = settings.navigation
    tiles = len(settings.world.classes)
    world = build(settings.world.model_copy(update={"tiles": tiles}))
    lidar = Lidar([tile.solids for tile in world.tiles], settings.lidar)
    encoder = Autoencoder(settings.pretrain.encoder, lidar.directions).encoder.eval().requires_grad_(False)
    perception = Perception(Eye(lidar, Corruption(spec.corruption, 0), encoder))
    few = spec.env.model_copy(update={"envs": ROBOTS})
    env = NavigationEnv(world, ReducedOrderModel(world, ROBOTS, few.period), perception, few, 0, "cpu")
    obs = env.get_observations()
    ppo: BoundedPPO = make_ppo(obs, spec.policy, spec.ppo, ROBOTS, "cpu")
    perception.images = True
    seen = env.get_observations()
    weights = [*ppo.actor.parameters(), *ppo.critic.parameters()]
    share = spec.env.envs / ROBOTS
    sizes = {
        "world": _bytes(vars(world).values()) * settings.ground.tiles / tiles,
        "robots": (_bytes(env.state_dict().values()) + _bytes(obs.values())) * share,
        "images of a step": settings.lidar.rows * settings.lidar.columns * FLOAT * spec.env.envs,
        "rollout": _rollout(ppo.storage, obs) * share,
        "rollout with images": _rollout(ppo.storage, seen) * share,
        "networks": 4 * _bytes(weights),
    }
    return {part: size / 1e6 for part, size in sizes.items()}


def _bytes(values: Iterable[object]) -> float:
    return float(sum(value.nbytes for value in values if isinstance(value, torch.Tensor)))


def _rollout(storage: RolloutStorage, obs: TensorDict) -> float:
    steps = storage.num_transitions_per_env
    rest = _bytes(value for name, value in vars(storage).items() if name != "observations")
    # two parameters of a Beta for each action, kept from the first step on
    return rest + steps * (_bytes(obs.values()) + 2 * storage.actions[0].nbytes)
