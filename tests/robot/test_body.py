from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from romnav.robot import g1
from romnav.robot.body import BodyModel, Obstacles
from romnav.robot.spec import BodySpec, RobotSpec
from romnav.robot.statics import Geoms
from romnav.world.scenes.obstacles import obstacle_scenes
from romnav.world.scenes.scene import scene_world
from romnav.world.solids import Label, Solids, SolidsBuilder
from romnav.world.spawns import Start
from romnav.world.world import World
from tests.world.conftest import _inside as inside

BODY = BodySpec()


@pytest.fixture(scope="module")
def world() -> World:
    return scene_world(obstacle_scenes())


def random_solids(seed: int, count: int) -> Solids:
    """Boxes, drums and inclined bars around (0, 0), none of it terrain."""
    rng = np.random.default_rng(seed)
    solids = SolidsBuilder()
    for k in range(count):
        at, low = tuple(rng.uniform(-1.0, 1.0, 2)), float(rng.uniform(-0.5, 1.5))
        high = low + float(rng.uniform(0.02, 0.8))
        if k % 3 == 0:
            solids.cylinder(at, float(rng.uniform(0.02, 0.4)), (low, high))
            continue
        slope = float(rng.uniform(-3.0, 3.0)) if k % 3 == 1 else 0.0
        size = tuple(rng.uniform(0.03, 1.0, 2))
        solids.box(at, size, (low, high), yaw=float(rng.uniform(0, np.pi)), slope=slope, slope_bottom=slope)
    return solids.build()


def overlap(solids: Solids, index: int, position: np.ndarray, body: BodySpec) -> bool:
    """Whether a dense sample of the cylinder at ``position`` has a point in a solid."""
    r, angle = np.meshgrid(np.linspace(0, body.radius, 40), np.linspace(0, 2 * np.pi, 120, endpoint=False))
    disc = np.stack([r * np.cos(angle), r * np.sin(angle)], axis=-1).reshape(-1, 2)
    z = np.linspace(body.step, body.height, 60)
    points = np.concatenate([np.repeat(disc, len(z), axis=0), np.tile(z, len(disc))[:, None]], axis=1) + position
    return bool(inside(solids[index : index + 1], points).any())


@pytest.mark.parametrize("seed", range(3))
def test_contact_is_that_of_a_sampled_cylinder(seed: int) -> None:
    solids = random_solids(seed, 24)
    rng = np.random.default_rng(seed + 10)
    agree = touching = 0
    for k in range(len(solids)):
        obstacles = Obstacles([solids[k : k + 1]], BODY)
        position = np.concatenate([rng.uniform(-1.2, 1.2, (6, 2)), rng.uniform(-0.3, 0.3, (6, 1))], axis=1)
        tensor = torch.from_numpy(position).float()
        _, touched, left = obstacles.push_out(torch.zeros(6, dtype=torch.int64), tensor, pushes=0)
        for p, hit, depth in zip(position, touched.tolist(), left.tolist(), strict=True):
            sampled = overlap(solids, k, p, BODY)
            assert hit or not sampled  # a sample never finds more than there is
            agree += hit == sampled or depth < 0.02  # and misses a graze only
            touching += hit
    assert agree == 6 * len(solids)
    assert 10 < touching < 6 * len(solids) - 10


@pytest.mark.parametrize("seed", range(3))
def test_pushed_out_of_one_solid_by_the_shortest_way(seed: int) -> None:
    solids = random_solids(seed, 12)
    rng = np.random.default_rng(seed)
    for k in range(len(solids)):
        obstacles = Obstacles([solids[k : k + 1]], BODY)
        position = np.concatenate([solids.centre[k] + rng.uniform(-0.7, 0.7, (40, 2)), np.zeros((40, 1))], axis=1)
        tile, tensor = torch.zeros(40, dtype=torch.int64), torch.from_numpy(position).float()
        xy, touched, left = obstacles.push_out(tile, tensor)
        assert (left == 0.0).all()
        assert torch.equal(xy[~touched], tensor[~touched, :2])
        moved = torch.linalg.vector_norm(xy - tensor[:, :2], dim=1)
        _, _, depth = obstacles.push_out(tile, tensor, pushes=0)
        assert torch.allclose(moved[touched], depth[touched], atol=2e-4)
        # no place nearer than that is clear
        angle = torch.linspace(0, 2 * torch.pi, 48)[:, None]
        ring = torch.cat([angle.cos(), angle.sin()], dim=1)
        for e in touched.nonzero()[:4, 0].tolist():
            around = torch.cat([tensor[e, :2] + 0.97 * depth[e] * ring, torch.zeros(48, 1)], dim=1)
            assert (obstacles.push_out(tile[:1].expand(48), around, pushes=0)[2] > 0).all()


def start(world: World, xy: list[tuple[float, float]], yaw: list[float], tile: int) -> Start:
    count = len(xy)
    zero = torch.zeros(count, dtype=torch.int64)
    return Start(zero + tile, zero, torch.tensor(xy), torch.tensor(yaw), zero, torch.zeros(count))


