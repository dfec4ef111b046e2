"""The humanoid under navigation commands: where it starts, that it walks, falls, and is dropped from a batch."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from romnav.errors import RomnavError
from romnav.robot.g1 import HEAD
from romnav.robot.gaits import GaitLibrary
from romnav.robot.humanoid import Humanoid, Skeleton
from romnav.robot.locomotion.train import train
from romnav.robot.spec import LocomotionSpec, PpoSpec, TaskSpec
from romnav.world.build import build
from romnav.world.solids import Label
from romnav.world.spawns import Start
from romnav.world.spec import WorldSpec
from romnav.world.world import World

SPEC = LocomotionSpec(
    task=TaskSpec(robots=4, shares={"flat": 1.0}), ppo=PpoSpec(steps=2, epochs=1, minibatches=1), iterations=1
)


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A policy that has learned nothing: its residuals are almost zero, so the reference gait walks alone."""
    return train(SPEC, tmp_path_factory.mktemp("locomotion"), threads=1)


@pytest.fixture(scope="module")
def world() -> World:
    return build(WorldSpec(tiles=2, goals_per_tile=2, classes=("building", "outdoor")))


def starts(world: World, nodes: torch.Tensor, yaw: torch.Tensor) -> Start:
    tile = (torch.searchsorted(world.node_start, nodes, right=True) - 1).long()
    zero = torch.zeros_like(nodes)
    return Start(tile, world.layer[nodes], world.position[nodes, :2], yaw, zero, torch.zeros_like(yaw))


def level_nodes(world: World, count: int) -> torch.Tensor:
    """Nodes of tile 0 with level free ground for 0.6 m around them."""
    chosen = []
    for n in range(int(world.node_start[0]), int(world.node_start[1]), 7):
        around = world.position[n, :2] + 0.6 * torch.tensor([[1.0, 0], [-1, 0], [0, 1], [0, -1]])
        four = torch.zeros(4, dtype=torch.long)
        layer = four + world.layer[n]
        if (world.node_at(four, layer, around) >= 0).all():
            z = world.surface(four, layer, around)
            if (z - world.position[n, 2]).abs().max() < 1e-3:
                chosen.append(n)
    return torch.tensor(chosen)[torch.linspace(0, len(chosen) - 1, count).long()]


def robot(world: World, count: int, checkpoint: Path) -> Humanoid:
    return Humanoid(world, count, 0.2, checkpoint, GaitLibrary([]), threads=1)


def test_it_walks_where_it_is_told_from_every_storey(world: World, checkpoint: Path) -> None:
    body = robot(world, 4, checkpoint)
    start = starts(world, level_nodes(world, 4), torch.tensor([0.0, 1.5, 3.0, -1.5]))
    body.reset(torch.arange(4), start)
    torch.testing.assert_close(body.position[:, :2], start.xy, atol=1e-3, rtol=0)
    torch.testing.assert_close(body.yaw, start.yaw, atol=1e-3, rtol=0)
    z = body.position[:, 2]
    torch.testing.assert_close(z, world.surface(start.tile, start.layer, start.xy), atol=2e-3, rtol=0)
    assert z.max() - z.min() > 3.0
    for _ in range(8):
        body.step(torch.tensor([[0.25, 0.0, 0.0]]).expand(4, -1))
    move = body.position[:, :2] - start.xy
    ahead = (move * torch.stack([torch.cos(start.yaw), torch.sin(start.yaw)], dim=1)).sum(1)
    assert (ahead > 0.08).all()
    assert not body.fallen.any()
    assert (body.contacts == 0).all()
    assert (body.layer == start.layer).all()


