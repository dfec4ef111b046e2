"""Stable-Baselines3's PPO on romnav's task.

pip install 'romnav[gym]' stable-baselines3
python examples/stable_baselines.py
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv

import romnav.gym


class SB3Env(VecEnv):
    """A vector environment of Gymnasium that starts anew in the same step, as Stable-Baselines3 wants it."""

    def __init__(self, env: Any) -> None:
        self.env = env
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)
        self._actions = np.zeros((env.num_envs, 3), np.float32)

    def reset(self) -> Any:
        """First observations; a seed set by `seed` holds for the next call."""
        seed = next((seed for seed in self._seeds if seed is not None), None)
        self._reset_seeds()
        return self.env.reset(seed=seed)[0]

    def step_async(self, actions: np.ndarray) -> None:
        """Take the actions."""
        self._actions = actions

    def step_wait(self) -> Any:
        """Make the step."""
        seen, reward, ended, truncated, info = self.env.step(self._actions)
        done = ended | truncated
        told: list[dict[str, Any]] = [{"is_success": bool(success)} for success in info["is_success"]]
        for row in np.flatnonzero(done):
            told[row] |= {"terminal_observation": info["final_obs"][row], "TimeLimit.truncated": bool(truncated[row])}
        return seen, reward.astype(np.float32), done, told

    def close(self) -> None:
        """End."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """The same of all."""
        return [getattr(self.env, attr_name, None)] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Of all at once."""
        setattr(self.env, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **settings: Any) -> list[Any]:
        """The same of all."""
        return [getattr(self.env, method_name)(*args, **settings)] * self.num_envs

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """None is."""
        return [False] * self.num_envs


def main() -> None:
    """Train for 100,000 steps on range images."""
    env = SB3Env(gymnasium.make_vec(romnav.gym.ID, num_envs=64, sight="lidar"))
    PPO("MultiInputPolicy", env, n_steps=64, batch_size=512, gamma=0.995, verbose=1).learn(100_000)


if __name__ == "__main__":
    main()
