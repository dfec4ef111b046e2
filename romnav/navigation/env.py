"""The navigation task as a vectorised environment: one task, whichever body it drives (paper, Sec. III-D)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict
from torch import Tensor

from romnav import random, ranks
from romnav.navigation.observations import ACTIONS, Perceive, PrivilegedObservation, observe, wrap
from romnav.navigation.rewards import Transition, terms, weights
from romnav.navigation.spec import CommandSpec, EnvSpec
from romnav.robot.dynamics import Dynamics
from romnav.world.lookup import GeodesicLookup
from romnav.world.spawns import Start, is_cross_level, sample
from romnav.world.world import World


def to_command(actions: Tensor, spec: CommandSpec) -> Tensor:
    """Velocity command (E, 3) in m/s and rad/s of actions (E, 3): [-1, 1] spans the limits linearly, others are cut.

    A policy that knows nothing yet therefore drifts forward, at the middle of [-reverse, forward], and gets about.
    """
    actions = actions.clamp(-1.0, 1.0)
    forward = 0.5 * (spec.forward - spec.reverse + actions[:, 0] * (spec.forward + spec.reverse))
    return torch.stack([forward, actions[:, 1] * spec.lateral, actions[:, 2] * spec.turn], dim=1)


@dataclass
class Statistics:
    """Finished episodes since the last call of `NavigationEnv.statistics`."""

    episodes: int
    success: float
    """Share that arrived, NaN if none finished; ``same`` and ``cross`` likewise by level."""
    same: float
    cross: float
    reward: dict[str, float]
    """Mean reward per step of every term, weighted."""


class NavigationEnv(VecEnv):
    """``E`` robots that walk to goals. Observations: those of `observe`, and "critic".

    Every random choice is a function of (seed, environment, episode or step), so that environments are independent
    of each other and a restored run continues as if it had never stopped.
    """

    def __init__(
        self,
        world: World,
        dynamics: Dynamics,
        perceive: Perceive,
        spec: EnvSpec,
        seed: int,
        device: str,
        numbers: range | None = None,
    ) -> None:
        """
        Args:
            world: Terrain.
            dynamics: The robots, one for each environment.
            perceive: Their sensors.
            spec: The task.
            seed: Of everything that is drawn.
            device: Torch device.
            numbers: Of the environments, which their draws depend on, where others are elsewhere; default: all of the
                spec.
        """
        numbers = numbers or range(spec.envs)
        self.world = world
        self.dynamics = dynamics
        self.perceive = perceive
        self.spec = spec
        self.cfg = spec.model_dump()
        self.seed = seed
        self.device = device
        self.num_envs = count = len(numbers)
        self.num_actions = ACTIONS
        self.max_episode_length = round(spec.duration / spec.period)
        self.progress = 0.0
        """Share of the training run that is done; sets the scheduled weights."""
        self._lookup = GeodesicLookup(world)
        self._privileged = PrivilegedObservation(world)
        self._connector = torch.from_numpy(np.concatenate([grid.connector for grid in world.grids])).to(device)
        self._number = torch.arange(numbers.start, numbers.stop, device=device)
        self._episode = torch.zeros_like(self._number)
        self._step = 0
        self.episode_length_buf = torch.zeros_like(self._number)
        self._goal = torch.zeros_like(self._number)
        self._goal_position = torch.zeros(count, 3, device=device)
        self._goal_yaw = torch.zeros(count, device=device)
        self._command = torch.zeros(count, ACTIONS, device=device)
        self._best = torch.zeros(count, 2, device=device)
        self._since_arrival = torch.full_like(self._number, -1)
        self._since_best = torch.zeros_like(self._number)
        self._cross = torch.zeros(count, dtype=torch.bool, device=device)
        self._geodesic = torch.zeros(count, device=device)
        self._direction = torch.zeros(count, 2, device=device)
        self._finished = torch.zeros(4, dtype=torch.float64, device=device)
        self._reward_sums = torch.zeros(len(weights(spec.reward, 0.0)), dtype=torch.float64, device=device)
        self._reward_steps = 0
        self.restart(torch.arange(count, device=device))
        # spread over the episode: environments that all end at once make every rollout a different task
        spread = random.uniform(seed, self._number, 0xA6E)
        self.episode_length_buf = (spread * self.max_episode_length).long()

    def state_dict(self) -> dict[str, Any]:
        """Everything that changes while stepping."""
        return {
            "progress": self.progress,
            "step": self._step,
            "length": self.episode_length_buf.clone(),
            "reward_steps": self._reward_steps,
            **{name: getattr(self, name).clone() for name in self._TENSORS},
            **{f"dynamics.{name}": value for name, value in self.dynamics.state_dict().items()},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue where `state_dict` was taken."""
        self.progress, self._step = state["progress"], state["step"]
        self.episode_length_buf = state["length"].clone()
        self._reward_steps = state["reward_steps"]
        for name in self._TENSORS:
            setattr(self, name, state[name].clone())
        of_dynamics = {k.removeprefix("dynamics."): v for k, v in state.items() if k.startswith("dynamics.")}
        self.dynamics.load_state_dict(of_dynamics)
        self._geodesic, self._direction = self._measure()

    _TENSORS = (
        "_episode",
        "_goal",
        "_goal_position",
        "_goal_yaw",
        "_command",
        "_best",
        "_since_arrival",
        "_since_best",
        "_cross",
        "_finished",
        "_reward_sums",
    )

    def get_observations(self) -> TensorDict:
        """Observations of the present state."""
        d = self.dynamics
        counters = torch.stack([self._number, torch.full_like(self._number, self._step)], dim=1)
        d_max = self.spec.max_goal_distance
        seen = observe(d, self._goal_position, self._goal_yaw, self._command, counters, self.perceive, d_max)
        remaining = 1.0 - self.episode_length_buf / self.max_episode_length
        privileged = self._privileged(
            d.tile,
            d.layer,
            d.position,
            d.yaw,
            self._geodesic,
            self._best[:, 0],
            self._direction,
            remaining,
            (self._since_arrival >= 0).to(torch.float32),
            self._cross.to(torch.float32),
        )
        seen["critic"] = torch.cat([seen["state"], privileged], dim=1)
        return seen

    def places(self) -> Tensor:
        """(E, 2) bool: the goal is across levels; the robot is on a stair or ramp."""
        d = self.dynamics
        node = self.world.node_at(d.tile, d.layer, d.position[:, :2])
        return torch.stack([self._cross, (node >= 0) & self._connector[node.clamp(min=0)]], dim=1)

    @property
    def arrived(self) -> Tensor:
        """(E,) bool the goal has been reached in this episode."""
        return self._since_arrival >= 0

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict[str, Tensor]]:
        """Drive all robots for one period; finished ones start anew before they are observed."""
        reward, fallen, timeout = self.advance(actions)
        done = timeout | fallen
        ended = done.nonzero()[:, 0]
        self.restart(ended)
        return self.get_observations(), reward, done, {"time_outs": timeout}

    def advance(self, actions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Drive all robots for one period: rewards (E,), and whether the episode ended in a fall or was truncated."""
        command = to_command(actions, self.spec.command)
        self.dynamics.step(command)
        self._step += 1
        self.episode_length_buf = self.episode_length_buf + 1
        self._geodesic, self._direction = self._measure()
        reward = self._reward(command)
        self._command = command
        offset = self._goal_position - self.dynamics.position
        here = torch.linalg.vector_norm(offset, dim=1) < self.spec.reach
        waiting = self._since_arrival >= 0
        self._since_arrival = torch.where(waiting | here, self._since_arrival + 1, self._since_arrival)
        fallen = self.dynamics.fallen.clone()
        stayed = self._since_arrival * self.spec.period >= self.spec.stay
        stalled = (self._since_best * self.spec.period >= self.spec.patience) & (self._since_arrival < 0)
        timeout = ((self.episode_length_buf >= self.max_episode_length) | stayed | stalled) & ~fallen
        self._count(timeout | fallen)
        return reward, fallen, timeout

    def statistics(self) -> Statistics:
        """Statistics of the episodes that finished since the last call, of all processes."""
        same, same_success, cross, cross_success = ranks.total(self._finished).tolist()
        rewards = (ranks.total(self._reward_sums) / max(ranks.size() * self._reward_steps, 1)).tolist()
        self._finished = torch.zeros_like(self._finished)
        self._reward_sums = torch.zeros_like(self._reward_sums)
        self._reward_steps = 0

        def share(part: float, whole: float) -> float:
            return part / whole if whole else float("nan")

        return Statistics(
            episodes=int(same + cross),
            success=share(same_success + cross_success, same + cross),
            same=share(same_success, same),
            cross=share(cross_success, cross),
            reward=dict(zip(weights(self.spec.reward, 0.0), rewards, strict=True)),
        )

    def _measure(self) -> tuple[Tensor, Tensor]:
        d = self.dynamics
        return self._lookup(d.tile, d.layer, d.position[:, :2], self._goal)

    def _measure_of(self, envs: Tensor) -> tuple[Tensor, Tensor]:
        """Of the robots ``envs`` (K,) where their bodies are: a gait's placement is up to 0.3 m from the start."""
        d = self.dynamics
        return self._lookup(d.tile[envs], d.layer[envs], d.position[envs, :2], self._goal[envs])

    def _reward(self, command: Tensor) -> Tensor:
        offset = self._goal_position - self.dynamics.position
        height = offset[:, 2].abs()
        step = Transition(
            planar=torch.linalg.vector_norm(offset[:, :2], dim=1),
            geodesic=self._geodesic,
            best_geodesic=self._best[:, 0],
            heading_error=wrap(self._goal_yaw - self.dynamics.yaw),
            height_error=height,
            best_height_error=self._best[:, 1],
            command=command,
            previous=self._command,
            contacts=self.dynamics.contacts,
        )
        values = terms(step, self.spec.reward, self.spec.period)
        scale = weights(self.spec.reward, self.progress)
        weighted = torch.stack([scale[name] * values[name] for name in scale])
        nearer = self._geodesic < self._best[:, 0]
        self._since_best = torch.where(nearer, 0, self._since_best + 1)
        self._best = torch.minimum(self._best, torch.stack([self._geodesic, height], dim=1))
        self._reward_sums += weighted.mean(dim=1).double()
        self._reward_steps += 1
        return weighted.sum(dim=0)

    def _count(self, done: Tensor) -> None:
        arrived = (self._since_arrival >= 0).double()
        ended = done.double()
        same, cross = ended * (~self._cross).double(), ended * self._cross.double()
        self._finished += torch.stack([same.sum(), (same * arrived).sum(), cross.sum(), (cross * arrived).sum()])

    def restart(self, envs: Tensor) -> None:
        """Put the robots ``envs`` (K,) at the starts of their next episodes."""
        if len(envs) == 0:
            return
        number, episode = self._number[envs], self._episode[envs]
        tile = random.integers(len(self.world.tiles), self.seed, number, episode, 0x711E)
        self._start(envs, sample(self.world, self.spec.sampler, self.seed, tile, number, episode))
        self._episode[envs] += 1

    def _start(self, envs: Tensor, start: Start) -> None:
        d = self.dynamics
        d.reset(envs, start)
        self._goal[envs] = start.goal
        self._geodesic[envs], self._direction[envs] = self._measure_of(envs)
        self._goal_position[envs] = self.world.position[self.world.goal[start.goal]]
        self._goal_yaw[envs] = start.goal_yaw
        self._command[envs] = 0.0
        self._since_arrival[envs] = -1
        self._since_best[envs] = 0
        self.episode_length_buf[envs] = 0
        height = (self._goal_position - d.position)[envs, 2].abs()
        self._best[envs] = torch.stack([self._geodesic[envs], height], dim=1)
        self._cross[envs] = is_cross_level(d.position[envs, 2], self._goal_position[envs, 2])
