"""The task as other learners meet it."""

from __future__ import annotations

import shutil
import warnings
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import romnav.gym
from romnav.errors import RomnavError

ROOT = Path(__file__).parents[2]
SCALE = """
[world]
tiles = 2
side = 20.0
goals_per_tile = 8
[lidar]
rows = 15
columns = 55
[navigation.env]
duration = 2.0
"""


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("gym")
    (root / "experiments" / "scales").mkdir(parents=True)
    (root / "experiments" / "scales" / "smoke.toml").write_text(SCALE)
    shutil.copy(ROOT / "experiments" / "spawn-goal.toml", root / "experiments")
    return root


def vector(project: Path, envs: int, **arguments: Any) -> Any:
    return gymnasium.make_vec(romnav.gym.ID, num_envs=envs, project=project, **arguments)


def test_it_is_as_gymnasium_asks(project: Path) -> None:
    env = gymnasium.make(romnav.gym.ID, project=project, sight=("lidar", "depth"))
    assert env.observation_space["lidar"].shape == (15, 55)  # type: ignore[index]
    assert env.observation_space["depth"].shape == (26, 30)  # type: ignore[index]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped, skip_render_check=True)


def test_a_seed_is_a_life(project: Path) -> None:
    env = vector(project, 3)
    lives = []
    for _ in range(2):
        seen, _ = env.reset(seed=7)
        rewards = [seen["lidar"].sum()]
        for step in range(12):  # beyond the end of the first episodes
            seen, reward, *_ = env.step(np.full((3, 3), 0.1 * step - 0.5, np.float32))
            rewards += [*reward, seen["lidar"].sum()]
        lives.append(rewards)
    assert lives[0] == lives[1]
    assert env.reset(seed=8)[0]["lidar"].sum() != lives[0][0]


def test_ended_episodes_tell_what_they_saw_last(project: Path) -> None:
    env = vector(project, 2)
    assert env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    env.reset(seed=0)
    before = None
    for step in range(1, 11):
        seen, _, ended, truncated, info = env.step(np.tile(np.array([-1 / 3, 0.0, 0.0], np.float32), (2, 1)))
        assert not ended.any()
        assert truncated.all() == (step == 10)  # 2 s at 5 Hz
        if step == 9:
            before = seen["state"][0, :6]
    last = info["final_obs"][0]["state"][:6]
    np.testing.assert_allclose(last, before, atol=1e-6)  # it stood
    assert not np.allclose(seen["state"][0, :6], last)
    assert info["_final_obs"].all()


def test_one_robot_is_the_first_of_many(project: Path) -> None:
    one, many = gymnasium.make(romnav.gym.ID, project=project), vector(project, 3)
    a, b = one.reset(seed=3)[0], many.reset(seed=3)[0]
    for _ in range(5):
        np.testing.assert_allclose(a["lidar"], b["lidar"][0])
        action = np.array([0.9, -0.2, 0.4], np.float32)
        a, reward, *_ = one.step(action)
        b, rewards, *_ = many.step(np.tile(action, (3, 1)))
        assert reward == pytest.approx(rewards[0])


def test_the_episodes_of_one_robot_are_those_of_the_first_of_many(project: Path) -> None:
    one, many = gymnasium.make(romnav.gym.ID, project=project), vector(project, 2)
    a, b = one.reset(seed=3)[0], many.reset(seed=3)[0]
    for _ in range(25):  # an episode has ten steps
        np.testing.assert_array_equal(a["state"], b["state"][0])
        a, _, ended, truncated, _ = one.step(np.zeros(3, np.float32))
        b, *_ = many.step(np.zeros((2, 3), np.float32))
        if ended or truncated:
            a, _ = one.reset()


def test_the_share_of_the_run_sets_the_weights_that_switch(project: Path) -> None:
    rewards = []
    for progress in (0.0, 1.0):
        env = vector(project, 2)
        env.unwrapped.progress = progress
        env.reset(seed=3)
        rewards.append(env.step(np.ones((2, 3), np.float32))[1])
    assert (rewards[1] < rewards[0]).all()  # a change of the command costs more


def test_an_arm_brings_its_settings(project: Path) -> None:
    env = vector(project, 1, arm="uniform")
    assert env.unwrapped._env.spec.sampler.stair_probability == 0.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"sight": "smell"}, "sight: unknown smell; there are lidar, depth, tokens"),
        ({"arm": "unifrom"}, "unknown arm unifrom; did you mean uniform"),
        ({"sight": "tokens"}, "encoder.pt: no such encoder.*romnav train encoder"),
    ],
)
def test_mistakes_are_one_clear_line(project: Path, arguments: dict[str, str], message: str) -> None:
    with pytest.raises(RomnavError, match=message):
        vector(project, 1, **arguments)


@pytest.mark.slow
def test_stable_baselines_trains_on_it(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """10,000 steps of PPO on range images."""
    import stable_baselines3

    monkeypatch.syspath_prepend(ROOT)
    from examples.stable_baselines import SB3Env

    torch.set_num_threads(1)
    env = SB3Env(vector(project, 16))
    learner = stable_baselines3.PPO(
        "MultiInputPolicy", env, n_steps=64, batch_size=256, n_epochs=2, seed=0, device="cpu"
    )
    before = {k: v.clone() for k, v in learner.policy.state_dict().items()}
    learner.learn(10_000)
    assert learner.num_timesteps >= 10_000
    after = learner.policy.state_dict()
    assert all(bool(v.isfinite().all()) for v in after.values())
    assert any(not torch.equal(v, before[k]) for k, v in after.items())
