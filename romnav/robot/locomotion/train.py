"""Training of the locomotion policy: rsl-rl's PPO over `LocomotionEnv`, resumable to the bit."""

from __future__ import annotations

import csv
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from rsl_rl.algorithms import PPO
from rsl_rl.env import VecEnv
from rsl_rl.models import MLPModel
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict
from torch import Tensor

from romnav import files, stopping
from romnav.errors import RomnavError
from romnav.journal import Journal
from romnav.progress import Progress
from romnav.robot.locomotion.lane_task import LocomotionEnv
from romnav.robot.locomotion.task import WalkingEnv
from romnav.robot.locomotion.terrain import curriculum
from romnav.robot.locomotion.tile_task import TileEnv
from romnav.robot.spec import LocomotionSpec, PpoSpec, TileTaskSpec
from romnav.tensors import Kind, not_finite, require_finite
from romnav.world.build import build

KIND = Kind("romnav-locomotion-1", "locomotion policy", "train one with `romnav train locomotion`")
GROUPS = {"actor": ["policy"], "critic": ["policy", "privileged"]}


class Together(VecEnv):
    """Robots on lanes and, from some iteration on, on tiles, as one batch."""

    def __init__(self, lanes: LocomotionEnv, tiles: TileEnv | None = None) -> None:
        self.parts: list[WalkingEnv] = [lanes, *([tiles] if tiles else [])]
        self.cfg, self.num_actions, self.device = lanes.cfg, lanes.num_actions, "cpu"
        self.max_episode_length = lanes.max_episode_length
        self._counts = [part.num_envs for part in self.parts]
        self.num_envs = sum(self._counts)

    def get_observations(self) -> TensorDict:
        """Observation groups of all robots."""
        return cast(TensorDict, torch.cat([part.get_observations() for part in self.parts]))

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict[str, Any]]:
        """One control step of all robots; what is logged of those on tiles is called so."""
        steps = [part.step(action) for part, action in zip(self.parts, actions.split(self._counts), strict=True)]
        obs, reward, done, extras = zip(*steps, strict=True)
        log = dict(extras[0]["log"])
        for extra in extras[1:]:
            log |= {f"/tiles{key}": value for key, value in extra["log"].items()}
        time_outs = torch.cat([extra["time_outs"] for extra in extras])
        return (
            cast(TensorDict, torch.cat(obs)),
            torch.cat(reward),
            torch.cat(done),
            {"time_outs": time_outs, "log": log},
        )

    def state_dict(self) -> dict[str, Any]:
        """Everything that decides the future of the run."""
        lanes, *tiles = (part.state_dict() for part in self.parts)
        return lanes | {"tiles": tiles[0]} if tiles else lanes

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from `state_dict`; where it knows of no robots on tiles, those begin."""
        state = dict(state)
        tiles = state.pop("tiles", None)
        self.parts[0].load_state_dict(state)
        if tiles and self.parts[1:]:
            self.parts[1].load_state_dict(tiles)


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


def make_ppo(spec: PpoSpec, env: VecEnv) -> PPO:
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
        RomnavError: the file is missing, damaged or no locomotion policy.
    """
    saved = KIND.load(path)
    spec = LocomotionSpec.model_validate_json(saved["spec"])
    width = saved["ppo"]["actor_state_dict"]["obs_normalizer._mean"].shape[1]
    actions = saved["ppo"]["actor_state_dict"]["distribution.std_param"].shape[0]
    actor = make_actor(spec.ppo, TensorDict({"policy": torch.zeros(1, width)}, batch_size=[1]), actions)
    weights = {**saved["ppo"]["actor_state_dict"], **saved["average"]}
    require_finite(path, weights, KIND.again)
    actor.load_state_dict(weights)
    actor.eval()

    def policy(obs: Tensor) -> Tensor:
        with torch.inference_mode():
            return actor(TensorDict({"policy": obs}, batch_size=[len(obs)]))

    return spec, policy, saved["iteration"]


