from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict

from romnav.evaluation import episodes
from romnav.evaluation.paired.expected import Expected
from romnav.evaluation.rollout import View
from romnav.navigation.env import NavigationEnv, to_command
from romnav.navigation.observations import PRIVILEGED_SIZE, STATE_SIZE, goal_observation
from romnav.navigation.spec import EnvSpec
from romnav.robot.rom import ReducedOrderModel
from romnav.world.build import build
from romnav.world.spawns import Start
from romnav.world.spec import WorldSpec

COUNT = 12


class Mirror:
    """A critic whose value is one number of its observation."""

    obs_dim = STATE_SIZE + PRIVILEGED_SIZE
    which = 0

    def __call__(self, obs: TensorDict) -> torch.Tensor:
        return obs["critic"][:, self.which : self.which + 1]


def test_the_critic_sees_what_it_saw_in_training() -> None:
    world = build(WorldSpec(tiles=1, seed=51, goals_per_tile=16))
    spec = EnvSpec(envs=COUNT)
    robot = ReducedOrderModel(world, COUNT, spec.period)
    env = NavigationEnv(world, robot, lambda robot, counters: {}, spec, 0, "cpu")
    env.episode_length_buf[:] = 0
    start = Start(robot.tile, robot.layer, robot.position[:, :2], robot.yaw, env._goal, env._goal_yaw)
    paired = episodes.of("test", world, start)
    view = View(world, paired, spec)
    robot.load_state_dict(view.robot.state_dict())  # sets of episodes are rounded
    env._goal_yaw = view.goal_yaw
    env._geodesic, env._direction = env._measure()
    env._best[:, 0] = env._geodesic
    critic: Any = Mirror()
    cross = torch.from_numpy(paired.cross)
    asked = [Expected(critic, view, cross, spec.duration) for _ in range(critic.obs_dim)]
    torch.manual_seed(0)
    for _ in range(6):
        trained_on = env.get_observations()["critic"]
        goal = goal_observation(
            view.robot.position, view.robot.yaw, view.goal_position, view.goal_yaw, spec.max_goal_distance
        )
        # what a humanoid feels comes last, and a critic of the reduced-order model does not read it
        state = torch.cat([goal, view.previous, torch.full((COUNT, 8), 9.0)], dim=1)
        for critic.which, expected in enumerate(asked):
            torch.testing.assert_close(expected(view, state), trained_on[:, critic.which], atol=1e-5, rtol=1e-5)
        actions = 2 * torch.rand(COUNT, 3) - 1
        env.advance(actions)
        view.previous = to_command(actions, spec.command)
        view.robot.step(view.previous)
        view.step += 1
        assert not env.arrived.any()
