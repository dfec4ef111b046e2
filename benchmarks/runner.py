"""Latency of a control period on a robot: points and odometry in, a safe velocity out, on one core.

A policy of a scale's size, with random weights, sees what a LiDAR shows on a walk along the shortest path over a tile:
a cloud at the paper's resolution, projected onto the scale's image. The peer runs the network in PyTorch, in float32,
on the same images; the whole period is ours alone. Times are of the process, so that other load on the machine does
not count; the longest of them by the clock is told, too.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from _common import arguments, report
from _learner import CACHE, scale
from tensordict import TensorDict

from romnav.deploy.card import INPUTS, Card
from romnav.deploy.export import TOLERANCE, export
from romnav.deploy.runner import Runner, Sensed
from romnav.evaluation import episodes
from romnav.evaluation.rollout import Oracle, View
from romnav.evaluation.spec import EpisodeSetSpec
from romnav.experiment.scales import Scale
from romnav.navigation.env import to_command
from romnav.navigation.observations import STATE_SIZE
from romnav.navigation.policy import LAYERS
from romnav.navigation.ppo import make_actor
from romnav.precision import full_precision
from romnav.sensing.encoder import untrained
from romnav.sensing.image import directions, project
from romnav.sensing.lidar import Lidar
from romnav.sensing.spec import LidarSpec
from romnav.world.build import build
from romnav.world.spec import WorldSpec

PERIOD = 0.2
"""Control period, s: a latency must stay far below."""


def walk(steps: int) -> list[Sensed]:
    """What a robot senses on its way: clouds at the paper's resolution."""
    spec = EpisodeSetSpec(world=WorldSpec(tiles=1, seed=5, goals_per_tile=8), episodes=1, cross=0)
    world, fine = build(spec.world, CACHE), LidarSpec()
    lidar, rays = Lidar([tile.solids for tile in world.tiles], fine), directions(fine)
    view = View(world, episodes.draw("bench", spec, world), scale("smoke").navigation.env)
    oracle, mount, sensed = Oracle(), torch.tensor([0.0, 0.0, fine.height]), []
    for _ in range(steps):
        robot = view.robot
        ranges = lidar.scan(robot.tile.int(), robot.position + mount, robot.yaw)[0]
        sensed.append(
            Sensed(
                position=robot.position[0].numpy().copy(),
                yaw=float(robot.yaw[0]),
                goal=view.goal_position[0].numpy(),
                goal_yaw=float(view.goal_yaw[0]),
                points=(ranges[..., None] * rays)[ranges > 0].numpy(),
            )
        )
        robot.step(oracle.command(view))
    return sensed


def measure(name: str, s: Scale, stream: list[Sensed], out: Path) -> None:
    """Export a policy of the scale's size and feed it the stream."""
    encoder = untrained(s.pretrain.encoder, directions(s.lidar), 0).encoder.eval().requires_grad_(False)
    seen = {"lidar": torch.zeros(1, *encoder.token_shape), "state": torch.zeros(1, STATE_SIZE)}
    actor = make_actor(TensorDict(seen, batch_size=[1]), s.navigation.policy).eval()
    card = Card(
        arm=name,
        seed=0,
        scale=name,
        steps=0,
        checkpoint="none",
        commit="none",
        period=PERIOD,
        command=s.navigation.env.command,
        max_goal_distance=s.navigation.env.max_goal_distance,
        lidar=s.lidar,
        depth=None,
        proprioception=0,
        memory=(LAYERS, 1, actor.core.width),
        inputs={k: v for k, v in INPUTS.items() if k != "depth"},
    )
    with tempfile.TemporaryDirectory() as folder:
        card = export(actor, encoder, None, card, Path(folder) / "policy.onnx", lambda *_: None)
        runner = Runner(Path(folder) / "policy.onnx")
    times, clock = [], []
    for sensed in [*stream[:10], *stream]:
        begun = time.process_time()
        clock.append(runner(sensed).seconds)
        times.append(time.process_time() - begun)
    state, memory = torch.zeros(1, STATE_SIZE), np.zeros(card.memory, np.float32)
    network, peers = [], []
    for sensed in stream:
        image = project(torch.from_numpy(np.asarray(sensed.points)), s.lidar)[None]
        begun = time.process_time()
        runner.session.run(None, {"lidar": image.numpy(), "state": state.numpy(), "memory": memory})
        network.append(time.process_time() - begun)
        begun = time.process_time()
        with torch.inference_mode(), full_precision():
            tokens = encoder.tokens(image)
            to_command(actor(TensorDict({"lidar": tokens, "state": state}, batch_size=[1])), card.command)
        peers.append(time.process_time() - begun)
    milliseconds = [1e3 * t for t in times[10:]]
    points = round(float(np.mean([len(np.asarray(sensed.points)) for sensed in stream])))
    rows, columns = s.lidar.rows, s.lidar.columns
    report(
        f"runner-{name}",
        f"Network of the `{name}` scale on images of {rows} x {columns}, {len(stream)} periods",
        "ms",
        [1e3 * t for t in network],
        {"PyTorch": [1e3 * t for t in peers]},
        out,
        agree=card.error is not None and card.error <= TOLERANCE,
        period_median=float(np.median(milliseconds)),
        period_worst=max(milliseconds),
        period_worst_by_the_clock=1e3 * max(clock[10:]),
        points=points,
    )
    print(f"whole period, {points} points: median {np.median(milliseconds):.1f} ms, worst {max(milliseconds):.1f} ms\n")


def main() -> None:
    """Measure, print and write ``results/bench/runner-*.json``."""
    options = arguments(__doc__, steps=300)
    torch.set_num_threads(1)
    stream = walk(options.steps)
    for name in ("cpu", "paper"):
        measure(name, scale(name), stream, options.out)


if __name__ == "__main__":
    main()