def training_cost(path: Path) -> dict[str, Any]:
    """Iterations, policy steps and hours that a checkpoint cost."""
    saved = KIND.load(path)
    steps = LocomotionSpec.model_validate_json(saved["spec"]).steps(saved["iteration"])
    return {"iterations": saved["iteration"], "steps": steps, "hours": round(saved["seconds"] / 3600, 3)}


def _save(
    path: Path,
    spec: LocomotionSpec,
    ppo: PPO,
    average: dict[str, Tensor],
    env: Together,
    iteration: int,
    seconds: float,
) -> None:
    state = {
        "average": average,
        "spec": spec.model_dump_json(), "iteration": iteration, "seconds": seconds, "ppo": ppo.save(),
        "learning_rate": ppo.learning_rate, "torch_random": torch.get_rng_state(), "env": env.state_dict(),
    }  # fmt: skip
    KIND.save(path, state)


def train(
    spec: LocomotionSpec,
    out: Path,
    *,
    device: str = "cpu",
    resume: bool = True,
    progress: Progress | None = None,
    threads: int = 0,
    save_every: float = 60.0,
    worlds: Path | None = None,
) -> Path:
    """Train a policy; writes `out/policy.pt`, and `out/curve.csv` with a row per iteration; TensorBoard's events, too.

    Args:
        spec: what to train. When a run is resumed, `spec.iterations` may differ from the checkpoint's.
        out: directory.
        device: only "cpu" has an engine.
        resume: continue from `out/policy.pt` where it exists; the result equals the run that was not interrupted.
        progress: told the iteration, their number, and reward per step and falls per second of a robot.
        threads: of the physics; 0 means all cores. They do not change the result.
        save_every: seconds between checkpoints.
        worlds: cache of worlds, see `romnav.world.build.build`.

    Returns:
        The checkpoint.

    Raises:
        RomnavError: the checkpoint there was trained by another specification or for longer, `device` is not
            supported, or a loss, reward, observation or weight is not finite; the last checkpoint is then the last
            good one.
    """
    if device != "cpu":
        raise RomnavError(f"train locomotion: device {device!r} has no physics engine here; use --device cpu")
    out.mkdir(parents=True, exist_ok=True)
    path = out / "policy.pt"
    torch.manual_seed(spec.seed)
    lanes = LocomotionEnv(spec, curriculum(np.random.default_rng(spec.seed)), threads=threads)
    saved = KIND.load(path) if resume and path.exists() else None
    if saved and not _leads_to(saved, spec):
        raise RomnavError(f"{path}: trained by another specification; use another directory or --no-resume")
    done, spent = (saved["iteration"], saved["seconds"]) if saved else (0, 0.0)
    if done > spec.iterations:
        raise RomnavError(
            f"{path}: has had {done} iterations, more than locomotion.iterations, {spec.iterations}; raise that, or "
            "pass --no-resume to start over"
        )
    curve = _read_curve(out / "curve.csv", done)

    def joined() -> Together:
        world = build(spec.tiles.world, worlds)
        return Together(lanes, TileEnv(spec, world, threads=threads))

    env = joined() if spec.tiles.robots and done >= spec.tiles.begin else Together(lanes)
    ppo = make_ppo(spec.ppo, env)
    average = {name: weight.detach().clone() for name, weight in ppo.actor.named_parameters()}
    if saved:
        ppo.load(saved["ppo"], None, strict=True)
        ppo.learning_rate, average = saved["learning_rate"], saved["average"]
        env.load_state_dict(saved["env"])
        torch.set_rng_state(saved["torch_random"])
    ppo.train_mode()
    obs = env.get_observations()
    journal = Journal(out, spec.steps(done) if done else 0)
    begin = mark = time.monotonic()
    with stopping.deferred() as stop:
        for iteration in range(done + 1, spec.iterations + 1):
            if spec.tiles.robots and iteration == spec.tiles.begin + 1 and len(env.parts) == 1:
                env = joined()
                obs = env.get_observations()
                ppo.storage = RolloutStorage("rl", env.num_envs, spec.ppo.steps, obs, [env.num_actions])
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
            try:
                losses = ppo.update()
            except (RuntimeError, ValueError) as error:
                # distributions refuse parameters that are not finite, before any loss is reported
                _check_finite(path, iteration, {"reward": total}, ppo)
                raise error
            losses["kl"] = adapt(ppo, spec.ppo)
            for name, weight in ppo.actor.named_parameters():
                average[name].lerp_(weight.detach(), 1.0 - spec.ppo.average)
            row = _row(rows) | {
                "iteration": iteration, "steps": spec.steps(iteration),
                "seconds": spent + time.monotonic() - begin, "collect": collected - clock,
                "learn": time.monotonic() - collected, "reward": total / spec.ppo.steps,
                "std": ppo.actor.distribution.std_param.mean().item(), "learning_rate": ppo.learning_rate,
            } | losses  # fmt: skip
            _check_finite(path, iteration, row, ppo)
            curve.append(row)
            of_losses = {f"loss_{name}": value for name, value in losses.items()}
            journal.add(row["steps"], {name: row[name] for name in row.keys() - losses.keys()} | of_losses)
            if progress:
                progress(iteration, spec.iterations, f"reward {row['reward']:.2f}, fell {row['fell']:.2f}/s")
            if stop or time.monotonic() - mark > save_every or iteration == spec.iterations:
                mark = time.monotonic()
                journal.flush()
                # first: a resumed run drops what is there too much
                files.write(out / "curve.csv", files.csv_text(curve))
                _save(path, spec, ppo, average, env, iteration, row["seconds"])
            stop.obey()
    journal.close()
    return path


