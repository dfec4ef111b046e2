"""The policy network (paper, Sec. III-B): LiDAR tokens, attention, depth, GRU memory, Beta distributions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from rsl_rl.models import MLPModel
from rsl_rl.modules import HiddenState
from tensordict import TensorDict
from torch import Tensor, nn

from romnav.navigation.attention import Attend
from romnav.navigation.spec import PolicySpec
from romnav.precision import product_dtype, reduced_precision
from romnav.sensing.encoder import Encoder

LAYERS = 2
BEARING = 2
"""Numbers that `with_bearing` adds."""
STATE_SCALE = (0.1, 0.1, 1.0, 0.25, 1.0, 1.0, 1.0, 4.0, 1.0)
"""Brings goal (m) and command (m/s, rad/s) to the order of one; proprioception is of that order."""


def with_bearing(state: Tensor) -> Tensor:
    """Non-visual observation (B, 9 + P) scaled to the order of one, with the goal's bearing as a unit vector before the
    proprioception: (B, 11 + P).

    The bearing is in ``dx, dy`` already, but near the goal these are small, and dividing them is what a narrow dense
    layer learns slowest.
    """
    bearing = torch.nn.functional.normalize(state[:, :2], dim=1, eps=0.05)
    task, felt = state[:, : len(STATE_SCALE)], state[:, len(STATE_SCALE) :]
    return torch.cat([task * state.new_tensor(STATE_SCALE), bearing, felt], dim=1)


class GRULayer(torch.autograd.Function):
    """The recurrent part of one GRU layer over a rollout, with resets between steps.

    Equal to `torch.nn.GRU`; written out so that the weight gradient is one product over all steps, and so that
    episodes may start inside the rollout without being cut apart and padded.
    """

    @staticmethod
    def forward(ctx: Any, gates: Tensor, hidden: Tensor, keep: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        """``gates`` (T, B, 3H) input part of (r, z, n); ``hidden`` (B, H) before the first step; ``keep`` (T, B, 1)
        is 0 where an episode starts. Returns the hidden states (T, B, H), of the type of ``gates``."""
        width = hidden.shape[1]
        hidden, keep, weight = (x.to(gates.dtype) for x in (hidden, keep, weight))
        inner = bias.to(gates.dtype).expand_as(gates).clone()
        inner[..., : 2 * width] += gates[..., : 2 * width]
        new = gates[..., 2 * width :]
        candidate = torch.empty_like(new, memory_format=torch.contiguous_format)
        before, out = torch.empty_like(candidate), torch.empty_like(candidate)
        transposed = weight.t()
        rows = (inner, inner[..., : 2 * width], *inner.split(width, dim=2), new, keep, candidate, before, out)
        for a, rz, r, z, m, x, k, n, h, o in zip(*(tensor.unbind() for tensor in rows), strict=True):
            torch.mul(hidden, k, out=h)
            a.addmm_(h, transposed)
            rz.sigmoid_()
            torch.addcmul(x, r, m, out=n).tanh_()
            hidden = torch.lerp(n, h, z, out=o)
        ctx.save_for_backward(before, inner, candidate, keep, weight)
        return out

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor, None, Tensor, Tensor]:
        """Gradients with respect to gates, initial hidden state, weight and bias."""
        before, inner, candidate, keep, weight = ctx.saved_tensors
        steps, batch, width = before.shape
        r, z, m = inner.split(width, dim=2)
        # derivatives of a hidden state by its (r, z, recurrent n, n): all steps at once, the loop only chains them
        slope = before.new_empty(steps, batch, 4, width)
        by_r, by_z, by_m, by_n = slope.unbind(2)
        torch.mul(1 - z, 1 - candidate.square(), out=by_n)
        torch.mul(by_n, r, out=by_m)
        torch.mul(by_m, (1 - r) * m, out=by_r)
        torch.mul((before - candidate) * z, 1 - z, out=by_z)
        recurrent = slope.flatten(2)[..., : 3 * width]
        carry = torch.zeros_like(before[0])
        rows = (grad, z, keep, slope, recurrent)
        for g, u, k, s, d in zip(*(tensor.unbind()[::-1] for tensor in rows), strict=True):
            carry = carry + g
            s.mul_(carry.unsqueeze(1))
            carry = carry.mul_(u).addmm_(d, weight).mul_(k)
        flat = recurrent.flatten(0, 1)
        d_gates = torch.cat([by_r, by_z, by_n], dim=2)
        d_weight, d_bias = flat.t() @ before.flatten(0, 1), flat.sum(dim=0, dtype=torch.float32)
        return d_gates, carry.float(), None, d_weight.float(), d_bias


class RecurrentCore(nn.Module):
    """Two-layer GRU over rollouts with episode starts inside them."""

    def __init__(self, inputs: int, width: int) -> None:
        super().__init__()
        self.width = width
        reference = nn.GRU(inputs, width, LAYERS)
        self.input: Sequence[nn.Linear] = nn.ModuleList(  # type: ignore[assignment]
            nn.Linear(inputs if k == 0 else width, 3 * width) for k in range(LAYERS)
        )
        self.recurrent: Sequence[nn.Linear] = nn.ModuleList(  # type: ignore[assignment]
            nn.Linear(width, 3 * width) for _ in range(LAYERS)
        )
        for k in range(LAYERS):
            self.input[k].weight.data.copy_(getattr(reference, f"weight_ih_l{k}"))
            self.input[k].bias.data.copy_(getattr(reference, f"bias_ih_l{k}"))
            self.recurrent[k].weight.data.copy_(getattr(reference, f"weight_hh_l{k}"))
            self.recurrent[k].bias.data.copy_(getattr(reference, f"bias_hh_l{k}"))

    def forward(self, x: Tensor, hidden: Tensor, starts: Tensor) -> tuple[Tensor, Tensor]:
        """(T, B, inputs), hidden (layers, B, H), starts (T, B) -> outputs (T, B, H), last hidden (layers, B, H)."""
        keep = (~starts).to(x.dtype).unsqueeze(2)
        last = []
        for k in range(LAYERS):
            x = GRULayer.apply(self.input[k](x), hidden[k], keep, self.recurrent[k].weight, self.recurrent[k].bias)
            last.append(x[-1])
        return x, torch.stack(last)


class Attention(nn.Module):
    """One self-attention layer over the tokens, then cross-attention with learned and non-visual queries."""

    def __init__(self, tokens: int, channels: int, state: int, spec: PolicySpec) -> None:
        super().__init__()
        width = spec.attention
        self.heads = spec.heads
        self.embed = nn.Linear(channels, width)
        self.place = nn.Parameter(torch.randn(tokens, width))
        self.self_qkv = nn.Linear(width, 3 * width)
        self.self_out = nn.Linear(width, width)
        self.norm = nn.LayerNorm(width)
        self.queries = nn.Parameter(torch.randn(spec.queries, width))
        self.state_query = nn.Linear(state, width)
        self.cross_kv = nn.Linear(width, 2 * width)
        self.cross_out = nn.Linear(width, width)

    def forward(self, tokens: Tensor, state: Tensor) -> Tensor:
        """Tokens (B, K, C) and state embedding (B, S) -> (B, `PolicySpec.visual`)."""
        x = self.embed(tokens) + self.place
        x = self.norm(x + self.self_out(Attend.apply(self._split(self.self_qkv(x), 3), None).flatten(2)))
        query = torch.cat([self.queries.expand(len(x), -1, -1), self.state_query(state)[:, None]], dim=1)
        kept = Attend.apply(self._split(self.cross_kv(x), 2), self._split(query, 1).squeeze(2))
        return (query + self.cross_out(kept.flatten(2))).flatten(1)

    def _split(self, x: Tensor, parts: int) -> Tensor:
        return x.unflatten(2, (parts, self.heads, -1)).float()


class NavigationActor(MLPModel):
    """rsl-rl actor: attention over LiDAR tokens, GRU, dense layer, Betas over [-s, s]^3, s being `PolicySpec.support`.

    In updates it takes whole rollouts (T, B, ...) and, in place of padding masks, the (T, B) episode starts. Of the
    observations it reads as much as those had that it was made for: one for the reduced-order model drives a humanoid,
    too. What a humanoid has in addition, proprioception and depth, comes last in every layer that reads it.

    A network from outside extends this class; one that only reads the tokens in another way sets `reader`.
    """

    is_recurrent = True
    reader: Callable[[int, int, int, PolicySpec], nn.Module] = Attention
    """Makes, of K, C, S and the spec, what turns tokens (B, K, C) and embedded state (B, S) into features
    (B, `PolicySpec.visual`)."""

    def __init__(
        self,
        obs: TensorDict,
        obs_groups: dict[str, list[str]],
        obs_set: str,
        output_dim: int,
        spec: PolicySpec,
        guided: bool = False,
    ) -> None:
        tokens, channels = obs["lidar"].shape[1:]
        embedding = 64
        self.depth = "depth" in obs.keys()  # noqa: SIM118 - a TensorDict iterates over its batch
        seen = spec.visual + embedding + (obs["depth"][0].numel() if self.depth else 0)
        self._latent = spec.recurrent + seen
        super().__init__(
            obs,
            obs_groups,
            obs_set,
            output_dim,
            hidden_dims=[spec.hidden],
            distribution_cfg={"class_name": "BetaDistribution", "action_range": (-spec.support, spec.support)},
        )
        self.state_embedding = nn.Sequential(nn.Linear(self.obs_dim + BEARING, embedding), nn.ELU())
        self.attention = type(self).reader(tokens, channels, embedding, spec)
        self.core = RecurrentCore(seen, spec.recurrent)
        self.way = nn.Linear(self._latent, 3) if guided else None
        """Guesses where the shortest path leads (`romnav.navigation.guidance`)."""
        self.encoder: Encoder | None = None
        """Encoder of its own; then "lidar" are images (B, rows, columns) in m, otherwise tokens of a frozen one."""
        self._hidden: Tensor | None = None
        self.guess = torch.empty(0)
        """(T, B, 3) direction and log of the length of the shortest path, as guessed in the last update."""

    def forward(
        self,
        obs: TensorDict,
        masks: Tensor | None = None,
        hidden_state: HiddenState = None,
        stochastic_output: bool = False,
    ) -> Tensor:
        """Actions (..., 3): samples or means. Products up to the last layer in `reduced_precision`; weights float32."""
        parameters = self._raw(obs, masks, hidden_state)
        if not stochastic_output:
            return self.distribution.deterministic_output(parameters)
        self.distribution.update(parameters)
        return self.distribution.sample()

    def beta(self, obs: TensorDict) -> Tensor:
        """Beta parameters (B, 2, 3) of one step, in place of an action."""
        self.distribution.update(self._raw(obs, None, None))
        return torch.stack(self.distribution.params, dim=-2)

    def _raw(self, obs: TensorDict, masks: Tensor | None, hidden_state: HiddenState) -> Tensor:
        """What the distribution makes its parameters of, (..., 2, 3)."""
        with reduced_precision(obs["state"].device):
            latent = self.get_latent(obs, masks, hidden_state)
            features = self.mlp[1](self.mlp[0](latent))
        if self.way is not None and masks is not None:
            self.guess = self.way(latent.float())
        return self.mlp[3](self.mlp[2](features.float()))

    def get_latent(self, obs: TensorDict, masks: Tensor | None = None, hidden_state: HiddenState = None) -> Tensor:
        """``[h_t, visual, state]`` of one step (B, ...) or, with episode starts as ``masks``, a rollout (T, B, ...)."""
        single = masks is None
        lead = obs["state"].shape[:-1]
        state = self.state_embedding(with_bearing(obs["state"][..., : self.obs_dim].flatten(0, -2)))
        lidar = obs["lidar"].flatten(0, -3)
        tokens = lidar.to(product_dtype(lidar.device)) if self.encoder is None else self.encoder(lidar.float())
        parts = [self.attention(tokens, state), state]
        if self.depth:
            parts.append(obs["depth"].flatten(0, -3).flatten(1).to(state.dtype))
        seen = torch.cat(parts, dim=1).unflatten(0, lead)
        if single:
            hidden = self._hidden_for(lead[0], seen)
            starts = torch.zeros(1, lead[0], dtype=torch.bool, device=seen.device)
            memory, self._hidden = self.core(seen.unsqueeze(0), hidden, starts)
            memory = memory[0]
        else:
            memory, _ = self.core(seen, hidden_state, masks)
        return torch.cat([memory, seen], dim=-1)

    def reset(self, dones: Tensor | None = None, hidden_state: HiddenState = None) -> None:
        """Forget everything, restore a memory, or forget the environments that are done."""
        if dones is None:
            self._hidden = hidden_state
        elif self._hidden is not None:
            self._hidden = self._hidden * (dones == 0).to(self._hidden.dtype)[None, :, None]

    def get_hidden_state(self) -> HiddenState:
        """Memory (layers, B, H), None before the first step."""
        return self._hidden

    def select(self, envs: Tensor) -> None:
        """Keep only the memory of environments ``envs``, in that order."""
        if self._hidden is not None:
            self._hidden = self._hidden[:, envs]

    def _hidden_for(self, batch: int, like: Tensor) -> Tensor:
        if self._hidden is None:
            self._hidden = like.new_zeros(LAYERS, batch, self.core.width)
        return self._hidden

    def _get_obs_dim(self, obs: TensorDict, obs_groups: dict[str, list[str]], obs_set: str) -> tuple[list[str], int]:
        return ["state"], obs["state"].shape[-1]

    def _get_latent_dim(self) -> int:
        return self._latent
