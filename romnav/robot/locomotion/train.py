"""Training of the locomotion policy: rsl-rl's PPO over `LocomotionEnv`, resumable to the bit."""

from __future__ import annotations

import csv
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rsl_rl.algorithms import PPO
from rsl_rl.models import MLPModel
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict
from torch import Tensor

from romnav.errors import RomnavError
from romnav.progress import Progress
from romnav.robot.locomotion.task import LocomotionEnv
from romnav.robot.locomotion.terrain import curriculum
from romnav.robot.spec import LocomotionSpec, PpoSpec

GROUPS = {"actor": ["policy"], "critic": ["policy", "privileged"]}


def make_actor(spec: PpoSpec, obs: TensorDict, actions: int) -> MLPModel:
    """The policy; its mean starts at almost zero, which is the model-based gait alone."""
    low, start, high = spec.std
    actor = MLPModel(
        obs, GROUPS, "actor", actions, hidden_dims=spec.hidden, obs_normalization=True,
        distribution_cfg={"class_name": "GaussianDistribution", "init_std": start, "std_range": (low, high)},
    )  # fmt: skip
    last = [m for m in actor.mlp.modules() if isinstance(m, torch.nn.Linear)][-1]
    with torch.no_grad():
        last.weight.mul_(0.01)
        last.bias.zero_()
    return actor


def make_ppo(spec: PpoSpec, env: LocomotionEnv) -> PPO:
    """rsl-rl's PPO; `adapt` sets the learning rate.

    The value loss is not clipped: rsl-rl clips it at 0.2 in the units of the returns, which are near 30.
    """
    obs = env.get_observations()
    critic = MLPModel(obs, GROUPS, "critic", 1, hidden_dims=spec.hidden, obs_normalization=True)
    return PPO(
        make_actor(spec, obs, env.num_actions),
        critic,
        RolloutStorage("rl", env.num_envs, spec.steps, obs, [env.num_actions]),
        num_learning_epochs=spec.epochs,
        num_mini_batches=spec.minibatches,
        gamma=spec.gamma,
        lam=spec.lam,
        entropy_coef=spec.entropy,
        learning_rate=spec.learning_rate[0],
        schedule="fixed",
        desired_kl=None,
        use_clipped_value_loss=False,
    )


def adapt(ppo: PPO, spec: PpoSpec) -> float:
    """Set the next iteration's learning rate by how far this one has moved the policy.

    rsl-rl adapts after every minibatch, which at this batch size ends most iterations far below any floor.

    Returns:
        Mean KL divergence of the rollout's policy from the new one.
    """
    storage = ppo.storage
    old = tuple(p.flatten(0, 1) for p in storage.distribution_params)
    with torch.inference_mode():
        ppo.actor(storage.observations.flatten(0, 1), stochastic_output=True)
        kl = ppo.actor.get_kl_divergence(old, ppo.actor.output_distribution_params).mean().item()
    factor = 1 / 1.2 if kl > 1.5 * spec.desired_kl else 1.2 if kl < spec.desired_kl / 1.5 else 1.0
    ppo.learning_rate = float(np.clip(ppo.learning_rate * factor, *spec.learning_rate))
    for group in ppo.optimizer.param_groups:
        group["lr"] = ppo.learning_rate
    return kl


def load_policy(path: Path) -> tuple[LocomotionSpec, Callable[[Tensor], Tensor], int]:
    """Spec, deterministic policy (observation -> action; averaged weights) and iteration of a checkpoint.

    Raises:
        RomnavError: the file is missing.
    """
    if not path.exists():
        raise RomnavError(f"{path}: no locomotion policy; train one with `romnav train locomotion`")
    saved = torch.load(path, map_location="cpu", weights_only=False)
    spec = LocomotionSpec.model_validate(saved["spec"], strict=False)
    width = saved["ppo"]["actor_state_dict"]["obs_normalizer._mean"].shape[1]
    actions = saved["ppo"]["actor_state_dict"]["distribution.std_param"].shape[0]
    actor = make_actor(spec.ppo, TensorDict({"policy": torch.zeros(1, width)}, batch_size=[1]), actions)
    actor.load_state_dict({**saved["ppo"]["actor_state_dict"], **saved["average"]})
    actor.eval()

    def policy(obs: Tensor) -> Tensor:
        with torch.inference_mode():
            return actor(TensorDict({"policy": obs}, batch_size=[len(obs)]))

    return spec, policy, saved["iteration"]


def training_cost(path: Path) -> dict[str, Any]:
    """Iterations, policy steps and hours that a checkpoint cost."""
    saved = torch.load(path, map_location="cpu", weights_only=False)
    spec = saved["spec"]
    steps = saved["iteration"] * spec["ppo"]["steps"] * spec["task"]["robots"]
    return {"iterations": saved["iteration"], "steps": steps, "hours": round(saved["seconds"] / 3600, 3)}


