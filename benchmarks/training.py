"""Training on the reduced-order model, end to end, beside the same learner on stock rsl-rl.

Both sense, encode, act, step and learn on the same world with the same network, environments, steps, epochs and
minibatches (the "cpu" scale). The peer is what one builds from rsl-rl's parts: `RolloutStorage` keeps the range
images, recurrent minibatches are cut at episode ends and padded, `PPO` evaluates the frozen CNN inside the actor
in every pass, attention is PyTorch's and the memory is `torch.nn.GRU`. It drives the same environment, so that
the ratio is the learner's alone. Compared are CPU seconds of one thread, as trainings run side by side with a
thread each; beside it, the speed of as many runs as there are cores.

The peer's weights are copied from ours; both must command the same actions and, given the same actions, see the same
transitions.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Mapping
from copy import deepcopy
from typing import Any

import torch
from _common import CORES, arguments, in_children, markdown, report
from _learner import Learner, environment, load_world, ours, scale, sensors
from rsl_rl.algorithms import PPO
from rsl_rl.models import MLPModel, RNNModel
from rsl_rl.modules import HiddenState
from rsl_rl.storage import RolloutStorage
from rsl_rl.utils import unpad_trajectories
from tensordict import TensorDict
from torch import Tensor, nn
from torch.nn import functional as F

from romnav.experiment.scales import Scale
from romnav.navigation.env import NavigationEnv
from romnav.navigation.observations import ACTIONS
from romnav.navigation.perception import Perception
from romnav.navigation.policy import LAYERS, NavigationActor, with_bearing
from romnav.robot.dynamics import Dynamics
from romnav.world.world import World

SAME_ACTION = 0.02
"""Largest difference of the first commands, of a range of 2 (our rollouts keep tokens in bfloat16)."""


class Images:
    """The range images themselves, in place of tokens."""

    def __init__(self, perception: Perception) -> None:
        self.perception = perception

    def __call__(self, robot: Dynamics, counters: Tensor) -> dict[str, Tensor]:
        return {"lidar": self.perception.lidar.ranges(robot, counters)}


class StockActor(RNNModel):
    """The network of `NavigationActor` from the parts of rsl-rl and PyTorch, with the CNN inside."""

    def __init__(self, obs: TensorDict, ours: NavigationActor, encoder: nn.Module) -> None:
        self._widths = ours.core.input[0].in_features, ours.mlp[0].in_features
        super().__init__(
            obs,
            {"actor": ["state"]},
            "actor",
            ACTIONS,
            hidden_dims=[ours.mlp[0].out_features],
            distribution_cfg={"class_name": "BetaDistribution"},
            rnn_type="gru",
            rnn_hidden_dim=ours.core.width,
            rnn_num_layers=LAYERS,
        )
        self.rnn.rnn = nn.GRU(self._widths[0], ours.core.width, LAYERS)
        for k in range(LAYERS):
            for part, layer in (("ih", ours.core.input[k]), ("hh", ours.core.recurrent[k])):
                getattr(self.rnn.rnn, f"weight_{part}_l{k}").data.copy_(layer.weight)
                getattr(self.rnn.rnn, f"bias_{part}_l{k}").data.copy_(layer.bias)
        self.state_embedding = deepcopy(ours.state_embedding)
        self.attention = deepcopy(ours.attention)
        self.mlp = deepcopy(ours.mlp)
        self.encoder = encoder

    def get_latent(self, obs: TensorDict, masks: Tensor | None = None, hidden_state: HiddenState = None) -> Tensor:
        lead = obs["state"].shape[:-1]
        state = self.state_embedding(with_bearing(obs["state"].flatten(0, -2)))
        visual = self.attend(self.encoder.tokens(obs["lidar"].flatten(0, -3)), state)
        seen = torch.cat([visual, state], dim=1).unflatten(0, lead)
        memory = self.rnn(seen, masks, hidden_state).squeeze(0)
        return torch.cat([memory, seen if masks is None else unpad_trajectories(seen, masks)], dim=-1)

    def attend(self, tokens: Tensor, state: Tensor) -> Tensor:
        """`romnav.navigation.policy.Attention` by `torch.nn.functional.scaled_dot_product_attention`."""
        a = self.attention
        x = a.embed(tokens) + a.place

        def attention(query: Tensor, key: Tensor, value: Tensor) -> Tensor:
            heads = (y.unflatten(2, (a.heads, -1)).transpose(1, 2) for y in (query, key, value))
            return F.scaled_dot_product_attention(*heads).transpose(1, 2).flatten(2)

        x = a.norm(x + a.self_out(attention(*a.self_qkv(x).chunk(3, dim=2))))
        query = torch.cat([a.queries.expand(len(x), -1, -1), a.state_query(state)[:, None]], dim=1)
        return (query + a.cross_out(attention(query, *a.cross_kv(x).chunk(2, dim=2)))).flatten(1)

    def _get_latent_dim(self) -> int:
        return self._widths[1]


def stock(s: Scale, world: World) -> Learner:
    """The peer, with the weights that `ours` starts from."""
    template = ours(s, world).algorithm.actor
    perception = sensors(s, world, bfloat16=False)  # rsl-rl computes in float32 throughout
    env = environment(s, world, Images(perception))
    obs = env.get_observations()
    ppo, policy = s.navigation.ppo, s.navigation.policy
    critic = MLPModel(obs, {"critic": ["critic"]}, "critic", 1, list(policy.critic), obs_normalization=True)
    algorithm = PPO(
        StockActor(obs, template, perception.encoder),
        critic,
        RolloutStorage("rl", env.num_envs, ppo.steps, obs, [ACTIONS], "cpu"),
        num_learning_epochs=ppo.epochs,
        num_mini_batches=ppo.minibatches,
        clip_param=ppo.clip,
        gamma=ppo.gamma,
        lam=ppo.lam,
        value_loss_coef=ppo.value,
        entropy_coef=ppo.entropy,
        max_grad_norm=ppo.max_grad_norm,
        use_clipped_value_loss=False,
        desired_kl=ppo.desired_kl,
        learning_rate=ppo.learning_rate,
    )
    return Learner(env, algorithm, ppo.steps)


MAKERS: dict[str, Callable[[Scale, World], Learner]] = {"romnav": ours, "stock rsl-rl": stock}


def agreement(learners: Mapping[str, Learner], steps: int = 20) -> bool:
    """Whether first actions are equal within rounding, and transitions under the same actions exactly."""
    mine, peer = learners["romnav"], learners["stock rsl-rl"]
    with torch.inference_mode():
        first = [learner.algorithm.actor(learner.obs) for learner in (mine, peer)]
        mine.algorithm.actor.reset(hidden_state=torch.zeros_like(mine.algorithm.actor.get_hidden_state()))
        peer.algorithm.actor.reset()
    same = bool((first[0] - first[1]).abs().max() < SAME_ACTION)
    generator = torch.Generator().manual_seed(0)
    for _ in range(steps):
        actions = 2 * torch.rand(mine.env.num_envs, ACTIONS, generator=generator) - 1
        results = [learner.env.step(actions) for learner in (mine, peer)]
        for learner, result in zip((mine, peer), results, strict=True):
            learner.obs = result[0]
        (a, *rest), (b, *others) = results
        same &= torch.equal(a["critic"], b["critic"])
        same &= all(torch.equal(x, y) for x, y in zip(rest[:2], others[:2], strict=True))
    return same


class Stopwatch:
    """Exclusive seconds of nested spans: what is spent in an inner one counts there alone."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self._open: list[tuple[str, float, float]] = []

    def begin(self, label: str) -> None:
        self._open.append((label, time.perf_counter(), 0.0))

    def end(self) -> None:
        label, start, inner = self._open.pop()
        whole = time.perf_counter() - start
        self.seconds[label] += whole - inner
        if self._open:
            outer, began, before = self._open[-1]
            self._open[-1] = outer, began, before + whole

    def wrap(self, owner: Any, method: str, label: str, when: Callable[[], bool] = lambda: True) -> None:
        """Time calls of a method, or those of them that happen ``when``."""
        call = getattr(owner, method)
        self.seconds[label] += 0.0

        def timed(*args: Any, **kwargs: Any) -> Any:
            if not when():
                return call(*args, **kwargs)
            self.begin(label)
            try:
                return call(*args, **kwargs)
            finally:
                self.end()

        setattr(owner, method, timed)

    def wrap_learning(self, module: nn.Module, first: nn.Parameter, label: str) -> None:
        """Time a module in updates, forwards and backwards; the gradient of ``first`` is the last that it makes."""
        self.wrap(module, "forward", label, when=torch.is_grad_enabled)
        module.register_full_backward_pre_hook(lambda *_: self.begin(label))
        first.register_post_accumulate_grad_hook(lambda _: self.end())


