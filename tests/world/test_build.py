from __future__ import annotations

import os
import pickle
from collections.abc import Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from romnav import arrays
from romnav.world import build as module
from romnav.world.build import build
from romnav.world.lookup import GeodesicLookup
from romnav.world.spec import WorldSpec
from romnav.world.world import World

SPEC = WorldSpec(tiles=3, seed=31, goals_per_tile=5)


@pytest.fixture(scope="module")
def world() -> World:
    return build(SPEC)


def same(a: Any, b: Any) -> bool:
    """Whether two values are equal to the last bit and type, arrays and dataclasses through and through."""
    if type(a) is not type(b):
        return False
    if is_dataclass(a):
        return all(same(getattr(a, f.name), getattr(b, f.name)) for f in fields(a) if f.name != "seconds")
    if isinstance(a, torch.Tensor):
        return same(a.numpy(), b.numpy())
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    if isinstance(a, Sequence) and not isinstance(a, str):
        return len(a) == len(b) and all(map(same, a, b))
    return bool(a == b)


@pytest.fixture
def generated(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Indices of the tiles that are generated."""
    made: list[int] = []
    generate = module.generate
    monkeypatch.setattr(module, "generate", lambda spec, index: made.append(index) or generate(spec, index))
    return made


def test_same_seed_same_world_other_seed_other_world(world: World) -> None:
    assert same(world, build(SPEC))
    other = build(SPEC.model_copy(update={"seed": 32}))
    assert not torch.equal(world.node, other.node)


def test_a_world_from_the_cache_is_the_same_through_and_through(
    world: World, tmp_path: Path, generated: list[int]
) -> None:
    first = build(SPEC, tmp_path)
    assert generated == [0, 1, 2]
    again = build(SPEC, tmp_path)
    assert generated == [0, 1, 2]
    assert same(world, again)
    assert again.seconds == first.seconds > 0.0
    build(SPEC.model_copy(update={"goals_per_tile": 4}), tmp_path)
    assert len(generated) == 6


def test_paths_in_a_world_from_the_cache_lead_where_they_did(world: World, tmp_path: Path) -> None:
    build(SPEC, tmp_path)
    cached = build(SPEC, tmp_path)
    goal = torch.arange(len(world.goal))
    tile = torch.repeat_interleave(world.goal_start.diff())
    node = world.node_start[tile] + 17
    at = tile, world.layer[node], world.position[node, :2] + 0.03, goal
    for a, b in zip(GeodesicLookup(world)(*at), GeodesicLookup(cached)(*at), strict=True):
        assert torch.equal(a, b)


class Bomb:
    """Unpickling it makes a folder."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.path),)


def test_a_torn_or_foreign_file_is_made_anew_and_not_run(world: World, tmp_path: Path, generated: list[int]) -> None:
    build(SPEC, tmp_path)
    (path,) = tmp_path.iterdir()
    whole = path.read_bytes()
    arrays.save(tmp_path / "foreign", {"a": np.zeros(3)}, {"b": 1})
    stored = arrays.load(path)
    assert stored is not None
    arrays.save(tmp_path / "renamed", stored[0], stored[1] | {"key": "another"})
    lacking = {name: array for name, array in stored[0].items() if name != "fields"}
    arrays.save(tmp_path / "lacking", lacking, stored[1])
    broken = [(tmp_path / name).read_bytes() for name in ("foreign", "renamed", "lacking")]
    for content in (whole[:1000], whole[:-1], b"", pickle.dumps(Bomb(tmp_path / "exploded")), *broken):
        generated.clear()
        path.write_bytes(content)
        assert torch.equal(build(SPEC, tmp_path).node, world.node)
        assert generated == [0, 1, 2]
        assert path.read_bytes()[:8] == whole[:8]
    assert not (tmp_path / "exploded").exists()