def test_dropping_robots_changes_nothing_for_the_others(world: World, checkpoint: Path) -> None:
    whole, part = robot(world, 4, checkpoint), robot(world, 4, checkpoint)
    start = starts(world, level_nodes(world, 4), torch.zeros(4))
    command = torch.tensor([[0.3, 0.0, 0.4]])
    for body in (whole, part):
        body.reset(torch.arange(4), start)
        body.step(command.expand(4, -1))
    keep = torch.tensor([3, 1])
    part.select(keep)
    for _ in range(3):
        whole.step(command.expand(4, -1))
        part.step(command.expand(2, -1))
    # Vectorised arithmetic rounds otherwise in a batch of another size.
    torch.testing.assert_close(part.position, whole.position[keep], atol=1e-4, rtol=0)
    torch.testing.assert_close(part.yaw, whole.yaw[keep], atol=1e-4, rtol=0)


def test_it_feels_its_gait_its_turning_and_gravity_and_its_head_sways(world: World, checkpoint: Path) -> None:
    body = robot(world, 3, checkpoint)
    body.reset(torch.arange(3), starts(world, level_nodes(world, 3), torch.tensor([0.0, 1.0, -2.0])))
    state = body.control.snapshot(torch.arange(3))
    angles = np.array([[0.3, 0.1, -0.05], [1.2, -0.07, 0.11], [-2.0, 0.0, 0.2]])
    turn = Rotation.from_euler("ZYX", angles)
    state["qpos"][:, 3:7] = torch.from_numpy(turn.as_quat()[:, [3, 0, 1, 2]])
    state["qpos"][:, 19:22] = 0.0  # waist
    state["qvel"][:, 3:6] = torch.tensor([[0.1, 0.2, 0.3]], dtype=torch.float64)
    state["clock"] = torch.tensor([0, 5, 30])
    body.control.restore(torch.arange(3), state)
    felt = body.proprioception
    phase = 2 * np.pi * np.array([0, 5, 30]) / 40
    np.testing.assert_allclose(felt[:, :2], np.column_stack([np.sin(phase), np.cos(phase)]), atol=1e-6)
    np.testing.assert_allclose(felt[:, 2:5], [[0.1, 0.2, 0.3]] * 3, atol=1e-6)
    np.testing.assert_allclose(felt[:, 5:], turn.inv().apply([0.0, 0.0, -1.0]), atol=1e-5)
    head = body.head
    np.testing.assert_allclose(head.yaw, angles[:, 0], atol=1e-5)
    np.testing.assert_allclose(head.tilt, angles[:, [2, 1]], atol=1e-5)
    torso = np.array([-0.0039635, 0.0, 0.044])  # of the model, with a straight waist
    expected = body.robots.pelvis.numpy() + turn.apply(torso + np.array(HEAD))
    np.testing.assert_allclose(head.origin, expected, atol=1e-4)
    skeleton = Skeleton(SPEC.robot)
    for robot_, joints in enumerate(body.joints.numpy()):  # what its joints alone tell of its head
        for whole, part in zip(head, skeleton.head(joints), strict=True):
            torch.testing.assert_close(part[0], whole[robot_], atol=1e-4, rtol=0)


def test_a_start_on_a_stair_faces_along_it_on_the_middle_of_a_tread(world: World, checkpoint: Path) -> None:
    body = robot(world, 2, checkpoint)
    solids = world.tiles[0].solids
    on_stair = [
        n for n in world.spawn[world.spawn < world.node_start[1]].tolist()
        if any(
            solids.label[i] == Label.STAIR and abs(solids.top[i] - float(world.position[n, 2])) < 0.01
            for i in _over(solids, world.position[n, :2].numpy())
        )
    ]  # fmt: skip
    nodes = torch.tensor(on_stair[:1] * 2)
    start = starts(world, nodes, torch.tensor([0.3, 0.3 + np.pi]))
    body.reset(torch.arange(2), start)
    xy, z = body.position[:, :2].numpy(), body.position[:, 2]
    torch.testing.assert_close(z, world.position[nodes, 2], atol=0.01, rtol=0)
    tread = next(i for i in _over(solids, xy[0]) if solids.label[i] == Label.STAIR and abs(solids.top[i] - z[0]) < 0.01)
    (u,), _ = (part.T for part in solids.local(xy[:1]))
    assert abs(u[tread]) < 0.01
    assert torch.cos(body.yaw[0] - body.yaw[1]) < -0.99
    ahead = xy[0] + 0.5 * np.array([np.cos(float(body.yaw[0])), np.sin(float(body.yaw[0]))])
    assert abs(np.sin(2 * (float(body.yaw[0]) - solids.yaw[tread]))) < 1e-3
    there = world.surface(start.tile[:1], start.layer[:1], torch.tensor(ahead[None], dtype=torch.float32))
    assert there.isnan() or abs(float(there) - float(z[0])) > 0.05, "up or down within half a metre"


