"""Training of a navigation policy by PPO, resumable at any point (paper, Sec. III-C)."""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict

from romnav import files, random, ranks, stopping
from romnav.errors import RomnavError
from romnav.journal import Journal
from romnav.navigation import checkpoint
from romnav.navigation.env import NavigationEnv
from romnav.navigation.kickstart import KickstartedPPO, Teacher, blank_lesson
from romnav.navigation.perception import Perception
from romnav.navigation.ppo import BoundedPPO, make_ppo
from romnav.navigation.spec import KickstartSpec, NavigationSpec
from romnav.robot.dynamics import Body
from romnav.robot.rom import ReducedOrderModel
from romnav.tensors import not_finite
from romnav.threads import torch_threads
from romnav.world.world import World

SAVE_EVERY = 120.0
"""Seconds between checkpoints."""

Progress = Callable[[int, int, str], None]


def train(
    spec: NavigationSpec,
    world: World,
    perception: Perception,
    out: Path,
    seed: int,
    *,
    body: Body = ReducedOrderModel,
    kickstart: tuple[KickstartSpec, Path] | None = None,
    begin: Path | None = None,
    device: str = "cpu",
    resume: bool = True,
    progress: Progress | None = None,
) -> Path:
    """Train one policy on robots that ``body`` makes, and write ``out/policy.pt`` and ``out/curve.csv``, the latter as
    TensorBoard's events, too.

    Every ``spec.ppo.keep`` iterations the policy so far is kept as ``out/kept/<iteration>.pt``.
    ``out/checkpoint.pt`` holds the whole state of the run every two minutes: a run that is killed and started again
    ends in the same weights as one left alone. A signal that ends the program has it written, too, after the iteration
    at hand.

    Processes of one group (`ranks`) train one policy: each has its share of the environments, they average their
    gradients, and rank 0 writes. As many of them can resume the run.

    Args:
        spec: Task, policy and learning.
        world: Terrain.
        perception: Sensors.
        out: Folder of the results.
        seed: Of weights and episodes.
        body: Makes the robots.
        kickstart: How to be taught, and the teacher's policy.
        begin: Policy that is trained on, and its critic; random ones without. The optimiser begins anew.
        device: Torch device.
        resume: Whether to go on from an earlier run.
        progress: Told (steps done, steps in all, recent success).

    Raises:
        RomnavError: The checkpoint to resume is torn or of another run; ``out`` cannot be written; the teacher, or the
            policy to begin with, does not fit; the environments cannot be shared by the processes.
    """
    with torch_threads(spec.ppo.threads):
        return _train(spec, world, perception, out, seed, body, kickstart, begin, device, resume, progress)


