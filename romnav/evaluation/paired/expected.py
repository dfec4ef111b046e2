"""What the privileged critic of a policy expects along episodes: the return from each step on."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import Tensor

from romnav.evaluation.rollout import View
from romnav.navigation.observations import PRIVILEGED_SIZE, PrivilegedObservation
from romnav.navigation.ppo import PrivilegedCritic


class Expected:
    """Asked once per step, in order, of the episodes of a view.

    Args:
        critic: Of the policy.
        view: All episodes, none of them ended.
        cross: (A,) bool, whether the goal is across levels.
        duration: Of an episode in training, s; who takes longer has no time left, as far as the critic knows.
    """

    def __init__(self, critic: PrivilegedCritic, view: View, cross: Tensor, duration: float) -> None:
        self._critic, self._cross, self._duration = critic, cross.float(), duration
        self._privileged = PrivilegedObservation(view.world)
        self._best = torch.full_like(view.robot.yaw, torch.inf)
        self._reads = critic.obs_dim - PRIVILEGED_SIZE

    def __call__(self, view: View, state: Tensor) -> Tensor:
        """(A,) expected returns where the policy observes ``state`` (A, S)."""
        robot = view.robot
        geodesic, direction = view.geodesic()
        self._best = torch.minimum(self._best, geodesic)
        left = max(1.0 - view.step * view.env.period / self._duration, 0.0)
        privileged = self._privileged(
            robot.tile,
            robot.layer,
            robot.position,
            robot.yaw,
            geodesic,
            self._best,
            direction,
            torch.full_like(robot.yaw, left),
            torch.zeros_like(robot.yaw),
            self._cross,
        )
        seen = torch.cat([state[:, : self._reads], privileged], dim=1)
        return self._critic(TensorDict({"critic": seen}, batch_size=[len(seen)]))[:, 0]