def test_starts_in_a_batch_are_those_of_one_robot_after_the_other(world: World, checkpoint: Path) -> None:
    library = GaitLibrary.load(Path(__file__).parents[2] / "results/cpu/locomotion/gaits.pt")
    stairs = world.spawn[world.spawn < world.node_start[1]]
    nodes = torch.cat([stairs[torch.linspace(0, len(stairs) - 1, 8).long()], level_nodes(world, 2)])
    start = starts(world, nodes, torch.linspace(-3.0, 3.0, 10))
    batch, single = (Humanoid(world, 10, 0.2, checkpoint, library, threads=1) for _ in range(2))
    batch.reset(torch.arange(10), start)
    for k in range(10):
        one = Start(**{field.name: getattr(start, field.name)[k : k + 1] for field in fields(start)})
        single.reset(torch.tensor([k]), one)
    assert 0 < int(batch._first.sum()) < 10, "some stand, some are in the middle of a walk"
    assert torch.equal(batch._first, single._first)
    for mine, theirs in zip(*(body.robots.state(torch.arange(10)) for body in (batch, single)), strict=True):
        torch.testing.assert_close(mine, theirs, atol=1e-6, rtol=0)
    for name in ("clock", "foothold", "heading", "joints"):
        torch.testing.assert_close(getattr(batch.control.walker, name), getattr(single.control.walker, name))


def test_starts_jittered_within_stair_cells_stand_on_the_surface_under_them(world: World, checkpoint: Path) -> None:
    nodes = world.spawn[world.spawn < world.node_start[1]][:40]
    start = starts(world, nodes, torch.zeros(len(nodes)))
    jitter = 0.09 * torch.stack([torch.cos(1.0 * nodes), torch.sin(1.0 * nodes)], dim=1)
    start = replace(start, xy=start.xy + jitter)
    solids, on_tread, met = world.tiles[0].solids, [], []
    body = robot(world, len(nodes), checkpoint)
    monkey = body._slope
    heights: list[float] = []
    body._slope = lambda tile, xy, z, yaw: (heights.append(z), monkey(tile, xy, z, yaw))[1]  # type: ignore[method-assign]
    body.reset(torch.arange(len(nodes)), start)
    for k, node in enumerate(nodes.tolist()):
        tops = [solids.top[i] for i in _over(solids, start.xy[k].numpy()) if solids.walkable[i]]
        middle = float(world.position[node, 2])
        near = [top for top in tops if top < middle + 0.3]
        on_tread.append(max(near))
        met.append(heights[k])
    flat = [abs(a - b) < 0.002 for a, b in zip(on_tread, met, strict=True)]
    assert np.mean(flat) > 0.95, "but for ramps and the 2.5 cm cells of the height map"


def test_a_robot_that_is_not_finite_has_fallen_where_it_was(world: World, checkpoint: Path) -> None:
    nodes = level_nodes(world, 2)
    body = robot(world, 2, checkpoint)
    body.reset(torch.arange(2), starts(world, nodes, torch.zeros(2)))
    before = body.position.clone()
    body.robots.batch.qvel[1, 8] = np.nan
    body.step(torch.zeros(2, 3))
    assert body.fallen.tolist() == [False, True]
    assert body.position.isfinite().all()
    assert body.yaw.isfinite().all()
    assert (body.position[1] - before[1]).norm() < 0.3