def _train(
    spec: NavigationSpec,
    world: World,
    perception: Perception,
    out: Path,
    seed: int,
    body: Body,
    kickstart: tuple[KickstartSpec, Path] | None,
    begin: Path | None,
    device: str,
    resume: bool,
    progress: Progress | None,
) -> Path:
    numbers = _share(spec)
    torch.manual_seed(seed if ranks.rank() == 0 else int(random.bits(seed, ranks.rank())))
    world = world.to(device)
    dynamics = body(world, len(numbers), spec.env.period)
    perception.images = False
    env = NavigationEnv(world, dynamics, perception, spec.env, seed, device, numbers)
    obs = env.get_observations()
    ppo = _learner(spec, env, obs, perception, kickstart, device)
    if begin is not None:
        _begin(begin, perception, ppo)
    if ranks.size() > 1:
        ppo.broadcast_parameters()
    identity = {"spec": spec.model_dump_json(), "seed": seed, "encoder": perception.encoder.digest()}
    if perception.depth is not None:
        identity["depth_encoder"] = perception.depth.encoder.digest()
    if kickstart is not None and isinstance(ppo, KickstartedPPO):
        identity |= {"kickstart": kickstart[0].model_dump_json(), "teacher": ppo.teacher.digest}
    if begin is not None:
        identity["begin"] = files.digest(begin)
    total = spec.ppo.iterations * spec.ppo.stages
    unfreeze_at = round(spec.encoder.unfreeze_at * total)
    state = out / "checkpoint.pt"
    done, seconds, curve = 0, 0.0, []
    if resume and state.exists():
        saved = checkpoint.read(state, device)
        if saved["iterations"] > unfreeze_at:
            _unfreeze(ppo, env, perception)
        _restore(state, saved, identity, ppo, env)
        done, seconds, curve = saved["iterations"], saved["seconds"], saved["curve"]
        obs = env.get_observations()
    ppo.train_mode()
    journal = Journal(out, done * spec.env.envs * spec.ppo.steps) if ranks.rank() == 0 else None
    saved_at = started = time.monotonic()
    before, cpu_before = seconds, curve[-1]["cpu_seconds"] if curve else 0.0
    cpu_started = time.process_time()
    steps = spec.env.envs * spec.ppo.steps
    with stopping.deferred() as stop:
        while done < total:
            if done == unfreeze_at:
                obs = _unfreeze(ppo, env, perception)
            env.progress = done / spec.ppo.iterations
            ppo.begin(done / total)
            with torch.inference_mode():
                for _ in range(spec.ppo.steps):
                    obs, reward, dones, extras = env.step(ppo.act(obs))
                    ppo.process_env_step(obs, reward, dones, extras)
                ppo.compute_returns(obs)
            try:
                losses = ppo.update()
            except (RuntimeError, ValueError) as error:
                # distributions refuse parameters that are not finite, before any loss is reported
                _check_finite(state, done + 1, {}, ppo)
                raise error
            done += 1
            seconds = before + time.monotonic() - started
            cpu_spent = torch.tensor(time.process_time() - cpu_started, dtype=torch.float64)
            cpu_seconds = cpu_before + float(ranks.total(cpu_spent))
            curve.append(_row(done, done * steps, seconds, cpu_seconds, env, losses, ppo.learning_rate) | ppo.report())
            _check_finite(state, done, curve[-1], ppo)
            if journal:
                journal.add(done * steps, curve[-1])
                if spec.ppo.keep and done % spec.ppo.keep == 0:
                    _save_policy(out / "kept" / f"{done:06d}.pt", identity, ppo, done * steps, seconds)
            if progress:
                progress(done * steps, total * steps, _summary(curve))
            stopped, due = ranks.anywhere(bool(stop), time.monotonic() - saved_at > SAVE_EVERY and done < total)
            if stopped or due:
                if journal:
                    journal.flush()
                _save(state, identity, ppo, env, done, seconds, curve)
                saved_at = time.monotonic()
            if stopped and not stop:
                stop.note(signal.SIGTERM)  # another process was asked to end
            stop.obey()
    policy = out / "policy.pt"
    if journal:
        journal.close()
        files.write(out / "curve.csv", files.csv_text(curve))
        _save_policy(policy, identity, ppo, total * steps, seconds)
    return policy


def _share(spec: NavigationSpec) -> range:
    """Numbers of the environments of this process."""
    processes, envs = ranks.size(), spec.env.envs
    if envs % processes or envs // processes < spec.ppo.minibatches:
        raise RomnavError(
            f"navigation.env.envs: {envs} in {spec.ppo.minibatches} minibatches (ppo.minibatches) cannot be shared by "
            f"{processes} processes; start as many that each has equally many, one for every minibatch at least"
        )
    return ranks.share(envs)


def _learner(
    spec: NavigationSpec,
    env: NavigationEnv,
    obs: TensorDict,
    perception: Perception,
    kickstart: tuple[KickstartSpec, Path] | None,
    device: str,
) -> BoundedPPO:
    if kickstart is None:
        return make_ppo(obs, spec.policy, spec.ppo, env.num_envs, device)
    if spec.encoder.unfreeze_at < 1.0:
        raise RomnavError("navigation.encoder.unfreeze_at: a teacher reads a frozen encoder's tokens; set it to 1.0")
    teacher = Teacher(kickstart[1], perception, kickstart[0], spec, device)
    ppo = make_ppo(blank_lesson(obs), spec.policy, spec.ppo, env.num_envs, device, KickstartedPPO)
    ppo.enrol(teacher, env.places)
    return ppo


def _begin(path: Path, perception: Perception, ppo: BoundedPPO) -> None:
    """Give actor and critic the weights that the policy of ``path`` and its critic have."""
    depth = perception.depth.encoder if perception.depth else None
    with torch.random.fork_rng():  # the weights that a network is made with are drawn, and the run's draws go on
        actor = checkpoint.load_actor(path, perception.encoder, depth_encoder=depth)
        critic = checkpoint.load_critic(path)
    if critic is None:
        raise RomnavError(
            f"{path}: has no critic to begin with; train that arm again, or be taught by it "
            "(kickstart.teacher, kickstart.init = 'teacher')"
        )
    for own, other in ((ppo.actor, actor), (ppo.critic, critic)):
        weights = other.state_dict()
        if {n: w.shape for n, w in weights.items()} != {n: w.shape for n, w in own.state_dict().items()}:
            raise RomnavError(
                f"{path}: a run that begins with it needs the same networks and senses; give both arms the same "
                "navigation.dynamics, navigation.policy and navigation.encoder, and both guidance or none"
            )
        own.load_state_dict(weights)