def test_head_height_tubes_are_felt_and_bodies_slide_along_walls(world: World) -> None:
    robot = BodyModel(world, 2, 0.2)
    # towards a vertical tube at (4.4, 5.5) hung from 0.95 m, aside of its axis; obliquely against the wall y = 2
    robot.reset(torch.arange(2), start(world, [(3.4, 5.4), (3.0, 2.6)], [0.0, -0.5], 2))
    command = torch.tensor([[1.0, 0.0, 0.0]]).expand(2, 3)
    touched = torch.zeros(2, dtype=torch.bool)
    for _ in range(12):
        robot.step(command)
        touched |= robot.contacts > 0
        tube = torch.linalg.vector_norm(robot.position[:, :2] - torch.tensor([4.4, 5.5]), dim=1)
        assert (tube >= BODY.radius + 0.025 - 1e-5).all()
        assert (robot.position[:, 1] >= 2.0 + BODY.radius - 1e-5).all()
        assert not robot.brink.any()
    assert touched.all()
    assert robot.position[0, 0] > 4.8  # past the tube
    assert robot.position[1, 0] > 4.5  # along the wall


def test_never_inside_a_solid_whatever_the_commands(world: World) -> None:
    torch.manual_seed(0)
    count = 300
    node = torch.randint(len(world.position), (count,))
    tile = torch.bucketize(node, world.node_start[1:], right=True)
    zero = torch.zeros(count, dtype=torch.int64)
    robot = BodyModel(world, count, 0.2)
    robot.reset(zero + torch.arange(count), Start(tile, zero, world.position[node, :2], torch.zeros(count), zero, zero))
    touched = 0
    for k in range(60):
        if k % 10 == 0:
            command = torch.randn(count, 3) * torch.tensor([1.0, 0.25, 0.5])
        before = robot.position.clone()
        robot.step(command.clamp(-1, 1))
        touched += int((robot.contacts > 0).sum())
        assert robot.obstacles.push_out(robot.tile, robot.position, pushes=0)[2].max() <= 1e-3
        assert (torch.linalg.vector_norm(robot.position - before, dim=1) < 0.3).all()
    assert touched > 500


def test_free_cells_of_the_planning_grid_touch_nothing(world: World) -> None:
    obstacles = Obstacles([tile.solids for tile in world.tiles], BODY)
    torch.manual_seed(1)
    node = torch.randint(len(world.position), (4000,))
    position = world.position[node].clone()
    position[:, :2] += world.cell * (torch.rand(4000, 2) - 0.5)
    tile = torch.bucketize(node, world.node_start[1:], right=True)
    assert not obstacles.push_out(tile, position)[1].any()


def test_terrain_is_no_contact() -> None:
    solids = SolidsBuilder()
    solids.box((0.0, 0.0), (2.0, 2.0), (-0.1, 0.9), label=Label.GROUND, layers=(0, 0))
    obstacles = Obstacles([solids.build(), random_solids(0, 3)], BODY)
    assert not obstacles.push_out(torch.zeros(1, dtype=torch.int64), torch.zeros(1, 3))[1].any()


def test_selected_robots_go_on(world: World) -> None:
    robot, part = BodyModel(world, 3, 0.2), BodyModel(world, 3, 0.2)
    for r in (robot, part):
        r.reset(torch.arange(3), start(world, [(3.4, 5.4), (3.0, 2.6), (2.0, 6.0)], [0.0, -0.5, 1.0], 2))
    keep = torch.tensor([2, 0])
    part.select(keep)
    for _ in range(8):
        robot.step(torch.tensor([[1.0, 0.1, 0.2]]).expand(3, 3))
        part.step(torch.tensor([[1.0, 0.1, 0.2]]).expand(2, 3))
    assert torch.equal(robot.position[keep], part.position)


def test_the_cylinder_holds_the_model_of_the_robot() -> None:
    ground = Geoms.boxes(np.array([[0.0, 0.0, -0.1]]), np.array([[3.0, 3.0, 0.1]]), np.array([[1.0, 0.0, 0.0, 0.0]]))
    model = g1.build_spec(RobotSpec(), ground, visual=True).compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    axis = data.body("pelvis").xpos[:2]
    reach = 0.0
    for g in range(model.ngeom):
        if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_MESH:
            first = model.mesh_vertadr[model.geom_dataid[g]]
            vertices = model.mesh_vert[first : first + model.mesh_vertnum[model.geom_dataid[g]]]
            placed = vertices @ data.geom_xmat[g].reshape(3, 3).T + data.geom_xpos[g]
            reach = max(reach, np.linalg.norm(placed[:, :2] - axis, axis=1).max())
            assert placed[:, 2].max() < BODY.height
    assert reach == pytest.approx(BODY.radius, abs=0.005)