def _save(
    path: Path,
    spec: LocomotionSpec,
    ppo: PPO,
    average: dict[str, Tensor],
    env: LocomotionEnv,
    iteration: int,
    seconds: float,
) -> None:
    state = {
        "average": average,
        "spec": spec.model_dump(), "iteration": iteration, "seconds": seconds, "ppo": ppo.save(),
        "learning_rate": ppo.learning_rate, "torch_random": torch.get_rng_state(), "env": env.state_dict(),
    }  # fmt: skip
    part = path.with_suffix(".tmp")
    torch.save(state, part)
    part.replace(path)


def train(
    spec: LocomotionSpec,
    out: Path,
    *,
    device: str = "cpu",
    resume: bool = True,
    progress: Progress | None = None,
    threads: int = 0,
    save_every: float = 60.0,
) -> Path:
    """Train a policy; writes `out/policy.pt` and a row per iteration to `out/curve.csv`.

    Args:
        spec: what to train. When a run is resumed, `spec.iterations` may differ from the checkpoint's.
        out: directory.
        device: only "cpu" has an engine.
        resume: continue from `out/policy.pt` where it exists; the result equals the run that was not interrupted.
        progress: told the iteration, their number, and reward per step and falls per second of a robot.
        threads: of the physics; 0 means all cores. They do not change the result.
        save_every: seconds between checkpoints.

    Returns:
        The checkpoint.

    Raises:
        RomnavError: the checkpoint there was trained by another specification, or `device` is not supported.
    """
    if device != "cpu":
        raise RomnavError(f"train locomotion: device {device!r} has no physics engine here; use --device cpu")
    out.mkdir(parents=True, exist_ok=True)
    path = out / "policy.pt"
    torch.manual_seed(spec.seed)
    env = LocomotionEnv(spec, curriculum(np.random.default_rng(spec.seed)), threads=threads)
    ppo = make_ppo(spec.ppo, env)
    average = {name: weight.detach().clone() for name, weight in ppo.actor.named_parameters()}
    done, spent = 0, 0.0
    if resume and path.exists():
        saved = torch.load(path, weights_only=False)
        if {**saved["spec"], "iterations": 0} != {**spec.model_dump(), "iterations": 0}:
            raise RomnavError(f"{path}: trained by another specification; use another directory or --no-resume")
        ppo.load(saved["ppo"], None, strict=True)
        ppo.learning_rate, average = saved["learning_rate"], saved["average"]
        env.load_state_dict(saved["env"])
        torch.set_rng_state(saved["torch_random"])
        done, spent = saved["iteration"], saved["seconds"]
    ppo.train_mode()
    obs = env.get_observations()
    begin = mark = time.monotonic()
    for iteration in range(done + 1, spec.iterations + 1):
        rows: list[dict[str, float]] = []
        total, clock = 0.0, time.monotonic()
        with torch.inference_mode():
            for _ in range(spec.ppo.steps):
                obs, reward, dones, extras = env.step(ppo.act(obs))
                ppo.process_env_step(obs, reward, dones, extras)
                rows.append(extras["log"])
                total += reward.mean().item()
            ppo.compute_returns(obs)
        collected = time.monotonic()
        losses = ppo.update()
        losses["kl"] = adapt(ppo, spec.ppo)
        for name, weight in ppo.actor.named_parameters():
            average[name].lerp_(weight.detach(), 1.0 - spec.ppo.average)
        row = _row(rows) | {
            "iteration": iteration, "steps": iteration * spec.ppo.steps * env.num_envs,
            "seconds": spent + time.monotonic() - begin, "collect": collected - clock,
            "learn": time.monotonic() - collected, "reward": total / spec.ppo.steps,
            "std": ppo.actor.distribution.std_param.mean().item(), "learning_rate": ppo.learning_rate,
        } | losses  # fmt: skip
        _append(out / "curve.csv", row, fresh=iteration == 1)
        if progress:
            progress(iteration, spec.iterations, f"reward {row['reward']:.2f}, fell {row['fell']:.2f}/s")
        if time.monotonic() - mark > save_every or iteration == spec.iterations:
            mark = time.monotonic()
            _save(path, spec, ppo, average, env, iteration, row["seconds"])
    return path


def _row(rows: list[dict[str, float]]) -> dict[str, float]:
    """Counts are summed, everything else is averaged, over the steps of an iteration."""
    counts = ("/ended", "/arrived", "/fallen")
    table: dict[str, list[float]] = {}
    for row in rows:
        for key, value in row.items():
            table.setdefault(key, []).append(value)
    return {
        key.removeprefix("/"): float(sum(values) if key.startswith(counts) else np.mean(values))
        for key, values in table.items()
    }


def _append(path: Path, row: dict[str, float], *, fresh: bool) -> None:
    columns = list(row)
    if not fresh and path.exists():
        with path.open() as file:
            columns = file.readline().strip().split(",")
    with path.open("w" if fresh else "a", newline="") as file:
        writer = csv.DictWriter(file, columns, restval=0, extrasaction="ignore")
        if fresh or file.tell() == 0:
            writer.writeheader()
        writer.writerow({k: f"{v:.5g}" if isinstance(v, float) else v for k, v in row.items()})
