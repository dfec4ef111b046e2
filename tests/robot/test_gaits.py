"""The gait library: states moved elsewhere walk on as they did."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from romnav.errors import RomnavError
from romnav.robot.g1 import Humanoids
from romnav.robot.gaits import Gait, GaitLibrary, move
from romnav.robot.locomotion.control import Controller
from romnav.robot.locomotion.terrain import Ground, flat
from romnav.robot.spec import LocomotionSpec

SPEC = LocomotionSpec()


def walk(control: Controller, ground: Ground, ticks: int, *, first: bool = False) -> torch.Tensor:
    command = torch.tensor([[0.3, 0.0, 0.0]]).expand(control.robots.count, -1)
    track = []
    for k in range(ticks):
        control.refer(command, ground.map, torch.full((control.robots.count,), first and k == 0))
        control.act(torch.zeros(control.robots.count, 15))
        track.append(control.robots.pelvis.clone())
    return torch.stack(track)


@pytest.fixture(scope="module")
def walking() -> tuple[Controller, Ground, dict[str, torch.Tensor], torch.Tensor]:
    """A robot on the flat after half a second, its snapshot there, and its way on."""
    ground = Ground([flat()])
    control = Controller(SPEC, Humanoids(SPEC.robot, [ground.geoms], 2, threads=1))
    start = torch.tensor([[-60.0, 0.0, 0.0], [-40.0, 5.0, 0.0]])
    ids = torch.arange(2)
    control.stand(ids, start, torch.zeros(2), torch.zeros(2, dtype=torch.long), torch.tensor([[0.3, 0, 0]] * 2))
    walk(control, ground, 25, first=True)
    state = control.snapshot(torch.tensor([0]))
    return control, ground, state, walk(control, ground, 15)[:, 0]


def test_a_moved_state_walks_on_like_the_recorded_one(walking: tuple) -> None:
    control, ground, state, way = walking
    shift, turn = torch.tensor([[3.0, -2.0, 0.0]]), torch.tensor([2.0])
    control.restore(torch.tensor([0]), state)
    control.restore(torch.tensor([1]), move(state, turn, shift))
    again = walk(control, ground, 15)
    torch.testing.assert_close(again[:, 0], way, atol=2e-3, rtol=0)
    c, s = torch.cos(turn), torch.sin(turn)
    x, y = way[:, 0], way[:, 1]
    moved = torch.stack([c * x - s * y, s * x + c * y, way[:, 2]], dim=1) + shift
    torch.testing.assert_close(again[:, 1], moved, atol=5e-3, rtol=0)


def test_moving_there_and_back_changes_nothing(walking: tuple) -> None:
    _, _, state, _ = walking
    turn, shift = torch.tensor([1.2]), torch.tensor([[1.0, 2.0, 3.0]])
    back = move(move(state, torch.zeros(1), -shift), torch.zeros(1), shift)
    turned = move(move(state, turn, torch.zeros(1, 3)), -turn, torch.zeros(1, 3))
    for name, value in state.items():
        torch.testing.assert_close(back[name], value, atol=1e-4, rtol=0)
        if name not in ("qpos",):
            torch.testing.assert_close(turned[name], value, atol=1e-4, rtol=0)
    torch.testing.assert_close(turned["qpos"], state["qpos"], atol=1e-4, rtol=0)


def test_lookup_takes_the_nearest_slope_and_survives_a_file(walking: tuple, tmp_path: Path) -> None:
    _, _, state, _ = walking
    library = GaitLibrary([Gait("stair", 1, s, state) for s in (0.3, 0.5, 0.7)] + [Gait("ramp", -1, 0.2, state)])
    library.save(tmp_path / "gaits.pt")
    loaded = GaitLibrary.load(tmp_path / "gaits.pt")
    assert loaded.nearest("stair", 1, 0.58).slope == 0.5
    assert len(loaded.nearest("ramp", -1, 0.9)) == 1
    with pytest.raises(RomnavError, match="no walk down a stair"):
        loaded.nearest("stair", -1, 0.5)
    with pytest.raises(RomnavError, match="no such gait library"):
        GaitLibrary.load(tmp_path / "none.pt")
