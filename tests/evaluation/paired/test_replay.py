from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from romnav.evaluation import episodes
from romnav.evaluation.episodes import EpisodeSet
from romnav.evaluation.paired.replay import replay
from romnav.evaluation.paired.run import run
from romnav.evaluation.postures import Postures
from romnav.evaluation.rollout import Oracle, Policy
from romnav.evaluation.shield import Shield
from romnav.evaluation.spec import EpisodeSetSpec, EvaluationSpec, TrialSpec
from romnav.evaluation.tracks import Recorder, Tracks
from romnav.navigation.perception import Eye, Perception
from romnav.navigation.ppo import make_actor
from romnav.navigation.spec import EnvSpec, PolicySpec
from romnav.robot.spec import RobotSpec
from romnav.sensing.corruption import Corruption
from romnav.sensing.encoder import untrained
from romnav.sensing.lidar import Lidar
from romnav.sensing.spec import CorruptionSpec, EncoderSpec, LidarSpec
from romnav.world.build import build
from romnav.world.spec import SamplerSpec, WorldSpec
from romnav.world.world import World

ENV, SPEC = EnvSpec(), EvaluationSpec(duration=6.0)
CHOSEN = 5


@pytest.fixture(scope="module")
def world() -> World:
    return build(WorldSpec(tiles=1, seed=51, goals_per_tile=16))


@pytest.fixture(scope="module")
def paired(world: World) -> EpisodeSet:
    spec = EpisodeSetSpec(world=world.spec, episodes=8, cross=1, sampler=SamplerSpec(stair_probability=0.0))
    return episodes.draw("test", spec, world)


@pytest.fixture(scope="module")
def policy(world: World) -> Policy:
    lidar = Lidar([tile.solids for tile in world.tiles], LidarSpec(rows=8, columns=16))
    encoder = untrained(EncoderSpec(widths=(8,), strides=((2, 4),), latent=4), lidar.directions, 0).encoder
    perception = Perception(Eye(lidar, Corruption(CorruptionSpec(), 1), encoder.requires_grad_(False)))
    torch.manual_seed(0)
    obs = TensorDict({"lidar": torch.zeros(1, *encoder.token_shape), "state": torch.zeros(1, 9)}, batch_size=[1])
    return Policy(make_actor(obs, PolicySpec(attention=16, recurrent=16)), perception)


def recorded(driver: Policy | Oracle, world: World, paired: EpisodeSet) -> Tracks:
    recorder = Recorder()
    run(driver, world, paired, ENV, SPEC, recorder=recorder)
    return recorder.tracks(len(paired))


def test_led_along_its_way_a_policy_sees_and_decides_what_it_did(
    world: World, paired: EpisodeSet, policy: Policy
) -> None:
    tracks = recorded(policy, world, paired)
    policy.actor.reset()
    again = replay(policy, world, paired, CHOSEN, ENV, SPEC, tracks=tracks)
    way = tracks.of(CHOSEN)
    np.testing.assert_array_equal(again.position[1:], tracks.position[way][1:])
    np.testing.assert_allclose(again.position[0], tracks.position[way][0], atol=0.006)
    # what it decides there takes it there: heading changes as told, up to the centiradians of tracks
    turned = np.angle(np.exp(1j * np.diff(tracks.yaw[way])))
    np.testing.assert_allclose(ENV.period * again.command[:, 2], turned, atol=0.03)
    assert again.sight is not None
    alpha, beta = again.sight.beta[:, 0], again.sight.beta[:, 1]
    assert ((alpha > 0) & (beta > 0)).all()
    mean = 2 * alpha / (alpha + beta) - 1
    np.testing.assert_allclose(mean[:, 2] * ENV.command.turn, again.command[:, 2], atol=0.02)


def test_returns_lie_at_their_ranges_around_the_sensor(world: World, paired: EpisodeSet, policy: Policy) -> None:
    policy.actor.reset()
    again = replay(policy, world, paired, CHOSEN, ENV, SPEC)
    sight = again.sight
    assert sight is not None
    for step in (0, len(again.command) - 1):
        points = sight.points(step)
        ranges = sight.ranges[step][sight.ranges[step] > 0]
        np.testing.assert_allclose(np.linalg.norm(points - sight.origin[step], axis=1), ranges, rtol=1e-4)
        assert points[:, 2].min() > again.position[:, 2].min() - 4.5


def test_led_a_robot_is_on_the_layer_that_it_was_on(world: World, paired: EpisodeSet) -> None:
    """The oracle, which descends the field of a layer, tells along the way what it told."""
    (cross,) = np.flatnonzero(paired.cross)
    spec = EvaluationSpec(duration=60.0)
    recorder = Recorder()
    run(Oracle(), world, paired, ENV, spec, recorder=recorder)
    tracks = recorder.tracks(len(paired))
    led = replay(Oracle(), world, paired, int(cross), ENV, spec, tracks=tracks)
    free = replay(Oracle(), world, paired, int(cross), ENV, spec)
    assert np.ptp(free.position[:, 2]) > 1.0
    away = np.abs(led.command - free.command).max(axis=1)
    assert np.quantile(away, 0.9) < 0.1


def test_a_humanoid_holds_itself_as_it_did_and_its_eyes_are_in_its_head(
    world: World, paired: EpisodeSet, policy: Policy
) -> None:
    tracks = recorded(policy, world, paired)
    count = len(tracks.position)
    joints, felt = np.zeros((count, 22)), np.linspace(0, 1, 8 * count, dtype=np.float32).reshape(count, 8)
    joints[:, :3] = tracks.position + np.array([0, 0, 0.75])
    joints[:, 3], joints[:, 6] = np.cos(tracks.yaw / 2), np.sin(tracks.yaw / 2)
    policy.actor.reset()
    again = replay(
        policy, world, paired, CHOSEN, ENV, SPEC, tracks=tracks, postures=(Postures(joints, felt), RobotSpec())
    )
    way = tracks.of(CHOSEN)
    assert again.joints is not None
    assert again.sight is not None
    np.testing.assert_array_equal(again.joints, joints[way])
    np.testing.assert_array_equal(again.position, tracks.position[way])
    above = again.sight.origin - again.position[:-1]
    assert (np.hypot(above[:, 0], above[:, 1]) < 0.1).all()
    assert ((above[:, 2] > 1.1) & (above[:, 2] < 1.35)).all()
    np.testing.assert_allclose(np.cos(again.sight.heading - again.yaw[:-1]), 1.0, atol=1e-3)


def test_a_scripted_arm_driven_again_goes_the_same_way(world: World, paired: EpisodeSet) -> None:
    tracks = recorded(Oracle(), world, paired)
    again = replay(Oracle(), world, paired, CHOSEN, ENV, SPEC)
    np.testing.assert_allclose(again.position, tracks.position[tracks.of(CHOSEN)], atol=0.006)
    assert again.sight is None
    assert again.joints is None
    assert again.barrier is None


def test_the_filter_looks_on_and_changes_nothing(world: World, paired: EpisodeSet) -> None:
    spec = EvaluationSpec(duration=2.0)
    free = replay(Oracle(), world, paired, CHOSEN, ENV, spec)
    watched = replay(Oracle(), world, paired, CHOSEN, ENV, spec, shield=Shield(world, 1, TrialSpec(), ENV))
    np.testing.assert_array_equal(watched.position, free.position)
    assert watched.barrier is not None
    assert watched.filtered is not None
    assert len(watched.barrier) == len(watched.filtered) == len(watched.command)
    assert np.isfinite(watched.barrier).all()
