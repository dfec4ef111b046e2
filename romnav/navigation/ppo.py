"""rsl-rl's PPO over rollouts that are stored once and never cut apart or padded."""

from __future__ import annotations

import copy
from collections.abc import Generator
from itertools import chain
from typing import Any

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.models import MLPModel
from rsl_rl.modules import HiddenState
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict
from torch import Tensor

from romnav.navigation.guidance import Guidance
from romnav.navigation.observations import ACTIONS
from romnav.navigation.policy import LAYERS, NavigationActor
from romnav.navigation.spec import PolicySpec, PPOSpec
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
            for envs in torch.arange(self.num_envs).chunk(num_mini_batches):
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


class BoundedPPO(PPO):
    """PPO whose adaptive learning rate stays within bounds."""

    learning_rate_range = (0.0, float("inf"))
    storage: RolloutStorage

    @property
    def learning_rate(self) -> float:
        """Current learning rate."""
        return self._learning_rate

    @learning_rate.setter
    def learning_rate(self, value: float) -> None:
        low, high = self.learning_rate_range
        self._learning_rate = min(max(value, low), high)

    def update(self) -> dict[str, float]:
        """One update; its mean losses by name."""
        losses: dict[str, float] = super().update()
        return {"guidance" if name == "symmetry" else name: value for name, value in losses.items()}

    def unfreeze(self, encoder: Encoder, obs: TensorDict) -> None:
        """Train a copy of ``encoder`` with the policy from the next rollout on; ``obs`` now holds images."""
        self.actor.encoder = copy.deepcopy(encoder)
        used = [*self.actor.encoder.trunk.parameters(), *self.actor.encoder.mean.parameters()]
        self.optimizer.add_param_group({"params": [p.requires_grad_() for p in used], "lr": self.learning_rate})
        self.storage = Rollout(
            "rl", self.storage.num_envs, self.storage.num_transitions_per_env, obs, [ACTIONS], self.device
        )


def make_actor(obs: TensorDict, policy: PolicySpec, guided: bool = False) -> NavigationActor:
    """Policy network for the observations ``obs``; one that is ``guided`` also guesses the way."""
    return NavigationActor(obs, {"actor": ["state"]}, "actor", ACTIONS, policy, guided)


def make_ppo(obs: TensorDict, policy: PolicySpec, spec: PPOSpec, envs: int, device: str) -> BoundedPPO:
    """Actor, critic, rollout and optimiser."""
    actor = make_actor(obs, policy, guided=spec.guidance > 0.0).to(device)
    actor.reset(hidden_state=torch.zeros(LAYERS, envs, policy.recurrent, device=device))
    critic = PrivilegedCritic(
        obs, {"critic": ["critic"]}, "critic", 1, hidden_dims=list(policy.critic), obs_normalization=True
    ).to(device)
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
    ppo = BoundedPPO(actor, critic, storage, device=device, **options)
    # one pass over all parameters instead of ten per tensor
    ppo.optimizer = torch.optim.Adam(chain(actor.parameters(), critic.parameters()), spec.learning_rate, fused=True)
    ppo.learning_rate_range = spec.learning_rate_range
    if spec.guidance > 0.0:
        ppo.symmetry = Guidance(spec.guidance)
    return ppo
