from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from romnav.errors import RomnavError
from romnav.experiment.spec import parse
from romnav.world.spec import SMALLEST, GridSpec, SamplerSpec, WorldSpec
from romnav.world.tiles import generate

CLASSES = ("building", "outdoor", "room")


@pytest.mark.parametrize(
    ("settings", "key"),
    [
        ({"tiles": 0}, "tiles"),
        ({"tiles": -3}, "tiles"),
        ({"tiles": 2.5}, "tiles"),
        ({"seed": -1}, "seed"),
        ({"goals_per_tile": 0}, "goals_per_tile"),
        ({"side": 0.0}, "side"),
        ({"side": -40.0}, "side"),
        ({"side": math.nan}, "side"),
        ({"side": math.inf}, "side"),
        ({"side": 1e6}, "side"),
        ({"side": 40.1}, "side"),
        ({"side": 14.0}, "side"),
        ({"classes": []}, "classes"),
        ({"classes": ["building", "cave"]}, "classes.1"),
        ({"riser": [0.0, 0.18]}, "riser"),
        ({"riser": [-0.1, 0.18]}, "riser"),
        ({"riser": [0.18, 0.1]}, "riser"),
        ({"riser": [0.1, math.nan]}, "riser.1"),
        ({"riser": [0.1, 0.3]}, "riser"),
        ({"tread": [0.0, 0.3]}, "tread"),
        ({"tread": [0.32, 0.26]}, "tread"),
        ({"tread": [0.2, math.inf]}, "tread.1"),
        ({"storey_height": 0.0}, "storey_height"),
        ({"storey_height": math.nan}, "storey_height"),
        ({"max_storeys": 0}, "max_storeys"),
        ({"max_storeys": 4}, "max_storeys"),
        ({"grid": {"cell": 0.0}}, "grid.cell"),
        ({"grid": {"cell": -0.2}}, "grid.cell"),
        ({"grid": {"cell": math.nan}}, "grid.cell"),
        ({"grid": {"cell": 0.4}}, "grid.cell"),
        ({"grid": {"cell": 1e-3}}, "grid.cell"),
        ({"grid": {"robot_radius": 0.0}}, "grid.robot_radius"),
        ({"grid": {"robot_radius": 0.6}}, "grid.robot_radius"),
        ({"grid": {"robot_height": 2.5}}, "grid.robot_height"),
        ({"grid": {"max_step": 0.0}}, "grid.max_step"),
        ({"grid": {"max_step": 0.1}}, "riser"),
    ],
)
def test_a_bad_world_is_refused_by_its_key(settings: dict[str, Any], key: str) -> None:
    with pytest.raises(RomnavError) as refused:
        parse(WorldSpec, settings, Path("mine.toml"))
    message = str(refused.value)
    assert message.startswith("mine.toml: ")
    assert "\n" not in message
    assert f"{key}:" in message


@pytest.mark.parametrize(
    ("settings", "key"),
    [
        ({"stair_probability": 1.5}, "stair_probability"),
        ({"cross_probability": -0.1}, "cross_probability"),
        ({"max_distance": math.nan}, "max_distance"),
        ({"min_distance": 31.0}, "min_distance"),
        ({"cap": "manhattan"}, "cap"),
    ],
)
def test_a_bad_sampler_is_refused_by_its_key(settings: dict[str, Any], key: str) -> None:
    with pytest.raises(RomnavError, match=f"{key}:"):
        parse(SamplerSpec, settings, Path("mine.toml"))


def _pair(low: float, high: float) -> st.SearchStrategy[tuple[float, float]]:
    return st.tuples(st.floats(low, high), st.floats(low, high)).map(lambda pair: (min(pair), max(pair)))


@settings(deadline=None, max_examples=25, suppress_health_check=[HealthCheck.filter_too_much])
@given(
    name=st.sampled_from(CLASSES),
    cell=st.sampled_from([0.1, 0.15, 0.2, 0.25, 0.3]),
    beyond=st.floats(0.0, 30.0),
    riser=_pair(0.02, 0.3),
    tread=_pair(0.1, 0.5),
    storey_height=st.floats(2.5, 5.5),
    max_storeys=st.integers(0, 4),
    seed=st.integers(0, 1000),
    radius=st.floats(0.05, 0.55),
    step=st.floats(0.02, 0.5),
)
def test_any_world_is_refused_at_once_or_built_in_seconds(
    name: str, cell: float, beyond: float, radius: float, step: float, **others: Any
) -> None:
    begun = time.monotonic()
    side = round((SMALLEST[name] - 1.0 + beyond) / cell) * cell  # type: ignore[index]
    try:
        grid = GridSpec(cell=cell, robot_radius=radius, max_step=step)
        spec = WorldSpec(classes=(name,), side=side, grid=grid, **others)  # type: ignore[arg-type]
    except ValidationError:
        assert time.monotonic() - begun < 0.1
        return
    try:
        tile, grids = generate(spec, 0)
    except RomnavError:
        pass
    else:
        assert tile.side == side
        assert grids.free.any()
    assert time.monotonic() - begun < 60.0


@pytest.mark.parametrize(("name", "side"), [("building", math.nan), ("room", 8.0)])
def test_drawing_ends_where_no_outline_can_fit(name: str, side: float) -> None:
    spec = WorldSpec(classes=(name,)).model_copy(update={"side": side})  # type: ignore[arg-type]
    with pytest.raises(RomnavError, match=r"world\.side"):
        generate(spec, 0)


def test_a_world_in_which_nothing_is_reached_ends_in_an_error_that_says_what_is_not() -> None:
    tall = GridSpec().model_copy(update={"robot_height": 9.0})
    spec = WorldSpec(classes=("building",), side=12.0).model_copy(update={"grid": tall})
    with pytest.raises(RomnavError, match=r"storey 0: 0 of \d+ cells reached"):
        generate(spec, 0)
