"""An auxiliary loss: what the policy knows has to tell where the shortest path leads (after Ye et al., 2020)."""

from __future__ import annotations

from typing import cast

import torch
from rsl_rl.models import MLPModel
from rsl_rl.storage import RolloutStorage
from torch import Tensor

from romnav import ranks
from romnav.navigation.observations import privileged_way
from romnav.navigation.policy import NavigationActor

FAR = 0.5
"""Geodesic from which on the path has a direction worth guessing, m."""


class Guidance:
    """The loss of the guesses, a term of an update's.

    A guess is a vector in the robot's frame, which the mean squared error makes as long as the guess is sure, and the
    logarithm of the way that is left.
    """

    def __init__(self, coefficient: float) -> None:
        self.coefficient = coefficient

    def loss(self, actor: MLPModel, batch: RolloutStorage.Batch) -> Tensor:
        """Mean loss of the guesses that ``actor`` made of the batch that it was just shown."""
        direction, log_geodesic = privileged_way(cast(Tensor, batch.observations["critic"]))
        guess = cast(NavigationActor, actor).guess
        far = (log_geodesic > torch.tensor(FAR).log()).to(guess.dtype)
        wrong = (guess[..., :2] - direction).square().sum(dim=-1) + 0.25 * (guess[..., 2] - log_geodesic).square()
        # processes average their gradients, but may not have equally many guesses that count
        return ranks.size() * (wrong * far).sum() / ranks.total(far.sum()).clamp(min=1.0)
