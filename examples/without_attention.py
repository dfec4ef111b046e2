"""A policy network: the tokens are averaged, not attended to."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from romnav.navigation.policy import NavigationActor
from romnav.navigation.spec import PolicySpec


class MeanOfTokens(nn.Module):
    """Every token embedded with its place, and their mean beside the embedded state."""

    def __init__(self, tokens: int, channels: int, state: int, spec: PolicySpec) -> None:
        super().__init__()
        self.embed = nn.Linear(channels, spec.attention)
        self.place = nn.Parameter(torch.randn(tokens, spec.attention))
        self.out = nn.Sequential(nn.ELU(), nn.Linear(spec.attention + state, spec.visual))

    def forward(self, tokens: Tensor, state: Tensor) -> Tensor:
        """Tokens (B, K, C) and embedded state (B, S) -> (B, `PolicySpec.visual`)."""
        mean = torch.nn.functional.elu(self.embed(tokens) + self.place).mean(dim=1)
        return self.out(torch.cat([mean, state], dim=1))


class WithoutAttention(NavigationActor):
    """The paper's network but for its attention."""

    reader = MeanOfTokens
