from __future__ import annotations

from math import exp, hypot

import pytest
import torch
from tensordict import TensorDict

from romnav.navigation.env import NavigationEnv, to_command
from romnav.navigation.spec import CommandSpec, EnvSpec, NavigationSpec
from romnav.robot.rom import ReducedOrderModel
from romnav.world.spawns import Start
from romnav.world.world import World


def make(world: World, perception: object, spec: EnvSpec, seed: int = 3) -> NavigationEnv:
    return NavigationEnv(world, ReducedOrderModel(world, spec.envs, spec.period), perception, spec, seed, "cpu")


def actions(envs: int, step: int) -> torch.Tensor:
    return torch.rand(envs, 3, generator=torch.Generator().manual_seed(step)) * 2 - 1


def test_command_limits_are_the_papers() -> None:
    corner = torch.tensor([[1.0, 1.0, 1.0], [-1.0, -1.0, -1.0], [0.0, 0.0, 0.0]])
    expected = [[1.0, 0.25, 1.0], [-0.5, -0.25, -1.0], [0.25, 0.0, 0.0]]
    assert to_command(corner, CommandSpec()).tolist() == expected
    assert to_command(1.5 * corner, CommandSpec()).tolist() == expected


def test_same_seed_same_run(world: World, perception: object, spec: NavigationSpec) -> None:
    one, two = (make(world, perception, spec.env) for _ in range(2))
    for step in range(30):
        a, b = one.step(actions(12, step)), two.step(actions(12, step))
        assert torch.equal(a[1], b[1])
        for key, value in a[0].items():
            assert torch.equal(value, b[0][key])


def test_environments_are_independent_of_their_number(world: World, perception: object, spec: NavigationSpec) -> None:
    """Environment 3 of 12 lives the same life as environment 3 of 5, resets included."""
    few = spec.env.model_copy(update={"envs": 5})
    large, small = make(world, perception, spec.env), make(world, perception, few)
    for step in range(40):
        a = actions(12, step)
        obs_a, reward_a, done_a, _ = large.step(a)
        obs_b, reward_b, done_b, _ = small.step(a[:5])
        assert torch.equal(done_a[:5], done_b)
        torch.testing.assert_close(reward_a[:5], reward_b)
        torch.testing.assert_close(obs_a["critic"][:5], obs_b["critic"])


def test_restored_environment_goes_on_as_if_never_stopped(
    world: World, perception: object, spec: NavigationSpec
) -> None:
    env, other = make(world, perception, spec.env), make(world, perception, spec.env, seed=3)
    for step in range(10):
        env.step(actions(12, step))
    other.load_state_dict(env.state_dict())
    for key, value in env.get_observations().items():
        assert torch.equal(value, other.get_observations()[key])
    for step in range(10, 30):
        a, b = env.step(actions(12, step)), other.step(actions(12, step))
        assert torch.equal(a[1], b[1])
        assert torch.equal(a[0]["state"], b[0]["state"])
    assert repr(env.statistics()) == repr(other.statistics())


def test_timeouts_are_truncations_at_the_episode_length(world: World, perception: object, spec: NavigationSpec) -> None:
    env = make(world, perception, spec.env.model_copy(update={"stay": 100.0}))
    env.episode_length_buf[:] = 0
    for step in range(1, 21):
        _, _, done, extras = env.step(torch.zeros(12, 3))
        assert bool(done.all()) == (step == 20)  # 4 s at 5 Hz
        assert torch.equal(done, extras["time_outs"])
    assert env.episode_length_buf.eq(0).all()


