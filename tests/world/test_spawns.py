from __future__ import annotations

import numpy as np
import pytest
import torch

from romnav.world.build import build
from romnav.world.geodesic import UNIT, fields
from romnav.world.spawns import LEVEL_GAP, Start, sample
from romnav.world.spec import SamplerSpec, WorldSpec
from romnav.world.world import MOUTH_RADIUS, World

COUNT = 6000


@pytest.fixture(scope="module")
def world() -> World:
    return build(WorldSpec(tiles=8, seed=21, goals_per_tile=20))


def draw(world: World, spec: SamplerSpec, seed: int = 1) -> Start:
    env = torch.arange(COUNT)
    return sample(world, spec, seed, env % len(world.tiles), env, torch.zeros_like(env))


def facts(world: World, start: Start) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Spawn node, goal node and geodesic, the last recomputed from the goal's own field."""
    spawn = world.node_at(start.tile, start.layer, start.xy)
    goal = world.goal[start.goal]
    geodesic = torch.zeros(COUNT)
    for t, grids in enumerate(world.grids):
        here = (start.tile == t).nonzero()[:, 0]
        local = goal[here] - world.node_start[t]
        unique, inverse = np.unique(local.numpy(), return_inverse=True)
        field = fields(grids, unique)[inverse, (spawn[here] - world.node_start[t]).numpy()]
        geodesic[here] = torch.from_numpy(field.astype(np.float32)) * UNIT
    return spawn, goal, geodesic


@pytest.mark.parametrize("probability", [0.0, 0.3])
@pytest.mark.parametrize("cap", ["geodesic", "euclidean"])
def test_the_four_samplers(world: World, probability: float, cap: str) -> None:
    spec = SamplerSpec(stair_probability=probability, cap=cap)
    start = draw(world, spec)
    spawn, goal, geodesic = facts(world, start)
    assert (spawn >= 0).all()
    assert torch.equal(torch.searchsorted(world.node_start, goal, right=True) - 1, start.tile)
    assert geodesic.min() >= spec.min_distance
    if cap == "geodesic":
        assert geodesic.max() <= spec.max_distance
    else:
        assert geodesic.max() > spec.max_distance
        offset = world.position[goal] - world.position[spawn]
        assert torch.linalg.vector_norm(offset, dim=1).max() <= spec.max_distance
    on_stair = torch.isin(spawn, world.spawn)
    share = (
        torch.tensor([(world.spawn_start[t + 1] - world.spawn_start[t]) for t in range(8)]) / world.node_start.diff()
    )
    has = world.spawn_start.diff() > 0
    expected = torch.where(has, probability + (1 - probability) * share, 0.0).mean().item()
    assert on_stair.float().mean().item() == pytest.approx(expected, abs=0.025)


def test_cross_level_shares(world: World) -> None:
    """Always on tiles of three storeys, else half of the time, wherever the spawn has goals of both kinds in reach."""
    spec = SamplerSpec()
    start = draw(world, spec)
    spawn, goal, _ = facts(world, start)
    cross = (world.position[spawn, 2] - world.position[goal, 2]).abs() > LEVEL_GAP
    both_anywhere = 0
    for t, (tile, grids) in enumerate(zip(world.tiles, world.grids, strict=True)):
        here = start.tile == t
        goals = world.goal[world.goal_start[t] : world.goal_start[t + 1]]
        field = fields(grids, (goals - world.node_start[t]).numpy()).astype(np.float32) * UNIT
        geodesic = torch.from_numpy(field)[:, spawn[here] - world.node_start[t]]
        valid = (geodesic >= spec.min_distance) & (geodesic <= spec.max_distance)
        other = (world.position[goals, 2][:, None] - world.position[spawn[here], 2]).abs() > LEVEL_GAP
        has_other, has_same = (valid & other).any(dim=0), (valid & ~other).any(dim=0)
        both = has_other & has_same
        assert not cross[here][has_same & ~has_other].any()
        assert cross[here][has_other & ~has_same].all()
        if both.sum() > 100:
            share = cross[here][both].float().mean().item()
            assert share == (1.0 if len(tile.storeys) == 3 else pytest.approx(0.5, abs=2 / int(both.sum()) ** 0.5))
            both_anywhere += 1
    assert both_anywhere >= 4


def test_stair_spawns_are_on_or_at_the_mouth_of_a_connector(world: World) -> None:
    for t, (tile, grids) in enumerate(zip(world.tiles, world.grids, strict=True)):
        local = world.spawn[world.spawn_start[t] : world.spawn_start[t + 1]] - world.node_start[t]
        chosen = np.zeros(len(grids.position), bool)
        chosen[local] = True
        near = grids.connector.copy()
        for mouth in (c.path[i] for c in tile.connectors for i in (0, -1)):
            away = grids.position.astype(float) - mouth
            near |= (np.hypot(*away.T[:2]) < MOUTH_RADIUS) & (np.abs(away[:, 2]) < LEVEL_GAP)
        # a node at a mouth's very rim may be rounded to either side
        assert (chosen != near).sum() <= 1
        assert (chosen & ~grids.connector).any() == bool(tile.connectors)


def test_a_world_without_stairs_spawns_anywhere() -> None:
    world = build(WorldSpec(tiles=1, classes=("room",), goals_per_tile=4))
    assert len(world.spawn) == 0
    assert (facts(world, draw(world, SamplerSpec(stair_probability=1.0)))[0] >= 0).all()


def test_a_draw_depends_on_seed_environment_and_episode_alone(world: World) -> None:
    whole = draw(world, SamplerSpec())
    some = torch.tensor([5, 999, 17])
    part = sample(world, SamplerSpec(), 1, some % 8, some, torch.zeros_like(some))
    assert torch.equal(whole.xy[some], part.xy)
    assert torch.equal(whole.goal[some], part.goal)
    other = draw(world, SamplerSpec(), seed=2)
    assert (whole.goal != other.goal).float().mean() > 0.8


def test_goals_of_a_class_are_drawn_evenly(world: World) -> None:
    """Each goal of a room of one level is drawn as often as the spawns allow, if all that qualify are as likely."""
    room = next(t for t, tile in enumerate(world.tiles) if tile.kind == "room" and len(tile.layers) == 1)
    spec, env = SamplerSpec(stair_probability=0.0), torch.arange(40_000)
    start = sample(world, spec, 3, torch.full_like(env, room), env, torch.zeros_like(env))
    spawn = world.node_at(start.tile, start.layer, start.xy) - world.node_start[room]
    goals = world.goal[world.goal_start[room] : world.goal_start[room + 1]] - world.node_start[room]
    geodesic = fields(world.grids[room], goals.numpy())[:, spawn.numpy()].astype(np.float32) * UNIT
    valid = (geodesic >= spec.min_distance) & (geodesic <= spec.max_distance)
    assert valid.any(axis=0).all()
    chance = valid / valid.sum(axis=0)
    counts = torch.bincount(start.goal - world.goal_start[room], minlength=len(goals)).numpy()
    spread = np.sqrt((chance * (1 - chance)).sum(axis=1))
    assert (np.abs(counts - chance.sum(axis=1)) < 4.0 * spread).all()