def shares(learner: Learner, iterations: int) -> dict[str, float]:
    """Share of the time of each part."""
    env: NavigationEnv = learner.env
    ppo, eye, watch = learner.algorithm, env.perceive.lidar, Stopwatch()
    actor: NavigationActor = ppo.actor
    watch.wrap(eye.sensor, "scan", "LiDAR")
    watch.wrap(eye, "corruption", "corruption")
    watch.wrap(eye.encoder, "tokens", "encoder")
    watch.wrap(env.dynamics, "step", "dynamics")
    watch.wrap(env, "_lookup", "geodesic lookup")
    watch.wrap(env, "restart", "resets")
    watch.wrap(env, "step", "observations, rewards")
    watch.wrap(ppo, "act", "policy inference")
    watch.wrap(ppo, "process_env_step", "storage, returns")
    watch.wrap(ppo, "compute_returns", "storage, returns")
    watch.wrap_learning(actor.attention, actor.attention.embed.weight, "update: attention")
    watch.wrap_learning(actor.core, actor.core.input[0].weight, "update: GRU")
    watch.wrap(ppo, "update", "update: the rest")
    for _ in range(iterations):
        learner.iterate()
    whole = sum(watch.seconds.values())
    return {label: seconds / whole for label, seconds in watch.seconds.items()}


