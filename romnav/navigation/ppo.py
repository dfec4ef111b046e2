"""rsl-rl's PPO over rollouts that are stored once and never cut apart or padded."""

from __future__ import annotations

import copy
from collections.abc import Generator
from itertools import chain
from typing import Any, Protocol, TypeVar

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.models import MLPModel
from rsl_rl.modules import HiddenState
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict
from torch import Tensor

from romnav import ranks
from romnav.navigation.guidance import Guidance
from romnav.navigation.observations import ACTIONS
from romnav.navigation.policy import LAYERS, NavigationActor
from romnav.navigation.spec import NETWORKS, PolicySpec, PPOSpec
from romnav.precision import reduced_precision
from romnav.sensing.encoder import Encoder


class Rollout(RolloutStorage):
    """Rollout whose recurrent minibatches are whole environments, with episode starts in place of padding masks.

    Only the memory before the first step is kept. Minibatches are views: nothing is copied.
    """

    def _save_hidden_states(self, hidden_states: tuple[HiddenState, HiddenState]) -> None:
        if self.step == 0:
            self._first_hidden = hidden_states[0]

    def recurrent_mini_batch_generator(
        self, num_mini_batches: int, num_epochs: int = 8
    ) -> Generator[RolloutStorage.Batch, None, None]:
        """Yield batches (T, B, ...) of ``B = envs / num_mini_batches`` environments."""
        starts = torch.zeros(self.num_transitions_per_env, self.num_envs, dtype=torch.bool, device=self.device)
        starts[1:] = self.dones[:-1, :, 0].bool()
        for _ in range(num_epochs):
            for envs in torch.arange(self.num_envs).tensor_split(num_mini_batches):
                part = slice(int(envs[0]), int(envs[-1]) + 1)
                yield RolloutStorage.Batch(
                    observations=self.observations[:, part],
                    actions=self.actions[:, part],
                    values=self.values[:, part],
                    advantages=self.advantages[:, part],
                    returns=self.returns[:, part],
                    old_actions_log_prob=self.actions_log_prob[:, part],
                    old_distribution_params=tuple(p[:, part] for p in self.distribution_params),
                    hidden_states=(self._first_hidden[:, part], None),
                    masks=starts[:, part],
                )


class PrivilegedCritic(MLPModel):
    """Value network on the critic's observation; it has no memory, so episode starts mean nothing to it."""

    def forward(
        self,
        obs: TensorDict,
        masks: Tensor | None = None,
        hidden_state: HiddenState = None,
        stochastic_output: bool = False,
    ) -> Tensor:
        """(..., 1) values; products up to the last layer are in `reduced_precision`."""
        *hidden, last = self.mlp
        features = self.get_latent(obs)
        with reduced_precision(features.device):
            for layer in hidden:
                features = layer(features)
        return last(features.float())


class Term(Protocol):
    """A term of the loss beside PPO's own."""

    coefficient: float

    def loss(self, actor: MLPModel, batch: RolloutStorage.Batch) -> Tensor:
        """Its mean, unweighted, over the minibatch that ``actor`` was just shown."""
        ...


class Terms:
    """Further terms of the loss by name, in the part of the symmetry that rsl-rl's `PPO.update` asks.

    Attributes:
        surrogate: Factor of PPO's own objective.
    """

    use_mirror_loss = True
    mirror_loss_coeff = 1.0

    def __init__(self, by_name: dict[str, Term]) -> None:
        self.by_name = by_name
        self.surrogate = 1.0
        self._seen: dict[str, list[Tensor]] = {}

    def __len__(self) -> int:
        return len(self.by_name)

    def augment_batch(self, batch: RolloutStorage.Batch, size: int) -> None:
        """Scale the objective, which is linear in the advantages."""
        batch.advantages = batch.advantages * self.surrogate

    def compute_loss(self, actor: MLPModel, batch: RolloutStorage.Batch, size: int) -> Tensor:
        """Weighted sum of the terms."""
        losses = {name: term.loss(actor, batch) for name, term in self.by_name.items()}
        for name, loss in losses.items():
            self._seen.setdefault(name, []).append(loss.detach())
        return torch.stack([self.by_name[name].coefficient * loss for name, loss in losses.items()]).sum()

    def means(self) -> dict[str, float]:
        """Means of the terms, unweighted, since they were last asked for."""
        means = {name: float(torch.stack(seen).mean()) for name, seen in self._seen.items()}
        self._seen = {}
        return means


