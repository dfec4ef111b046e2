"""The navigation task as Gymnasium's environments, one robot or many."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal, get_args

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box, Dict
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from torch import Tensor

from romnav.errors import RomnavError
from romnav.experiment.kinds.encoder import encoder
from romnav.experiment.kinds.locomotion import body
from romnav.experiment.kinds.policy import DEPTH_NOISE, eye
from romnav.experiment.project import Project
from romnav.experiment.scales import Scale
from romnav.experiment.workspace import Workspace
from romnav.navigation.env import NavigationEnv
from romnav.navigation.observations import ACTIONS
from romnav.navigation.perception import Eye
from romnav.robot.dynamics import Dynamics
from romnav.world.build import build

Sight = Literal["lidar", "depth", "tokens"]
"""Range images, depth images, or the range image as tokens of the scale's pretrained encoder."""
MOST = 1e6
"""Bound of numbers that have none."""

Observation = dict[str, NDArray[np.float32]]


class RoMVectorEnv(VectorEnv[Observation, NDArray[np.float32], NDArray[Any]]):
    """Robots that walk to goals, all in one batch: the environment that romnav's own policies are trained in.

    Observations are a dictionary: "state" (9 + P,), as `romnav.navigation.observations.observe` describes it, and what
    is seen of `Sight`. Actions (3,) in [-1, 1] span the limits of the command: forward, left, turn. A fall terminates
    an episode; the end of its time, of the stay at the goal or of the patience truncates it. ``info["is_success"]``
    tells whether the goal has been reached. Robots that are done start anew in the same step; what they last saw is
    ``info["final_obs"]``.

    Args:
        num_envs: Robots.
        arm: Whose settings the task has; those of the scale without one.
        scale: As for the command line.
        sight: What is observed beside the state.
        project: Folder with experiments/; default: around the current folder.
        device: Where the world is.

    Raises:
        RomnavError: There is no such arm, scale or encoder.
    """

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012 - Gymnasium's

    def __init__(
        self,
        num_envs: int = 1,
        arm: str | None = None,
        scale: str = "smoke",
        sight: Sequence[Sight] | Sight = ("lidar",),
        project: Path | None = None,
        device: str = "cpu",
    ) -> None:
        work = Workspace(Project.here() if project is None else Project(project, project / "results"), scale)
        settings = work.settings if arm is None else work.arm_settings(arm)
        seen: tuple[Sight, ...] = (sight,) if isinstance(sight, str) else tuple(sight)
        if unknown := set(seen) - set(get_args(Sight)):
            raise RomnavError(f"sight: unknown {', '.join(sorted(unknown))}; there are {', '.join(get_args(Sight))}")
        self._world = build(settings.ground, work.project.worlds).to(device)
        self._device = device
        self._eyes = {name: self._eye(work, settings, name) for name in seen}
        self._body = partial(body, work, settings, device=device, threads=torch.get_num_threads())
        self._task = settings.navigation.env.model_copy(update={"envs": num_envs})
        self.num_envs = num_envs
        self.progress = 0.0
        """Share of the training run that is done: it sets the weights of the reward that change on the way."""
        self._env = self._make(0)
        self.single_action_space = Box(-1.0, 1.0, (ACTIONS,), np.float32)
        self._spaces = self._bounds(settings, self._env.dynamics)
        self.single_observation_space = Dict({**self._spaces})
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start all episodes anew; with a seed, those of that seed from the first one on, sensor noise included."""
        super().reset(seed=seed if seed is None or isinstance(seed, int) else seed[0])
        if seed is not None:
            number = seed if isinstance(seed, int) else hash(tuple(seed)) & 0x7FFFFFFF
            self._env = self._make(number)
        else:
            self._env.restart(torch.arange(self.num_envs, device=self._device))
        self._env.episode_length_buf = torch.zeros_like(self._env.episode_length_buf)
        return self._observe(), {"is_success": np.zeros(self.num_envs, bool)}

    def step(
        self, actions: NDArray[np.float32]
    ) -> tuple[Observation, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """One control period."""
        with torch.no_grad():
            self._env.progress = self.progress
            action = torch.as_tensor(actions, dtype=torch.float32, device=self._device).clamp(-1.0, 1.0)
            reward, fallen, timeout = self._env.advance(action)
            info: dict[str, Any] = {
                "is_success": self._env.arrived.cpu().numpy(),
                "_is_success": np.ones(self.num_envs, bool),
            }
            done = (fallen | timeout).nonzero()[:, 0]
            observed = self._observe()
            if len(done):
                info |= self._final(observed, done.cpu().numpy(), info["is_success"])
                self._env.restart(done)
                observed = self._observe()
        ended, truncated = fallen.cpu().numpy(), timeout.cpu().numpy()
        return observed, reward.double().cpu().numpy(), ended, truncated, info

    def _make(self, seed: int) -> NavigationEnv:
        """The task with robots of its own: what a humanoid has been through would go on with it."""
        dynamics = self._body(seed=seed)(self._world, self.num_envs, self._task.period)
        return NavigationEnv(self._world, dynamics, self._perceive, self._task, seed=seed, device=self._device)

    def _final(self, observed: Observation, done: NDArray[np.intp], success: NDArray[np.bool_]) -> dict[str, Any]:
        last = np.full(self.num_envs, None, object)
        for row in done:
            last[row] = {name: value[row] for name, value in observed.items()}
        mask = np.zeros(self.num_envs, bool)
        mask[done] = True
        return {
            "final_obs": last,
            "_final_obs": mask,
            "final_info": {"is_success": success & mask, "_is_success": mask},
            "_final_info": mask,
        }

    def _observe(self) -> Observation:
        seen = self._env.get_observations()
        return {
            name: np.clip(seen[name].float().cpu().numpy(), space.low, space.high)
            for name, space in self._spaces.items()
        }

    def _eye(self, work: Workspace, settings: Scale, name: Sight) -> Eye:
        sensor = "depth" if name == "depth" else "lidar"
        pretrained = encoder(work, sensor, settings) if name == "tokens" else None
        noise = DEPTH_NOISE if name == "depth" else 0
        return eye(work, settings, sensor, pretrained, 0, self._world, noise, self._device)

    def _perceive(self, robot: Dynamics, counters: Tensor) -> dict[str, Tensor]:
        seen: dict[str, Tensor] = {}
        for name, one in self._eyes.items():
            ranges = one.ranges(robot, counters)
            seen[name] = one.encoder.tokens(ranges) if name == "tokens" else ranges
        return seen

    def _bounds(self, settings: Scale, dynamics: Dynamics) -> dict[str, Box]:
        env, side = settings.navigation.env, settings.world.side
        away, high = math.sqrt(2.0) * side, 10.0 * settings.world.storey_height
        command = (max(env.command.forward, env.command.reverse), env.command.lateral, env.command.turn)
        felt = [MOST] * dynamics.proprioception.shape[1]
        most = np.array([away, away, MOST, high, 1.0, 1.0, *command, *felt], np.float32)
        spaces: dict[str, Box] = {"state": Box(-most, most)}
        for name, one in self._eyes.items():
            if name == "tokens":
                spaces[name] = Box(-MOST, MOST, one.encoder.token_shape, np.float32)
            else:
                farthest = 2.0 * one.sensor.spec.max_range
                spaces[name] = Box(0.0, farthest, one.sensor.directions.shape[:2], np.float32)
        return spaces


class RoMEnv(gymnasium.Env[Observation, NDArray[np.float32]]):
    """One robot of `RoMVectorEnv`, whose arguments it takes but for ``num_envs``."""

    metadata = {"render_modes": []}  # noqa: RUF012 - Gymnasium's

    def __init__(self, **arguments: Any) -> None:
        self._of = RoMVectorEnv(1, **arguments)
        self.action_space = self._of.single_action_space
        self.observation_space = self._of.single_observation_space
        self._next: Observation | None = None
        """What the robot saw first of the episode that began when the last one ended."""

    @property
    def progress(self) -> float:
        """As of `RoMVectorEnv`."""
        return self._of.progress

    @progress.setter
    def progress(self, share: float) -> None:
        self._of.progress = share

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode."""
        super().reset(seed=seed)
        observed, self._next = self._next, None
        if observed is None or seed is not None:
            observed, _ = self._of.reset(seed=seed)
        return _first(observed), {"is_success": False}

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """One control period."""
        observed, reward, ended, truncated, info = self._of.step(np.asarray(action)[None])
        self._next = observed if "final_obs" in info else None
        last = info["final_obs"][0] if "final_obs" in info else _first(observed)
        return last, float(reward[0]), bool(ended[0]), bool(truncated[0]), {"is_success": bool(info["is_success"][0])}


def _first(observed: Observation) -> Observation:
    return {name: value[0] for name, value in observed.items()}
