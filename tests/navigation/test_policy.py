from __future__ import annotations

from itertools import pairwise

import pytest
import torch
from scipy import stats
from tensordict import TensorDict

from romnav.navigation.policy import Attention, NavigationActor, RecurrentCore
from romnav.navigation.spec import PolicySpec

SPEC = PolicySpec(attention=16, heads=2, queries=4, recurrent=16, hidden=16)


def actor(tokens: int = 5, channels: int = 8, spec: PolicySpec = SPEC) -> NavigationActor:
    torch.manual_seed(0)
    obs = TensorDict({"lidar": torch.zeros(1, tokens, channels), "state": torch.zeros(1, 9)}, batch_size=[1])
    return NavigationActor(obs, {"actor": ["state"]}, "actor", 3, spec)


def rollout(steps: int, batch: int) -> TensorDict:
    generator = torch.Generator().manual_seed(1)
    return TensorDict(
        {
            "lidar": torch.randn(steps, batch, 5, 8, generator=generator).to(torch.bfloat16),
            "state": torch.randn(steps, batch, 9, generator=generator),
        },
        batch_size=[steps, batch],
    )


def test_recurrent_core_equals_torch_gru_between_resets() -> None:
    torch.manual_seed(3)
    core = RecurrentCore(7, 11).double()
    gru = torch.nn.GRU(7, 11, 2).double()
    for k in range(2):
        getattr(gru, f"weight_ih_l{k}").data.copy_(core.input[k].weight)
        getattr(gru, f"bias_ih_l{k}").data.copy_(core.input[k].bias)
        getattr(gru, f"weight_hh_l{k}").data.copy_(core.recurrent[k].weight)
        getattr(gru, f"bias_hh_l{k}").data.copy_(core.recurrent[k].bias)
    x = torch.randn(9, 4, 7, dtype=torch.float64)
    hidden = torch.randn(2, 4, 11, dtype=torch.float64)
    starts = torch.zeros(9, 4, dtype=torch.bool)
    starts[0, 3] = starts[5, 2] = True
    out, last = core(x, hidden, starts)
    for env, cuts in ((0, [0, 9]), (2, [0, 5, 9]), (3, [0, 9])):
        h = hidden[:, env : env + 1].clone()
        for a, b in pairwise(cuts):
            if starts[a, env]:
                h = torch.zeros_like(h)
            expected, h = gru(x[a:b, env : env + 1], h.contiguous())
            torch.testing.assert_close(out[a:b, env : env + 1], expected)
        torch.testing.assert_close(last[:, env : env + 1], h)


def test_recurrent_core_gradients() -> None:
    torch.manual_seed(4)
    core = RecurrentCore(3, 4).double()
    x = torch.randn(5, 2, 3, dtype=torch.float64, requires_grad=True)
    hidden = torch.randn(2, 2, 4, dtype=torch.float64, requires_grad=True)
    starts = torch.zeros(5, 2, dtype=torch.bool)
    starts[2, 1] = True

    def run(x: torch.Tensor, hidden: torch.Tensor, *parameters: torch.Tensor) -> torch.Tensor:
        return core(x, hidden, starts)[0]

    assert torch.autograd.gradcheck(run, (x, hidden, *core.parameters()))


def test_attention_equals_torch_multihead_attention() -> None:
    """Self-attention against the library's own module with the same weights."""
    torch.manual_seed(5)
    ours = Attention(6, 8, 10, SPEC)
    reference = torch.nn.MultiheadAttention(16, 2, batch_first=True)
    reference.in_proj_weight.data.copy_(ours.self_qkv.weight)
    reference.in_proj_bias.data.copy_(ours.self_qkv.bias)
    reference.out_proj.weight.data.copy_(ours.self_out.weight)
    reference.out_proj.bias.data.copy_(ours.self_out.bias)
    cross = torch.nn.MultiheadAttention(16, 2, batch_first=True)
    cross.in_proj_weight.data.copy_(torch.cat([torch.eye(16), ours.cross_kv.weight.data]))
    cross.in_proj_bias.data.copy_(torch.cat([torch.zeros(16), ours.cross_kv.bias.data]))
    cross.out_proj.weight.data.copy_(ours.cross_out.weight)
    cross.out_proj.bias.data.copy_(ours.cross_out.bias)
    tokens, state = torch.randn(3, 6, 8), torch.randn(3, 10)
    x = ours.embed(tokens) + ours.place
    x = ours.norm(x + reference(x, x, x)[0])
    query = torch.cat([ours.queries.expand(3, -1, -1), ours.state_query(state)[:, None]], dim=1)
    assert query.shape[1] == 5  # four learned, one from the non-visual observation
    expected = (query + cross(query, x, x)[0]).flatten(1)
    torch.testing.assert_close(ours(tokens, state), expected, atol=1e-5, rtol=1e-5)


