"""Two processes that train one policy, beside one that does."""

from __future__ import annotations

import csv
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict

from romnav import ranks
from romnav.errors import RomnavError
from romnav.navigation import checkpoint
from romnav.navigation.env import NavigationEnv
from romnav.navigation.kickstart import Divergence
from romnav.navigation.ppo import BoundedPPO, make_ppo
from romnav.navigation.spec import EnvSpec, KickstartSpec, NavigationSpec, PolicySpec, PPOSpec
from romnav.navigation.train import train
from romnav.precision import full_precision
from romnav.robot.rom import ReducedOrderModel
from romnav.stopping import Stopped
from romnav.world.build import build
from romnav.world.spec import WorldSpec
from romnav.world.world import World
from tests.navigation.conftest import FakePerception

SPEC = NavigationSpec(
    env=EnvSpec(envs=12, duration=4.0, stay=1.0),
    policy=PolicySpec(attention=16, heads=2, queries=2, recurrent=16, hidden=16, critic=(16,)),
    ppo=PPOSpec(iterations=4, steps=6, epochs=2, minibatches=3, guidance=0.2, keep=2),
)
WORLD = WorldSpec(tiles=2, seed=5, goals_per_tile=12)
OF_ROLLOUT = ("rewards", "dones", "values", "actions", "actions_log_prob")
PROCESSES = 2


def spec_of(envs: int) -> NavigationSpec:
    return SPEC.model_copy(update={"env": SPEC.env.model_copy(update={"envs": envs})})


def learner(world: World, spec: NavigationSpec) -> tuple[BoundedPPO, NavigationEnv]:
    env = NavigationEnv(
        world, ReducedOrderModel(world, spec.env.envs, spec.env.period), FakePerception(), spec.env, 1, "cpu"
    )
    ppo = make_ppo(env.get_observations(), spec.policy, spec.ppo, spec.env.envs, "cpu")
    ppo.train_mode()
    return ppo, env


def rollout(ppo: BoundedPPO, env: NavigationEnv) -> TensorDict:
    """Fills the storage; the last observations."""
    obs = env.get_observations()
    with torch.inference_mode():
        for _ in range(SPEC.ppo.steps):
            obs, reward, dones, extras = env.step(ppo.act(obs))
            ppo.process_env_step(obs, reward, dones, extras)
    return obs


def update(ppo: BoundedPPO, obs: TensorDict) -> dict[str, Any]:
    """What a process knows of an update: the gradients of its first minibatch as they are applied, and the rest."""
    gradients: list[list[torch.Tensor]] = []
    step = ppo.optimizer.step
    parameters = [*ppo.actor.parameters(), *ppo.critic.parameters()]

    def applied() -> None:
        gradients.append([p.grad.clone() for p in parameters])
        step()

    ppo.optimizer.step = applied
    with torch.inference_mode():
        ppo.compute_returns(obs)
    losses = ppo.update()
    return {
        "gradients": gradients[0],
        "losses": losses,
        "rate": ppo.learning_rate,
        "seen": ppo.critic.obs_normalizer.state_dict(),
        "weights": [p.detach().clone() for p in parameters],
    }


def rows_of(rank: int) -> torch.Tensor:
    """Environments of a rank, so that a minibatch of one process is the union of the ranks' minibatches."""
    return torch.arange(SPEC.env.envs).view(SPEC.ppo.minibatches, PROCESSES, -1)[:, rank].flatten()


def save_rollout(path: Path, ppo: BoundedPPO, obs: TensorDict) -> None:
    storage = ppo.storage
    content = {name: getattr(storage, name) for name in OF_ROLLOUT}
    content |= {"parameters": list(storage.distribution_params), "memory": storage._first_hidden}
    content |= {"observations": dict(storage.observations), "last": dict(obs)}
    content |= {"actor": ppo.actor.state_dict(), "critic": ppo.critic.state_dict()}
    torch.save(content, path)


def load_rollout(path: Path, ppo: BoundedPPO, rows: torch.Tensor) -> TensorDict:
    saved, storage = torch.load(path), ppo.storage
    ppo.actor.load_state_dict(saved["actor"])
    ppo.critic.load_state_dict(saved["critic"])
    for name in OF_ROLLOUT:
        setattr(storage, name, saved[name][:, rows])
    storage.distribution_params = tuple(p[:, rows] for p in saved["parameters"])
    storage._first_hidden, storage.step = saved["memory"][:, rows], SPEC.ppo.steps
    seen = {name: value[:, rows] for name, value in saved["observations"].items()}
    storage.observations = TensorDict(seen, batch_size=[SPEC.ppo.steps, len(rows)])
    return TensorDict({name: value[rows] for name, value in saved["last"].items()}, batch_size=[len(rows)])


