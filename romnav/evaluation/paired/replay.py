"""One episode again, with all that the robot sees, decides and feels on the way.

A robot of the reduced-order model is led along its recorded way and meets the noise that it met then, so it sees what
it saw. A humanoid, of which joints are not recorded, is driven again; products round differently in a batch of one, so
that its way may become another one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from romnav.evaluation.episodes import EpisodeSet
from romnav.evaluation.rollout import Driver, Outcomes, Policy, View
from romnav.evaluation.shield import Shield
from romnav.evaluation.spec import EvaluationSpec
from romnav.evaluation.tracks import Tracks
from romnav.navigation.env import to_command
from romnav.navigation.perception import viewpoint
from romnav.navigation.spec import EnvSpec
from romnav.progress import Progress
from romnav.robot.dynamics import Body
from romnav.robot.humanoid import Humanoid
from romnav.robot.rom import ReducedOrderModel
from romnav.threads import torch_threads
from romnav.world.world import World


@dataclass(frozen=True)
class Sight:
    """What a policy saw and decided in ``K`` steps."""

    ranges: NDArray[np.float32]
    """(K, rows, columns) LiDAR image as corrupted, m; 0 where there is no return."""
    directions: NDArray[np.float32]
    """(rows, columns, 3) of its pixels, in the levelled frame of the sensor."""
    origin: NDArray[np.float32]
    """(K, 3) of the sensor, tile frame, m."""
    heading: NDArray[np.float32]
    """(K,) of the sensor, rad."""
    beta: NDArray[np.float32]
    """(K, 2, 3) parameters of the actions' Beta distributions over [-1, 1]."""

    def points(self, step: int) -> NDArray[np.float32]:
        """(P, 3) returns of a step, tile frame, m."""
        hit = self.ranges[step] > 0
        local = self.ranges[step][hit][:, None] * self.directions[hit]
        c, s = np.cos(self.heading[step]), np.sin(self.heading[step])
        return local @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]], np.float32) + self.origin[step]


@dataclass(frozen=True)
class Replay:
    """``K`` steps of an episode; sample ``k`` of a pose is where step ``k`` begins, the last where the episode ends."""

    position: NDArray[np.float32]
    """(K + 1, 3) tile frame, m."""
    yaw: NDArray[np.float32]
    """(K + 1,) rad."""
    contact: NDArray[np.bool_]
    """(K + 1,) whether the robot touched something in the step before."""
    joints: NDArray[np.float64] | None
    """(K + 1, Q) generalised positions of the humanoid; None of the reduced-order model."""
    command: NDArray[np.float32]
    """(K, 3) (vx, vy, wz), m/s and rad/s."""
    sight: Sight | None
    """None of a scripted arm."""
    barrier: NDArray[np.float32] | None
    """(K,) value h of the safety filter's Poisson function, positive where safe; None without a filter."""
    filtered: NDArray[np.float32] | None
    """(K, 2) velocity that the filter would let through, m/s; it only looks on."""


class _Led(ReducedOrderModel):
    """A robot that goes where it went, whatever it is told."""

    def __init__(self, world: World, envs: int, period: float, tracks: Tracks, episode: int) -> None:
        super().__init__(world, envs, period)
        samples = tracks.of(episode)
        columns = (tracks.position[samples], tracks.yaw[samples], tracks.contact[samples])
        self._position, self._yaw, self._contact = map(torch.from_numpy, columns)
        self._sample = 0

    def step(self, command: Tensor) -> None:
        """Go to the next sample."""
        self._sample += 1
        one = slice(self._sample, self._sample + 1)
        self.position, self.yaw, self.contacts = self._position[one], self._yaw[one], self._contact[one].float()


class _Witness:
    """Drives as its driver does, and keeps what that one saw."""

    def __init__(self, driver: Driver) -> None:
        self.driver = driver
        self.ranges: list[Tensor] = []
        self.poses: list[tuple[Tensor, Tensor]] = []
        self.beta: list[Tensor] = []

    def command(self, view: View) -> Tensor:
        policy = self.driver
        if not isinstance(policy, Policy):
            return policy.command(view)
        eye, actor, obs = policy.perception.lidar, policy.actor, policy.observe(view)
        origin, heading, _ = viewpoint(view.robot, eye.mount)
        self.poses.append((origin[0].clone(), heading[0].clone()))
        self.ranges.append(eye.ranges(view.robot, view.counters())[0])
        memory = actor.get_hidden_state()
        self.beta.append(actor.beta(obs)[0])
        actor.reset(hidden_state=memory)
        return to_command(actor(obs), view.env.command)

    def sight(self) -> Sight | None:
        if not isinstance(self.driver, Policy):
            return None
        origin, heading = zip(*self.poses, strict=True)
        return Sight(
            ranges=torch.stack(self.ranges).numpy(),
            directions=self.driver.perception.lidar.encoder.directions.numpy(),
            origin=torch.stack(origin).numpy(),
            heading=torch.stack(heading).numpy(),
            beta=torch.stack(self.beta).numpy(),
        )


@torch.inference_mode()
def replay(
    driver: Driver,
    world: World,
    episodes: EpisodeSet,
    episode: int,
    env: EnvSpec,
    spec: EvaluationSpec,
    *,
    tracks: Tracks | None = None,
    body: Body = ReducedOrderModel,
    shield: Shield | None = None,
    progress: Progress | None = None,
) -> Replay:
    """Go through one of ``episodes`` again while ``shield`` looks on; everything is on the CPU.

    The robot is led along its way in ``tracks``, if they are given, and otherwise driven on what ``body`` makes.
    """
    one = EpisodeSet(episodes.name, episodes.world, {k: v[episode : episode + 1] for k, v in episodes.columns.items()})
    with torch_threads(spec.threads):
        robot = _Led(world, 1, env.period, tracks, episode) if tracks else body(world, 1, env.period)
        view = View(world, one, env, robot)
        view.noise = torch.tensor([episode])
        outcomes, witness = Outcomes(view, spec.duration, spec.reach), _Witness(driver)
        steps = range(1, int(tracks.first[episode + 1] - tracks.first[episode])) if tracks else outcomes.steps(progress)
        poses, joints, commands, filtered = [_pose(view)], [_joints(view)], [], []
        for step in steps:
            command = witness.command(view)
            if shield:
                filtered.append(shield(robot, torch.tensor([0]), command[:, :2], view.noise, step - 1))
            before = robot.position[:, :2]
            robot.step(command)
            view.previous, view.step = command, step
            commands.append(command[0])
            poses.append(_pose(view))
            joints.append(_joints(view))
            if not tracks:
                outcomes.add(before)
    samples = np.stack(poses)
    return Replay(
        position=samples[:, :3],
        yaw=samples[:, 3],
        contact=samples[:, 4] > 0,
        joints=np.stack([j for j in joints if j is not None]) if joints[0] is not None else None,
        command=torch.stack(commands).numpy(),
        sight=witness.sight(),
        barrier=torch.cat([f.h for f in filtered]).float().numpy() if filtered else None,
        filtered=torch.cat([f.velocity for f in filtered]).float().numpy() if filtered else None,
    )


def _pose(view: View) -> NDArray[np.float32]:
    robot = view.robot
    return torch.cat([robot.position[0], robot.yaw, robot.contacts]).numpy().astype(np.float32)


def _joints(view: View) -> NDArray[np.float64] | None:
    robot = view.robot
    return robot.robots.state(torch.tensor([0]))[0][0].double().numpy() if isinstance(robot, Humanoid) else None
