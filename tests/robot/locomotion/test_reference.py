"""The kernel of the reference: footholds on flights, and control steps against the same written out."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from romnav.kernels import wp
from romnav.robot.g1 import FOOT_LENGTH
from romnav.robot.heights import HeightMap, Maps
from romnav.robot.locomotion.lane_task import LocomotionEnv
from romnav.robot.locomotion.lip import Gait, gait_of
from romnav.robot.locomotion.reference import clear_of_edges
from romnav.robot.locomotion.terrain import flat, ramp, stairs
from romnav.robot.locomotion.walker import Walker
from romnav.robot.spec import GaitSpec, LocomotionSpec, TaskSpec
from tests.robot.locomotion.written_out import step

CELL = 0.001

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


@wp.kernel
def _move(gait: Gait, maps: Maps, level: float, places: wp.array(dtype=wp.vec2)):  # type: ignore[valid-type]
    robot = wp.tid()
    places[robot] = clear_of_edges(gait, maps, robot, places[robot], 0.0, 9.0, level)


def foothold(ground: Callable[[NDArray], NDArray], x: float, level: float) -> float:
    """Where a foothold at `x` is moved to, the stance foot standing at height `level`."""
    grid = (np.arange(3000) + 0.5) * CELL - 1.0
    heights = torch.tensor(ground(grid), dtype=torch.float32)[:, None].expand(-1, 1)
    place = torch.tensor([[x, 0.0]])
    inputs = [gait_of(GaitSpec(), 0.02), HeightMap((-1.0, 0.0), CELL, heights).maps, level]
    wp.launch(_move, 1, inputs, [wp.from_torch(place, dtype=wp.vec2)], device="cpu")
    return place[0, 0].item()


@settings(deadline=None)  # the first call compiles
@given(st.floats(0.0, 0.3), st.sampled_from([0.10, 0.18]), st.floats(0.26, 0.32))
def test_soles_keep_clear_of_risers(x: float, riser: float, tread: float) -> None:
    """Up and down a flight, the whole sole is on one tread, and as far from the riser as the margin and tread allow."""
    half, margin = FOOT_LENGTH / 2, GaitSpec().edge_margin
    for way in (1.0, -1.0):
        place = foothold(lambda p, way=way: way * riser * np.floor(p / tread), x, 0.0)
        step = np.floor(place / tread)
        before, behind = (step + 1) * tread - (place + half), place - half - step * tread
        assert min(before, behind) > -2 * CELL
        assert (before if way > 0 else behind) > min(margin, tread - 2 * half - 0.02) - 2 * CELL


def test_a_drop_beside_the_sole_moves_no_foothold() -> None:
    edge = 0.3
    place = edge - FOOT_LENGTH / 2 - 0.005
    assert foothold(lambda p: -0.15 * (p > edge), place, 0.0) == pytest.approx(place, abs=1e-6)
    assert foothold(lambda p: 0.15 * (p > edge), place, 0.0) < place - 0.03


def test_control_steps_are_as_written_out() -> None:
    """Robots that walk from flights, a ramp and the flat, under a second storey that only the higher can reach."""
    count = 8
    spec = LocomotionSpec(task=TaskSpec(robots=count, shares={"flat": 0.2, "ramp": 0.2, "stairs": 0.6}))
    env = LocomotionEnv(spec, [flat(), ramp(0, 12.0, 2.0), *(stairs(i, 0.08 * (i + 1), 0.3, 0.28, 4) for i in (0, 1))])
    control, robots, ground = env.control, env.robots, env.ground.map
    lower = wp.to_torch(ground.maps.blocks)
    upper = torch.full_like(lower, 0.65)
    upper[:, ::2] = -torch.inf
    layers, table = torch.cat([lower, upper]), torch.tensor([[[[0]], [[1]]]], dtype=torch.int32)
    ground.maps.blocks, ground.maps.table, ground.maps.headroom = wp.from_torch(layers), wp.from_torch(table), 0.0

    def under(points: NDArray, reach: float) -> NDArray:
        """From the maps themselves."""
        cells = np.floor((points.astype(np.float32) + np.float32(4.0)) / np.float32(0.02)).astype(int)
        x, y = np.clip(cells, 0, np.array(layers.shape[1:]) - 1).T
        at = layers[:, x, y].numpy()
        return np.where(at <= np.float32(reach), at, -np.inf).max(0).astype(float)

    fields = (
        "pelvis", "orientation", "velocity", "com", "com_velocity", "ankle", "ankle_rotation", "anchor", "axis",
    )  # fmt: skip
    random = np.random.default_rng(0)
    worst: dict[str, list[float]] = {}
    for tick in range(30):
        if tick % 10 == 0:
            told = torch.tensor(random.uniform([-0.5, -0.25, -1.0], [1.0, 0.25, 1.0], (count, 3)), dtype=torch.float32)
        fresh = torch.tensor(random.random(count) < 0.05)
        before = control.snapshot(torch.arange(count))
        sensed = {name: getattr(robots, name).double().numpy().copy() for name in fields}
        sensed["feet"] = robots.touch[:, robots.feet].numpy().copy()
        control.refer(told, ground, fresh)
        walker = control.walker
        targets = vars(control.reference) | {"ankle": walker._ankle, "ankle_rotation": walker._ankle_rotation}
        for i in range(count):
            state = {name: value[i].double().numpy() for name, value in before.items()}
            robot = {name: value[i] for name, value in sensed.items()}
            now, wanted = step(
                spec.gait, control.dt, robots.mass, state, robot, told[i].double().numpy(), bool(fresh[i]), under
            )
            for name, value in (*now.items(), *wanted.items()):
                found = targets[name] if name in wanted else getattr(walker, name)
                worst.setdefault(name, []).append(
                    float((np.abs(found[i].numpy().astype(float) - value) / (1 + np.abs(value))).max())
                )
        control.act(torch.zeros(count, 15))
    for name, errors in worst.items():
        # single precision, 60 m from the origin: micrometres, of an arm on which the weight is
        assert np.mean(np.array(errors) > (5e-3 if name == "torque" else 1e-4)) < 0.01, name
    assert set(worst) == set(Walker.STATE[:-1]) | set(targets) - {"joints"}
    assert (control.reference.foothold[:, 2] > 0.1).any()