def work(folder: Path) -> None:
    """In each of the processes."""
    with ranks.joined("cpu"):
        rank = ranks.rank()
        world = build(WORLD, folder)
        torch.manual_seed(rank)
        ppo, _ = learner(world, spec_of(SPEC.env.envs // PROCESSES))
        with full_precision():
            torch.save(update(ppo, load_rollout(folder / "rollout", ppo, rows_of(rank))), folder / f"update-{rank}")
        divergence = Divergence(KickstartSpec(teacher="rom"))
        divergence._sums += torch.tensor([[3.0, 0.0, 1.0], [1.0 + rank, 0.0, 1.0]])
        torch.save(divergence.by_place(), folder / f"places-{rank}")

        def run(name: str, spec: NavigationSpec = SPEC, told: Callable[[int], None] = lambda done: None) -> str:
            steps = spec.env.envs * spec.ppo.steps
            try:
                train(spec, world, FakePerception(), folder / name, 1, progress=lambda n, total, _: told(n // steps))
            except (RomnavError, Stopped) as stopped:
                return str(stopped) or type(stopped).__name__
            return ""

        def end_the_second(done: int) -> None:
            if done == 2 and rank == 1:
                signal.raise_signal(signal.SIGTERM)

        said = [run("whole"), run("stopped", told=end_the_second)]
        said += [run("odd", spec_of(13)), run("few", spec_of(4))]
        if rank == 0:
            (folder / "checkpoint.pt").write_bytes((folder / "stopped" / "checkpoint.pt").read_bytes())
        said.append(run("stopped"))
        torch.save(said, folder / f"said-{rank}")
        assert rank == 0 or ranks.hear() is None


def together(script: str) -> None:
    """Runs a script in processes with the variables that torchrun gives them."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    shared = {"WORLD_SIZE": str(PROCESSES), "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    shared |= {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(Path(__file__).parents[1])}
    running = [
        subprocess.Popen([sys.executable, "-c", script], env={**os.environ, **shared, "RANK": str(rank)})
        for rank in range(PROCESSES)
    ]
    assert [process.wait(300) for process in running] == [0] * PROCESSES


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what one process and two have made of the same rollout, and what two have trained."""
    folder = tmp_path_factory.mktemp("ranks")
    world = build(WORLD, folder)
    torch.manual_seed(0)
    ppo, env = learner(world, SPEC)
    with full_precision():
        obs = rollout(ppo, env)
        save_rollout(folder / "rollout", ppo, obs)
        torch.save(update(ppo, obs), folder / "alone")
    together(f"from pathlib import Path; from tests.test_ranks import work; work(Path({str(folder)!r}))")
    return folder


def of_both(folder: Path, name: str) -> list[Any]:
    return [torch.load(folder / f"{name}-{rank}") for rank in range(PROCESSES)]


def test_two_processes_update_as_one_does_on_all_of_the_rollout(made: Path) -> None:
    alone, both = torch.load(made / "alone"), of_both(made, "update")
    assert any(gradient.abs().max() > 0.01 for gradient in alone["gradients"])
    for one in both:
        torch.testing.assert_close(one["gradients"], alone["gradients"], rtol=1e-4, atol=1e-6)
        torch.testing.assert_close(one["seen"], alone["seen"])
        assert one["losses"] == pytest.approx(alone["losses"], rel=1e-3, abs=1e-4)
        assert one["rate"] == pytest.approx(alone["rate"], rel=1e-6)


def test_they_agree_to_the_bit(made: Path) -> None:
    first, second = of_both(made, "update")
    assert first["losses"] == second["losses"]
    assert first["rate"] == second["rate"]
    for a, b in zip(first["weights"], second["weights"], strict=True):
        assert torch.equal(a, b)
    places = of_both(made, "places")
    assert places[0]["divergence_same"] == 2.0
    assert places[0]["divergence_same"] == places[1]["divergence_same"]


def test_a_stopped_run_goes_on_to_the_same_bits(made: Path) -> None:
    """One of the processes was told to end: both stopped after that iteration, with a checkpoint of both."""
    for said in of_both(made, "said"):
        assert said[:2] == ["", "Stopped"]
        assert said[4] == ""
    whole, stopped = (checkpoint.read(made / name / "policy.pt") for name in ("whole", "stopped"))
    assert whole["processes"] == PROCESSES
    for name, value in whole["actor"].items():
        assert torch.equal(value, stopped["actor"][name]), name
    curves = [list(csv.DictReader((made / name / "curve.csv").open())) for name in ("whole", "stopped")]
    assert len(curves[0]) == SPEC.ppo.iterations
    for row, again in zip(*curves, strict=True):
        assert {**row, "seconds": "", "cpu_seconds": ""} == {**again, "seconds": "", "cpu_seconds": ""}
    assert sorted(kept.name for kept in (made / "whole" / "kept").iterdir()) == ["000002.pt", "000004.pt"]


def test_what_cannot_be_shared_is_refused(made: Path) -> None:
    for said in of_both(made, "said"):
        assert "navigation.env.envs: 13 in 3 minibatches (ppo.minibatches) cannot be shared by 2 processes" in said[2]
        assert "navigation.env.envs: 4 in 3 minibatches" in said[3]


def test_another_number_of_processes_does_not_go_on(made: Path) -> None:
    with pytest.raises(RomnavError, match=r"checkpoint\.pt: belongs to a run of 2 processes, and here are 1; start as"):
        train(SPEC, build(WORLD, made), FakePerception(), made, 1)


LEAVE = """
from pathlib import Path
from romnav import ranks
with ranks.joined("cpu"):
    from romnav.navigation import train
    assert ranks.rank() == 0 or ranks.hear() is None
threads = [(task / "comm").read_text() for task in Path("/proc/self/task").iterdir()]
assert not [name for name in threads if "gloo" in name], threads
"""
"""Joins before it imports what trains, as the command line does."""


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="Linux names a process's threads there")
def test_no_thread_of_the_group_outlives_it() -> None:
    """One that does may be at work when Python ends, which aborts the process."""
    together(LEAVE)


def test_variables_without_the_rest_are_one_clear_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WORLD_SIZE", "2")
    with (
        pytest.raises(RomnavError, match=r"^2 processes \(WORLD_SIZE\): .*; start them by torchrun$"),
        ranks.joined("cpu"),
    ):
        pass
    with pytest.raises(RomnavError, match="--device cuda:1: several processes have one each"), ranks.joined("cuda:1"):
        pass
