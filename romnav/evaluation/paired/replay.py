"""One episode again, with all that the robot sees, decides and feels on the way.

A robot is led along its recorded way and meets the noise that it met then, so it sees what it saw. A humanoid whose
postures are not recorded is driven again; products round differently in a batch of one, so that its way may become
another one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from romnav.evaluation.episodes import EpisodeSet
from romnav.evaluation.paired.expected import Expected
from romnav.evaluation.postures import Postures
from romnav.evaluation.rollout import Driver, Outcomes, Policy, View
from romnav.evaluation.shield import Shield
from romnav.evaluation.spec import EvaluationSpec
from romnav.evaluation.tracks import Tracks
from romnav.navigation.env import to_command
from romnav.navigation.perception import viewpoint
from romnav.navigation.ppo import PrivilegedCritic
from romnav.navigation.spec import EnvSpec
from romnav.progress import Progress
from romnav.robot.dynamics import Body, Dynamics
from romnav.robot.humanoid import Skeleton
from romnav.robot.rom import ReducedOrderModel
from romnav.robot.spec import RobotSpec
from romnav.robot.tiles import change_layer
from romnav.threads import torch_threads
from romnav.world.spawns import Start
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
    """(K, 2, 3) parameters of the actions' Beta distributions."""
    support: float
    """They are over [-support, support]; [-1, 1] spans the limits of the command."""

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
    value: NDArray[np.float32] | None
    """(K,) return that the critic expects; None where there is none."""
    barrier: NDArray[np.float32] | None
    """(K,) value h of the safety filter's Poisson function, positive where safe; None without a filter."""
    filtered: NDArray[np.float32] | None
    """(K, 2) velocity that the filter would let through, m/s; it only looks on."""


class _Led(ReducedOrderModel):
    """A robot that goes where it went, whatever it is told."""

    def __init__(self, world: World, period: float, tracks: Tracks, episode: int) -> None:
        super().__init__(world, 1, period)
        samples = tracks.of(episode)
        columns = (tracks.position[samples], tracks.yaw[samples], tracks.contact[samples])
        self._position, self._yaw, self._contact = map(torch.from_numpy, columns)
        self._now = slice(0, 1)

    def step(self, command: Tensor) -> None:
        """Go to the next sample."""
        self._go(self._now.stop)

    def _go(self, sample: int) -> None:
        now = self._now = slice(sample, sample + 1)
        self.position, self.yaw, self.contacts = self._position[now], self._yaw[now], self._contact[now].float()
        xy, z = self.position[:, :2], self.position[:, 2]
        self.layer = change_layer(self.world, self.tile, self.layer, xy, z)


class _LedHumanoid(_Led):
    """A humanoid that goes and holds itself as it did."""

    def __init__(
        self, world: World, period: float, tracks: Tracks, episode: int, postures: Postures, robot: RobotSpec
    ) -> None:
        super().__init__(world, period, tracks, episode)
        self._joints, self._felt = (torch.from_numpy(x[tracks.of(episode)]) for x in (postures.joints, postures.felt))
        self._skeleton = Skeleton(robot)

    def reset(self, envs: Tensor, start: Start) -> None:
        """It starts where it did: walking on stairs, it may have been off ``start``."""
        super().reset(envs, start)
        self._go(0)

    @property
    def proprioception(self) -> Tensor:
        """(1, P) as it was recorded."""
        return self._felt[self._now]

    def _go(self, sample: int) -> None:
        super()._go(sample)
        self.joints, self.head = self._joints[self._now], self._skeleton.head(self._joints[sample].numpy())


class _Witness:
    """Drives as its driver does, and keeps what that one saw and expected."""

    def __init__(self, driver: Driver, expected: Expected | None) -> None:
        self.driver = driver
        self.expected = expected
        self.ranges: list[Tensor] = []
        self.poses: list[tuple[Tensor, Tensor]] = []
        self.beta: list[Tensor] = []
        self.value: list[Tensor] = []

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
        if self.expected:
            self.value.append(self.expected(view, obs["state"]))
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
            support=self.driver.actor.distribution.action_range[1],
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
    postures: tuple[Postures, RobotSpec] | None = None,
    body: Body = ReducedOrderModel,
    critic: PrivilegedCritic | None = None,
    shield: Shield | None = None,
    progress: Progress | None = None,
) -> Replay:
    """Go through one of ``episodes`` again while ``shield`` looks on; everything is on the CPU.

    The robot is led along its way in ``tracks``, if they are given, a humanoid in its ``postures`` of that way, and
    otherwise driven on what ``body`` makes. ``critic`` is the policy's, if it is known.
    """
    one = EpisodeSet(episodes.name, episodes.world, {k: v[episode : episode + 1] for k, v in episodes.columns.items()})
    with torch_threads(spec.threads):
        robot: Dynamics
        if tracks and postures:
            robot = _LedHumanoid(world, env.period, tracks, episode, *postures)
        else:
            robot = _Led(world, env.period, tracks, episode) if tracks else body(world, 1, env.period)
        view = View(world, one, env, robot)
        view.noise = torch.tensor([episode])
        expected = Expected(critic, view, torch.from_numpy(one.cross), env.duration) if critic else None
        outcomes, witness = Outcomes(view, spec.duration, spec.reach), _Witness(driver, expected)
        steps = range(1, int(tracks.first[episode + 1] - tracks.first[episode])) if tracks else outcomes.steps(progress)
        poses, joints, commands, filtered = [_pose(view)], [_joints(robot)], [], []
        for step in steps:
            command = witness.command(view)
            if shield:
                filtered.append(shield(robot, torch.tensor([0]), command[:, :2], view.noise, step - 1))
            before = robot.position[:, :2]
            robot.step(command)
            view.previous, view.step = command, step
            commands.append(command[0])
            poses.append(_pose(view))
            joints.append(_joints(robot))
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
        value=torch.cat(witness.value).numpy() if witness.value else None,
        barrier=torch.cat([f.h for f in filtered]).float().numpy() if filtered else None,
        filtered=torch.cat([f.velocity for f in filtered]).float().numpy() if filtered else None,
    )


def _pose(view: View) -> NDArray[np.float32]:
    robot = view.robot
    return torch.cat([robot.position[0], robot.yaw, robot.contacts]).numpy().astype(np.float32)


def _joints(robot: Dynamics) -> NDArray[np.float64] | None:
    return None if robot.joints is None else robot.joints[0].double().numpy()