def _save_policy(path: Path, identity: dict[str, Any], ppo: BoundedPPO, steps: int, seconds: float) -> None:
    networks = {"actor": ppo.policy(), "critic": ppo.critic.state_dict()}
    content = {**identity, **networks, "steps": steps, "hours": seconds / 3600}
    if ranks.size() > 1:
        content["processes"] = ranks.size()
    checkpoint.save(path, content)


def _save(
    path: Path, identity: dict[str, Any], ppo: Any, env: NavigationEnv, done: int, seconds: float, curve: list
) -> None:
    share = {
        **ppo.memories(),
        "env": env.state_dict(),
        "random": torch.get_rng_state(),
        **({"device_random": torch.cuda.get_rng_state(env.device)} if env.device != "cpu" else {}),
    }
    shares = ranks.gathered(share)
    if not shares:
        return
    content = {
        **identity,
        **ppo.save(),
        **shares[0],
        "others": shares[1:],
        "iterations": done,
        "seconds": seconds,
        "curve": curve,
    }
    checkpoint.save(path, content)
    files.write(path.with_name("curve.csv"), files.csv_text(curve))


def _unfreeze(ppo: BoundedPPO, env: NavigationEnv, perception: Perception) -> TensorDict:
    """Let PPO train the encoder as well; returns the present observations, with images."""
    perception.images = True
    obs = env.get_observations()
    ppo.unfreeze(perception.encoder, obs)
    return obs


def _restore(
    path: Path, content: dict[str, Any], identity: dict[str, Any], ppo: BoundedPPO, env: NavigationEnv
) -> None:
    for key in ("spec", "seed", "encoder", "depth_encoder", "begin", "kickstart", "teacher"):
        if content.get(key) != identity.get(key):
            raise RomnavError(
                f"{path}: belongs to a run with another {key}; delete it, or pass --no-resume to start over"
            )
    shares = [content, *content.get("others", [])]
    if len(shares) != ranks.size():
        raise RomnavError(
            f"{path}: belongs to a run of {len(shares)} processes, and here are {ranks.size()}; start as many, or pass "
            "--no-resume to start over"
        )
    share = shares[ranks.rank()]
    ppo.load(content, None, True)
    ppo.remember(share)
    env.load_state_dict(share["env"])
    torch.set_rng_state(share["random"].cpu())
    if "device_random" in share:
        torch.cuda.set_rng_state(share["device_random"].cpu(), env.device)


def _row(
    done: int,
    steps: int,
    seconds: float,
    cpu_seconds: float,
    env: NavigationEnv,
    losses: dict[str, float],
    rate: float,
) -> dict[str, float]:
    s = env.statistics()
    row: dict[str, float] = {"iteration": done, "steps": steps}
    row |= {"seconds": round(seconds, 2), "cpu_seconds": round(cpu_seconds, 2)}
    row |= {"episodes": s.episodes, "success": s.success, "same": s.same, "cross": s.cross}
    row |= {f"reward_{name}": value for name, value in s.reward.items()}
    row |= {f"loss_{name}": value for name, value in losses.items()}
    return row | {"learning_rate": rate}


def _check_finite(path: Path, iteration: int, row: dict[str, float], ppo: BoundedPPO) -> None:
    """Stop before what is not finite is saved; observations that are not end in the normalisers' weights."""
    wrong = [name for name, value in row.items() if name.startswith(("loss_", "reward_")) and not math.isfinite(value)]
    for owner, model in (("actor", ppo.actor), ("critic", ppo.critic)):
        wrong += [f"{owner} {name}" for name in not_finite(model.state_dict())]
    if wrong:
        raise RomnavError(
            f"{path}: iteration {iteration}: {', '.join(wrong[:3])} not finite; a checkpoint there is of one before. "
            "Lower navigation.ppo.learning_rate_range, or look at the settings"
        )


def _summary(curve: list[dict[str, float]], window: int = 10) -> str:
    """Recent success by level, weighted by episodes."""

    def mean(key: str) -> float:
        rows = [r for r in curve[-window:] if not math.isnan(r[key])]
        weight = sum(r["episodes"] for r in rows)
        return sum(r[key] * r["episodes"] for r in rows) / weight if weight else 0.0

    return f"success {mean('success'):.0%} (same {mean('same'):.0%}, cross {mean('cross'):.0%})"
