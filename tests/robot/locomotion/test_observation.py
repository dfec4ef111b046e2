"""What the policy observes, robot by robot, against the same written out in NumPy."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from romnav.robot.heights import HeightMap
from romnav.robot.locomotion.control import SCAN
from romnav.robot.locomotion.lane_task import LocomotionEnv
from romnav.robot.locomotion.mirror import MIRROR, reflect
from romnav.robot.locomotion.terrain import flat, stairs
from romnav.robot.spec import LocomotionSpec, TaskSpec


def expected(env: LocomotionEnv, i: int, command: NDArray, heights: NDArray) -> NDArray:
    """Of robot `i` over a ground of `heights` (40, 40), on cells of 0.1 m around the origin."""
    r, ref = env.robots, env.control.reference
    at, turn, sole = (x[i].double().numpy() for x in (r.pelvis, r.orientation, ref.sole))
    c, s = turn[:2, 0] / np.hypot(*turn[:2, 0])
    heading = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    left, phase = ref.side[i] > 0, np.pi * float(ref.phase[i])
    goal = np.zeros((2, 3))
    goal[1 if left else 0] = heading @ (ref.foothold[i].numpy() - sole[1 if left else 0])
    low = sole[:, 2].min()
    cell = np.floor((at[:2] + np.array(SCAN) @ heading[:2, :2]) / 0.1 + 20).astype(int).clip(0, 39)
    seen = [
        command, np.array([np.sin(phase), np.cos(phase)]) * (1 if left else -1), turn[2], 0.25 * r.spin[i].numpy(),
        (heading @ r.com_velocity[i].numpy())[:2], [5 * (at[2] - float(ref.height[i]))],
        [np.angle(np.exp(1j * float(ref.heading[i])) / (c + 1j * s))], r.joints[i].numpy() - env.control._rest.numpy(),
        0.05 * r.joint_velocity[i].numpy(), env.control.action[i].numpy(),
        ref.joints[i].flatten().numpy() - env.control._rest[:12].numpy(), ((sole - at) @ heading.T).ravel(),
        goal.ravel(), np.clip(heights[cell[:, 0], cell[:, 1]] - low, -1, 1),
    ]  # fmt: skip
    return np.concatenate(seen)


def test_the_observation_is_as_written_out() -> None:
    count = 6
    env = LocomotionEnv(
        LocomotionSpec(task=TaskSpec(robots=count, shares={"flat": 0.5, "stairs": 0.5})),
        [flat(), stairs(0, 0.1, 0.3, 0.28, 4)],
        threads=1,
    )
    random = np.random.default_rng(0)
    heights = random.uniform(-0.1, 0.1, (40, 40)).astype(np.float32)
    ground = HeightMap((-2.0, -2.0), 0.1, torch.tensor(heights))
    place = torch.tensor(random.uniform(-0.5, 0.5, (count, 3)), dtype=torch.float32)
    heading = torch.tensor(random.uniform(-np.pi, np.pi, count), dtype=torch.float32)
    told = torch.tensor(random.uniform(-0.3, 0.3, (count, 3)), dtype=torch.float32)
    env.control.stand(torch.arange(count), place, heading, torch.tensor([0, 20] * 3), told)
    for tick in range(6):
        env.control.refer(told, ground, torch.full((count,), tick == 0))
        found = env.control.observe(told, ground)
        rows = np.array([expected(env, i, told[i].numpy(), heights) for i in range(count)])
        wanted = reflect(torch.tensor(rows, dtype=torch.float32), MIRROR, env.control.reference.side)
        assert ((found - wanted).abs() > 1e-4).float().mean() < 1e-3
        env.control.act(torch.tensor(random.normal(0, 0.3, (count, 15)), dtype=torch.float32))
    assert set(env.control.reference.side.tolist()) == {1.0, -1.0}