SENSING = ("LiDAR", "corruption", "encoder", "dynamics", "geodesic lookup", "resets", "observations, rewards")


def alone_on_a_thread(name: str, repeats: int) -> float:
    """Median nav-steps/s of a run on one thread."""
    torch.set_num_threads(1)
    s = scale()
    learner = MAKERS[name](s, load_world(s.world))
    return statistics.median([learner.iterate() for _ in range(repeats + 1)][1:])


def main() -> None:
    """Measure, print and write ``results/bench/training.json``."""
    options = arguments(__doc__, repeats=3)
    torch.set_num_threads(1)
    s = scale()
    world = load_world(s.world)
    learners = {name: make(s, world) for name, make in MAKERS.items()}
    agree = agreement(learners)
    rates: dict[str, list[float]] = {name: [] for name in learners}
    for turn in range(options.repeats + 1):
        for name, learner in learners.items():
            rate = learner.iterate(time.process_time)
            if turn:
                rates[name].append(rate)
            agree &= all(torch.tensor(list(learner.losses.values())).isfinite())
    parts = shares(learners["romnav"], options.repeats)
    side_by_side, memory = {}, {}
    for name in MAKERS:
        runs = in_children(alone_on_a_thread, name, options.repeats, count=CORES)
        side_by_side[name], memory[name] = sum(rate for rate, _ in runs), max(peak for _, peak in runs)
    n = s.navigation
    work = (
        f"Training on the reduced-order model: {n.env.envs} environments x {n.ppo.steps} steps, {n.ppo.epochs} epochs "
        f"x {n.ppo.minibatches} minibatches, {s.lidar.columns} x {s.lidar.rows} pixels, attention {n.policy.attention}"
    )
    report(
        "training",
        work,
        "nav-steps per CPU second",
        rates.pop("romnav"),
        rates,
        options.out,
        agree=agree,
        larger_is_better=True,
        runs_side_by_side=side_by_side,
        peak_memory_mb=memory,
        shares=parts,
        sensing_dynamics_resets=sum(parts[k] for k in SENSING),
    )
    table = markdown(["part", "share"], [[label, f"{share:.1%}"] for label, share in parts.items()])
    table += "\n" + markdown(
        ["", f"{CORES} runs of one thread each, nav-steps/s in sum", "peak memory of one, MB"],
        [[name, f"{side_by_side[name]:.0f}", f"{memory[name]:.0f}"] for name in MAKERS],
    )
    print(table)
    with (options.out / "training.md").open("a") as file:
        file.write(f"\n{table}")
    if not agree:
        sys.exit("ours and the peer disagree")


if __name__ == "__main__":
    main()