class Average:
    """Mean of a network's weights over the last ``share`` of its updates, more or less: by polynomial-decay averaging
    (Shamir & Zhang, 2013), in which the t-th of n counts as t ** (1 / share - 1).

    Attributes:
        weights: By name, as in a state dict; empty before the first update.
    """

    def __init__(self, share: float) -> None:
        self._share, self._count = share, 0
        self.weights: dict[str, Tensor] = {}

    def add(self, weights: dict[str, Tensor]) -> None:
        """Take the weights after an update in; what is new among them, or no float, is as it is last."""
        self._count += 1
        for name, last in weights.items():
            mean = self.weights.get(name)
            if mean is None or not last.is_floating_point():
                self.weights[name] = last.detach().clone()
            else:
                mean.lerp_(last, min(1.0 / (self._share * self._count), 1.0))

    def state_dict(self) -> dict[str, Any]:
        """What `load_state_dict` needs to go on."""
        return {"count": self._count, "weights": self.weights}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from a `state_dict`."""
        self._count, self.weights = state["count"], state["weights"]


class BoundedPPO(PPO):
    """PPO whose adaptive learning rate stays within bounds, and whose loss may have further terms.

    Attributes:
        average: Of the actor's weights, if there is to be one.
    """

    learning_rate_range = (0.0, float("inf"))
    symmetry: Terms
    storage: RolloutStorage
    average: Average | None = None

    @property
    def learning_rate(self) -> float:
        """Current learning rate."""
        return self._learning_rate

    @learning_rate.setter
    def learning_rate(self, value: float) -> None:
        low, high = self.learning_rate_range
        self._learning_rate = min(max(value, low), high)

    def compute_returns(self, obs: TensorDict) -> None:
        """Returns and advantages of the rollout; those are normalised over the environments of all processes."""
        super().compute_returns(obs)
        if ranks.size() > 1:  # rsl-rl has normalised the share of each by itself
            self.storage.advantages = _normalised(self.storage.returns - self.storage.values)

    def update(self) -> dict[str, float]:
        """One update; its mean losses by name."""
        losses: dict[str, float] = super().update()
        losses.pop("symmetry", None)
        if self.average:
            self.average.add(self.actor.state_dict())
        return ranks.means(losses | self.symmetry.means())

    def policy(self) -> dict[str, Tensor]:
        """Weights of the actor as it is kept: the average, or the last ones."""
        last: dict[str, Tensor] = self.actor.state_dict()
        return self.average.weights or last if self.average else last

    def save(self) -> dict[str, Any]:
        """Everything that `load` needs to go on."""
        average = {"average": self.average.state_dict()} if self.average else {}
        return {**super().save(), **average}

    def load(self, loaded_dict: dict[str, Any], load_cfg: dict | None, strict: bool) -> bool:
        """Go on from what `save` returned."""
        if self.average:
            self.average.load_state_dict(loaded_dict["average"])
        return bool(super().load(loaded_dict, load_cfg, strict))

    def begin(self, share: float) -> None:
        """Set everything that is scheduled once ``share`` of the run is done."""

    def report(self) -> dict[str, float]:
        """Columns of the learning curve beside the losses."""
        return {}

    def memories(self) -> dict[str, HiddenState]:
        """What the networks remember of the running episodes."""
        return {"memory": self.actor.get_hidden_state()}

    def remember(self, memories: dict[str, Any]) -> None:
        """Restore `memories`."""
        self.actor.reset(hidden_state=memories["memory"])

    def unfreeze(self, encoder: Encoder, obs: TensorDict) -> None:
        """Train a copy of ``encoder`` with the policy from the next rollout on; ``obs`` now holds images."""
        self.actor.encoder = copy.deepcopy(encoder)
        used = [*self.actor.encoder.trunk.parameters(), *self.actor.encoder.mean.parameters()]
        self.optimizer.add_param_group({"params": [p.requires_grad_() for p in used], "lr": self.learning_rate})
        self.storage = Rollout(
            "rl", self.storage.num_envs, self.storage.num_transitions_per_env, obs, [ACTIONS], self.device
        )


def _normalised(values: Tensor) -> Tensor:
    """Values less their mean, over their standard deviation, both of all processes."""
    wide = values.double()
    count = ranks.size() * values.numel()
    centred = wide - ranks.total(wide.sum()) / count
    deviation = (ranks.total(centred.square().sum()) / (count - 1)).sqrt()
    return (centred / (deviation + 1e-8)).to(values.dtype)


P = TypeVar("P", bound=BoundedPPO)


def make_actor(obs: TensorDict, policy: PolicySpec, guided: bool = False) -> NavigationActor:
    """Policy network for the observations ``obs``; one that is ``guided`` also guesses the way."""
    network: type[NavigationActor] = NETWORKS.load(policy.network) if policy.network else NavigationActor
    return network(obs, {"actor": ["state"]}, "actor", ACTIONS, policy, guided)


def make_critic(obs: TensorDict, policy: PolicySpec) -> PrivilegedCritic:
    """Value network for the observations ``obs``."""
    groups, widths = {"critic": ["critic"]}, list(policy.critic)
    return PrivilegedCritic(obs, groups, "critic", 1, hidden_dims=widths, obs_normalization=True)


def make_ppo(
    obs: TensorDict, policy: PolicySpec, spec: PPOSpec, envs: int, device: str, kind: type[P] = BoundedPPO
) -> P:
    """Actor, critic, rollout and optimiser, of the ``kind`` of PPO; of one process ``envs`` of several."""
    actor = make_actor(obs, policy, guided=spec.guidance > 0.0).to(device)
    actor.reset(hidden_state=torch.zeros(LAYERS, envs, policy.recurrent, device=device))
    critic = make_critic(obs, policy).to(device)
    storage = Rollout("rl", envs, spec.steps, obs, [ACTIONS], device)
    options: dict[str, Any] = {
        "num_learning_epochs": spec.epochs,
        "num_mini_batches": spec.minibatches,
        "clip_param": spec.clip,
        "gamma": spec.gamma,
        "lam": spec.lam,
        "value_loss_coef": spec.value,
        "entropy_coef": spec.entropy,
        "max_grad_norm": spec.max_grad_norm,
        "use_clipped_value_loss": False,
        "desired_kl": spec.desired_kl,
        "learning_rate": spec.learning_rate,
    }
    if ranks.size() > 1:
        options["multi_gpu_cfg"] = {"global_rank": ranks.rank(), "world_size": ranks.size()}
    ppo = kind(actor, critic, storage, device=device, **options)
    # one pass over all parameters instead of ten per tensor
    ppo.optimizer = torch.optim.Adam(chain(actor.parameters(), critic.parameters()), spec.learning_rate, fused=True)
    ppo.learning_rate_range = spec.learning_rate_range
    ppo.average = Average(spec.average) if spec.average else None
    ppo.symmetry = Terms({"guidance": Guidance(spec.guidance)} if spec.guidance > 0.0 else {})
    return ppo
