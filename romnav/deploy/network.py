"""A policy in plain float32 operators, memory and command explicit: what can be exported."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from romnav.navigation.env import to_command
from romnav.navigation.policy import Attention, NavigationActor, RecurrentCore, with_bearing
from romnav.navigation.spec import CommandSpec
from romnav.sensing.encoder import Encoder


class PortableEncoder(nn.Module):
    """`Encoder` without writes in place."""

    directions: Tensor | None

    def __init__(self, encoder: Encoder) -> None:
        super().__init__()
        spec, (rows, columns) = encoder.spec, encoder.image_shape
        self.trunk, self.mean = encoder.trunk, encoder.mean
        self.register_buffer("directions", encoder.directions.permute(2, 0, 1) if spec.cartesian else None)
        self.scale = spec.scale
        row_stride, column_stride = (int(torch.tensor(spec.strides)[:, axis].prod()) for axis in (0, 1))
        self.padding = (0, -columns % column_stride, 0, -rows % row_stride)

    def forward(self, ranges: Tensor) -> Tensor:
        """(B, rows, columns) m -> (B, tokens, channels)."""
        length = ranges[:, None] / self.scale
        valid = (ranges > 0).float()[:, None]
        points = [] if self.directions is None else [length * self.directions]
        image = functional.pad(torch.cat([length, *points, valid], dim=1), self.padding)
        return self.mean(self.trunk(image)).flatten(2).transpose(1, 2)


class PortableAttention(nn.Module):
    """`Attention` without its kernel."""

    def __init__(self, attention: Attention) -> None:
        super().__init__()
        self.of = attention

    def forward(self, tokens: Tensor, state: Tensor) -> Tensor:
        """Tokens (B, K, C) and state embedding (B, S) -> features (B, W)."""
        of = self.of
        x = of.embed(tokens) + of.place
        q, k, v = self._heads(of.self_qkv(x), 3)
        x = of.norm(x + of.self_out(self._attend(q, k, v)))
        query = torch.cat([of.queries.expand(len(x), -1, -1), of.state_query(state)[:, None]], dim=1)
        k, v = self._heads(of.cross_kv(x), 2)
        (q,) = self._heads(query, 1)
        return (query + of.cross_out(self._attend(q, k, v))).flatten(1)

    def _heads(self, x: Tensor, parts: int) -> list[Tensor]:
        """(B, tokens, parts x heads x D) -> parts of (B, heads, tokens, D)."""
        split = x.unflatten(2, (parts, self.of.heads, -1))
        return [split[:, :, part].transpose(1, 2) for part in range(parts)]

    def _attend(self, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        share = (query @ key.transpose(2, 3) * query.shape[3] ** -0.5).softmax(dim=3)
        return (share @ value).transpose(1, 2).flatten(2)


class PortableCore(nn.Module):
    """One step of `RecurrentCore`."""

    def __init__(self, core: RecurrentCore) -> None:
        super().__init__()
        self.of = core

    def forward(self, x: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        """(B, inputs) and memory (layers, B, H) -> output (B, H) and the memory after it."""
        layers = []
        for k, hidden in enumerate(memory.unbind()):
            r, z, new = self.of.input[k](x).chunk(3, dim=1)
            inner_r, inner_z, inner_new = self.of.recurrent[k](hidden).chunk(3, dim=1)
            candidate = torch.tanh(new + torch.sigmoid(r + inner_r) * inner_new)
            x = candidate + torch.sigmoid(z + inner_z) * (hidden - candidate)
            layers.append(x)
        return x, torch.stack(layers)


class PortablePolicy(nn.Module):
    """Images, state and memory in; the command, by the means of the distributions, and the next memory out.

    Args:
        actor: The policy.
        lidar: Encoder of its range images; of no use to one that has an encoder of its own.
        depth: Encoder of its depth images, if it sees any.
        command: Limits.
    """

    def __init__(self, actor: NavigationActor, lidar: Encoder, depth: Encoder | None, command: CommandSpec) -> None:
        super().__init__()
        self.lidar = PortableEncoder(actor.encoder or lidar)
        self.depth = PortableEncoder(depth) if depth is not None else None
        self.state = actor.state_embedding
        attention = actor.attention
        self.attention = PortableAttention(attention) if isinstance(attention, Attention) else attention
        self.core = PortableCore(actor.core)
        self.head = actor.mlp
        self.action = actor.distribution.as_deterministic_output_module()
        self.limits = command
        self.state_size = actor.obs_dim

    def forward(
        self, lidar: Tensor, state: Tensor, memory: Tensor, depth: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Images (B, rows, columns) m, state (B, S), memory (layers, B, H) -> command (B, 3) m/s, rad/s, and memory."""
        embedded = self.state(with_bearing(state[:, : self.state_size]))
        seen = [self.attention(self.lidar(lidar), embedded), embedded]
        if self.depth is not None and depth is not None:
            seen.append(self.depth(depth).flatten(1))
        features = torch.cat(seen, dim=1)
        remembered, memory = self.core(features, memory)
        raw = self.head(torch.cat([remembered, features], dim=1))
        return to_command(self.action(raw), self.limits), memory