def test_arrival_is_counted_and_truncated_after_the_stay(
    world: World, perception: object, spec: NavigationSpec
) -> None:
    env = make(world, perception, spec.env)
    env.episode_length_buf[:] = 0
    env.statistics()
    everyone = torch.arange(12)
    goal = torch.zeros(12, dtype=torch.int64)
    target = world.position[world.goal[0]].expand(12, 3)
    # start on top of the goal of the first tile
    env._start(
        everyone,
        Start(
            tile=torch.zeros(12, dtype=torch.int64),
            layer=world.layer[world.goal[goal]],
            xy=target[:, :2].clone(),
            yaw=torch.zeros(12),
            goal=goal,
            goal_yaw=torch.zeros(12),
        ),
    )
    ended = [int(env.step(torch.zeros(12, 3))[2].sum()) for _ in range(6)]
    assert ended == [0, 0, 0, 0, 0, 12]  # reached in the first step, then 1 s at 5 Hz
    statistics = env.statistics()
    assert (statistics.episodes, statistics.success) == (12, 1.0)


def test_stalled_episodes_are_truncated_after_the_patience(
    world: World, perception: object, spec: NavigationSpec
) -> None:
    env = make(world, perception, spec.env.model_copy(update={"duration": 45.0, "stay": 45.0, "patience": 2.0}))
    env.episode_length_buf[:] = 0
    still = torch.tensor([[-1 / 3, 0.0, 0.0]]).expand(12, 3)
    for step in range(1, 11):
        _, _, done, extras = env.step(still)
        assert bool(done.all()) == (step == 10)  # standing still, never nearer, 2 s at 5 Hz
        assert torch.equal(done, extras["time_outs"])


def test_reward_statistics_add_up(world: World, perception: object, spec: NavigationSpec) -> None:
    env = make(world, perception, spec.env)
    env.statistics()
    total = sum(env.step(actions(12, step))[1].mean().item() for step in range(5))
    assert sum(env.statistics().reward.values()) == pytest.approx(total / 5, rel=1e-4)


def test_environments_of_another_process_are_those_of_one(world: World, perception: object) -> None:
    """What is drawn depends on the number of an environment, not on its place in the batch."""
    spec = EnvSpec(envs=12, duration=2.0)

    def drive(numbers: range) -> list[TensorDict]:
        robots = ReducedOrderModel(world, len(numbers), spec.period)
        env = NavigationEnv(world, robots, perception, spec, 3, "cpu", numbers)
        return [env.step(torch.full((len(numbers), 3), 0.5))[0] for _ in range(15)]

    for whole, share in zip(drive(range(12)), drive(range(6, 12)), strict=True):
        for name, seen in share.items():
            assert torch.equal(seen, whole[name][6:]), name


class Puppet(ReducedOrderModel):
    """A body that goes where it is told to go next, whatever it is commanded."""

    def step(self, command: torch.Tensor) -> None:
        self.position, self.yaw = self.next_position.clone(), self.next_yaw.clone()
        self.contacts, self.fallen = self.next_contacts.clone(), self.next_fallen.clone()