def _leads_to(saved: dict[str, Any], spec: LocomotionSpec) -> bool:
    """Whether a run of `spec` passes through a checkpoint."""
    done, then = saved["iteration"], LocomotionSpec.model_validate_json(saved["spec"])
    return _until(spec, done) == _until(then, done)


def _until(spec: LocomotionSpec, iteration: int) -> LocomotionSpec:
    """What of a specification has an effect until an iteration."""
    tiles = spec.tiles
    if tiles.robots == 0 or iteration <= tiles.begin:
        tiles = TileTaskSpec()
    return spec.model_copy(update={"iterations": 1, "tiles": tiles})


def _check_finite(path: Path, iteration: int, row: dict[str, float], ppo: PPO) -> None:
    wrong = [name for name, value in row.items() if not np.isfinite(value)]
    for owner, model in (("actor", ppo.actor), ("critic", ppo.critic)):
        wrong += [f"{owner} {name}" for name in not_finite(model.state_dict())]
    if wrong:
        raise RomnavError(
            f"{path}: iteration {iteration}: {', '.join(wrong[:3])} not finite; the checkpoint is of one before. "
            "Lower ppo.learning_rate, or look at the settings"
        )


def _row(rows: list[dict[str, float]]) -> dict[str, float]:
    """Counts are summed, everything else is averaged, over the steps of an iteration."""
    counts = ("/ended/", "/arrived/", "/fallen/")
    table: dict[str, list[float]] = {}
    for row in rows:
        for key, value in row.items():
            table.setdefault(key, []).append(value)
    return {
        key.removeprefix("/"): float(sum(values) if any(part in key for part in counts) else np.mean(values))
        for key, values in table.items()
    }


def _read_curve(path: Path, iterations: int) -> list[dict[str, Any]]:
    """Rows of a curve up to an iteration: those behind it are written again by the run that goes on from there."""
    if not iterations or not path.exists():
        return []
    try:
        with path.open(newline="", encoding="utf-8") as file:
            return [row for row in csv.DictReader(file) if int(row["iteration"]) <= iterations]
    except (KeyError, TypeError, ValueError) as error:
        raise RomnavError(f"{path}: damaged; restore it, or delete it to begin a new one") from error