def test_update_replays_the_rollout() -> None:
    """The distribution of a whole rollout with a start inside equals the one met step by step."""
    policy, obs = actor(), rollout(6, 4)
    starts = torch.zeros(6, 4, dtype=torch.bool)
    starts[3, 1] = starts[4, 2] = True
    policy.reset(hidden_state=torch.randn(2, 4, 16))
    first = policy.get_hidden_state()
    stepped = []
    for t in range(6):
        policy.reset(dones=starts[t])
        policy(obs[t], stochastic_output=True)
        stepped.append(policy.output_distribution_params[0])
    policy(obs, masks=starts, hidden_state=first, stochastic_output=True)
    torch.testing.assert_close(policy.output_distribution_params[0], torch.stack(stepped), atol=1e-5, rtol=1e-5)


def test_memory_matters_and_is_per_environment() -> None:
    policy, obs = actor(), rollout(2, 4)
    policy.reset()
    policy(obs[0])
    kept = policy(obs[1])
    policy.reset()
    policy(obs[0])
    policy.reset(dones=torch.tensor([0, 1, 0, 0]))
    reset = policy(obs[1])
    assert not torch.allclose(kept[1], reset[1])
    torch.testing.assert_close(kept[[0, 2, 3]], reset[[0, 2, 3]])


def test_select_keeps_the_right_memories() -> None:
    policy, obs = actor(), rollout(2, 4)
    policy.reset()
    policy(obs[0])
    whole = policy(obs[1])
    policy.reset()
    policy(obs[0])
    keep = torch.tensor([3, 1])
    policy.select(keep)
    torch.testing.assert_close(policy(obs[1][keep]), whole[keep])


@pytest.mark.parametrize("support", [1.0, 1.2])
def test_actions_are_bounded_beta_samples(support: float) -> None:
    policy, obs = actor(spec=SPEC.model_copy(update={"support": support})), rollout(1, 64)
    policy.reset()
    drawn = []
    for _ in range(50):
        memory = policy.get_hidden_state()
        drawn.append(policy(obs[0], stochastic_output=True))
    samples = torch.stack(drawn)
    assert samples.min() >= -support
    assert 0.9 * support < samples.max() <= support
    alpha, beta = policy.output_distribution_params
    law = stats.beta(alpha.detach(), beta.detach(), -support, 2 * support)
    expected = torch.from_numpy(law.logpdf(samples[-1].detach())).sum(dim=1).float()
    torch.testing.assert_close(policy.get_output_log_prob(samples[-1]), expected, rtol=1e-4, atol=1e-4)
    policy.reset(hidden_state=memory)
    assert policy(obs[0]).detach().numpy() == pytest.approx(law.mean(), abs=1e-5)


@pytest.mark.parametrize("tokens", [1, 8, 14])
def test_any_number_of_tokens(tokens: int) -> None:
    obs = TensorDict({"lidar": torch.randn(3, tokens, 8), "state": torch.randn(3, 9)}, batch_size=[3])
    policy = actor(tokens)
    policy.reset()
    assert policy(obs).shape == (3, 3)


def test_a_policy_made_for_fewer_observations_ignores_the_rest() -> None:
    humanoid = rollout(4, 3)
    humanoid["state"] = torch.cat([humanoid["state"], torch.randn(4, 3, 8)], dim=2)
    humanoid["depth"] = torch.randn(4, 3, 4, 32)
    one, other = actor(), actor()
    for step in range(4):
        assert torch.equal(one(humanoid[step]), other(rollout(4, 3)[step]))


@pytest.mark.parametrize("part", ["depth", "felt"])
def test_depth_and_proprioception_reach_the_actions(part: str) -> None:
    obs = rollout(4, 3)
    obs["state"] = torch.cat([obs["state"], torch.randn(4, 3, 8)], dim=2)
    obs["depth"] = torch.randn(4, 3, 4, 32).to(torch.bfloat16)
    changed = obs.clone()
    if part == "depth":
        changed["depth"][:, 1] += 1.0
    else:
        changed["state"][:, 1, 9:] += 1.0
    torch.manual_seed(0)
    policy = NavigationActor(obs[0], {"actor": ["state"]}, "actor", 3, SPEC)
    starts, memory = torch.zeros(4, 3, dtype=torch.bool), torch.zeros(2, 3, 16)
    a, b = (policy(o, masks=starts, hidden_state=memory) for o in (obs, changed))
    assert torch.equal(a[:, [0, 2]], b[:, [0, 2]])
    assert not torch.allclose(a[:, 1], b[:, 1], atol=1e-4)