def test_a_step_pays_what_the_papers_table_says(world: World, perception: object) -> None:
    """Four robots, all at (x, 0), whose way to the goal is as long as x: one beside its goal that turns to it, one that
    climbs, backs off and touches two bodies, one that stands on its goal but for the last decimetres, one that runs,
    and falls in the second step."""
    spec = EnvSpec(envs=4)
    body = Puppet(world, 4, spec.period)
    env = NavigationEnv(world, body, perception, spec, 3, "cpu")
    env._lookup = lambda tile, layer, xy, goal: (xy[:, 0].clone(), torch.ones(len(xy), 2))
    env._goal_position = torch.tensor([[1.0, 0.3, 2.0], [1.0, 0.0, 5.0], [0.0, 0.0, 2.0], [9.0, 3.0, 2.0]])
    env._goal_yaw = torch.tensor([3.0, 0.0, 0.0, 0.0])
    env._best = torch.tensor([[1.5, 0.25], [5.0, 3.0], [0.1, 0.25], [8.0, 0.0]])
    env._command = torch.tensor([[0.5, 0.1, -0.2], [0.25, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    env.episode_length_buf = torch.zeros(4, dtype=torch.long)
    body.next_position = torch.tensor([[1.44, 0.0, 1.75], [5.3, 0.0, 2.02], [0.06, 0.0, 1.75], [7.0, 0.0, 2.0]])
    body.next_yaw = torch.tensor([-3.0, 0.0, 0.4, 3.0])
    body.next_contacts = torch.tensor([0.0, 2.0, 0.0, 1.0])
    body.next_fallen = torch.zeros(4, dtype=torch.bool)
    # forward is 0.25 + 0.75 of the first action, m/s; sideways a quarter of the second; the turn is the third
    chosen = torch.tensor([[-0.2, 0.0, 0.0], [1.0, 1.0, -0.5], [-1 / 3, 0.0, 0.0], [1.0, 0.0, 0.0]])
    around = 2 * 3.141592653589793 - 6.0  # from -3 to 3 rad the short way round
    first = [
        {
            "position": 1 + exp(-((hypot(0.44, 0.3) / 0.5) ** 2)) + exp(-((hypot(0.44, 0.3) / 0.1) ** 2)),
            "heading": exp(-((around / 0.5) ** 2)),
            "height": exp(-((0.25 / 2.5) ** 2)) + exp(-((0.25 / 0.5) ** 2)),
            "stand": exp(-((0.1 / 0.1) ** 2)),
            "geodesic_progress": 0.06 / 0.15,  # of 0.75 m/s in 0.2 s
            "height_progress": 0.0,
            "collision": 0.0,
            "action_rate": 0.4**2 + 0.1**2 + 0.2**2,
        },
        {
            "position": 0.0,  # 5.3 m away by foot, beyond the gate of 2 m
            "heading": 0.0,
            "height": exp(-((2.98 / 2.5) ** 2)) + exp(-((2.98 / 0.5) ** 2)),
            "stand": 0.0,
            "geodesic_progress": 0.0,
            "height_progress": 0.02 / 0.05,  # of 0.25 m/s in 0.2 s
            "collision": 2.0,
            "action_rate": 0.75**2 + 0.25**2 + 0.5**2,
        },
        {
            "position": 1 + exp(-((0.06 / 0.5) ** 2)) + exp(-((0.06 / 0.1) ** 2)),
            "heading": exp(-((0.4 / 0.5) ** 2)),
            "height": exp(-((0.25 / 2.5) ** 2)) + exp(-((0.25 / 0.5) ** 2)),
            "stand": 1.0,
            "geodesic_progress": 0.04 / 0.08,  # of 80% of the 0.1 m that were left
            "height_progress": 0.0,
            "collision": 0.0,
            "action_rate": 0.0,
        },
        {
            "position": 0.0,
            "heading": 0.0,
            "height": 2.0,
            "stand": 0.0,
            "geodesic_progress": 1.0,  # 1 m, more than full
            "height_progress": 0.0,
            "collision": 1.0,
            "action_rate": 1.0,
        },
    ]
    # whoever stays where it was under the same command makes no progress and changes no command
    second = [{**robot, "geodesic_progress": 0.0, "height_progress": 0.0, "action_rate": 0.0} for robot in first]
    weights = {"position": 0.2, "heading": 0.2, "height": 0.2, "stand": 0.2}
    weights |= {"geodesic_progress": 0.1, "height_progress": 0.1, "collision": -1.0, "action_rate": -0.01}
    period = 0.2  # returns are integrals over time

    def paid(values: list[dict[str, float]]) -> list[float]:
        return [period * sum(weights[name] * value for name, value in robot.items()) for robot in values]

    env.statistics()
    reward, fallen, time_outs = env.advance(chosen)
    assert reward.tolist() == pytest.approx(paid(first), rel=1e-4)
    assert not fallen.any()
    assert not time_outs.any()

    body.next_fallen[3] = True
    env.episode_length_buf[[0, 3]] = env.max_episode_length - 1
    _, reward, done, extras = env.step(chosen)
    assert reward.tolist() == pytest.approx(paid(second), rel=1e-4)
    assert done.tolist() == [True, False, False, True]
    # a fall ends the episode, even in its last step: nothing is bootstrapped
    assert extras["time_outs"].tolist() == [True, False, False, False]

    means = {name: period * weights[name] * sum(robot[name] for robot in first + second) / 8 for name in weights}
    assert env.statistics().reward == pytest.approx(means, rel=1e-4)