def _over(solids: object, xy: np.ndarray) -> list[int]:
    (u,), (v,) = (part.T for part in solids.local(xy[None]))  # type: ignore[attr-defined]
    return np.flatnonzero((np.abs(u) <= solids.half[:, 0]) & (np.abs(v) <= solids.half[:, 1])).tolist()  # type: ignore[attr-defined]


def test_who_has_fallen_is_reported_and_stays_down(world: World, checkpoint: Path) -> None:
    body = robot(world, 2, checkpoint)
    start = starts(world, level_nodes(world, 2), torch.zeros(2))
    body.reset(torch.arange(2), start)
    lying = body.control.snapshot(torch.tensor([1]))
    lying["qpos"][:, 2] = float(body.position[1, 2]) + 0.2
    lying["qpos"][:, 3:7] = torch.tensor([[0.7071, 0.7071, 0.0, 0.0]])
    body.control.restore(torch.tensor([1]), lying)
    body.step(torch.zeros(2, 3))
    assert body.fallen.tolist() == [False, True]
    assert body.contacts[0] == 0
    there = body.position[1].clone()
    body.step(torch.zeros(2, 3))
    torch.testing.assert_close(body.position[1], there, atol=0, rtol=0)
    body.reset(torch.tensor([1]), starts(world, level_nodes(world, 2)[1:], torch.zeros(1)))
    assert not body.fallen.any()


def test_a_limit_on_stairs_slows_who_steps_up_or_down_and_nobody_else(world: World, checkpoint: Path) -> None:
    body = Humanoid(world, 3, 0.2, checkpoint, GaitLibrary([]), threads=1, stair_limits=(0.4, 0.3))
    body.reset(torch.arange(3), starts(world, level_nodes(world, 3), torch.zeros(3)))
    command = torch.tensor([[0.8, 0.1, 0.5], [0.8, 0.1, 0.5], [-0.3, 0.1, 0.5]])
    assert torch.equal(body._followed(command), command)
    body.step(0.0 * command)
    body.control.walker.foothold[:, 2] = body.control.walker.base + torch.tensor([0.02, -0.15, 0.15])
    followed = body._followed(command)
    assert followed.tolist() == [
        command[0].tolist(),
        torch.tensor([0.4, 0.1, 0.3]).tolist(),
        torch.tensor([-0.3, 0.1, 0.3]).tolist(),
    ]


def test_the_period_is_a_multiple_of_the_control_step(world: World, checkpoint: Path) -> None:
    with pytest.raises(RomnavError, match="multiple of the control step"):
        Humanoid(world, 1, 0.19, checkpoint, GaitLibrary([]), threads=1)


def test_a_restored_batch_goes_on_as_if_it_had_never_stopped(world: World, checkpoint: Path) -> None:
    """Through a saved state: also across a fall, a reset and another tile."""
    first, second = robot(world, 3, checkpoint), robot(world, 3, checkpoint)
    start = starts(world, level_nodes(world, 3), torch.tensor([0.0, 1.0, 2.0]))
    command = torch.tensor([[0.4, 0.1, 0.5], [0.3, 0.0, 0.0], [-0.2, 0.0, 0.3]])
    first.reset(torch.arange(3), start)
    for _ in range(3):
        first.step(command)
    elsewhere = int(world.node_start[1]) + 50
    first.reset(torch.tensor([2]), starts(world, torch.tensor([elsewhere]), torch.zeros(1)))
    first.step(command)
    second.load_state_dict({name: value.clone() for name, value in first.state_dict().items()})
    for body in (first, second):
        for _ in range(3):
            body.step(command)
        body.reset(torch.tensor([0]), starts(world, level_nodes(world, 1), torch.zeros(1)))
        body.step(command)
    for name, value in first.state_dict().items():
        assert torch.equal(value, second.state_dict()[name]), name
