from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from romnav.errors import RomnavError
from romnav.evaluation import episodes
from romnav.evaluation.episodes import EpisodeSet
from romnav.evaluation.spec import EpisodeSetSpec
from romnav.world.build import build
from romnav.world.spec import SamplerSpec, WorldSpec
from romnav.world.world import World

SPEC = EpisodeSetSpec(
    world=WorldSpec(tiles=3, seed=41, goals_per_tile=8),
    episodes=48,
    cross=20,
    sampler=SamplerSpec(stair_probability=0.0),
)


@pytest.fixture(scope="module")
def world() -> World:
    return build(SPEC.world)


@pytest.fixture(scope="module")
def drawn(world: World) -> EpisodeSet:
    return episodes.draw("test", SPEC, world)


def spawn_nodes(drawn: EpisodeSet, world: World) -> np.ndarray:
    start = drawn.start("cpu")
    return world.node_at(start.tile, start.layer, start.xy).numpy()


def test_drawn_saved_and_read_are_one_set(drawn: EpisodeSet, world: World, tmp_path: Path) -> None:
    episodes.save(tmp_path / "test.json", drawn)
    read = episodes.load(tmp_path / "test.json")
    assert read.digest == drawn.digest
    for key, column in drawn.columns.items():
        assert np.array_equal(column, read.columns[key])
    assert len(read) == 48
    assert read.cross.sum() == 20
    assert not np.isin(spawn_nodes(read, world), world.spawn.numpy()).any()
    assert (read.columns["geodesic"] <= 30.0).all()
    episodes.terrain(read, tmp_path / "test.json", None)


def test_hash_names_terrain_and_episodes(drawn: EpisodeSet) -> None:
    moved = {**drawn.columns, "spawn_x": drawn.columns["spawn_x"] + 0.001}
    assert EpisodeSet("test", drawn.world, moved).digest != drawn.digest
    other = drawn.world.model_copy(update={"seed": 42})
    assert EpisodeSet("test", other, drawn.columns).digest != drawn.digest


def test_edited_set_is_refused(drawn: EpisodeSet, tmp_path: Path) -> None:
    path = tmp_path / "test.json"
    episodes.save(path, drawn)
    data = json.loads(path.read_text())
    data["goal_x"][3] += 1.0
    path.write_text(json.dumps(data))
    with pytest.raises(RomnavError, match=r"test\.json: key 'hash' is \w+, but the content hashes to"):
        episodes.load(path)


def test_torn_and_missing_sets(drawn: EpisodeSet, tmp_path: Path) -> None:
    path = tmp_path / "test.json"
    episodes.save(path, drawn)
    path.write_text(path.read_text()[:500])
    with pytest.raises(RomnavError, match="not an episode set"):
        episodes.load(path)
    with pytest.raises(RomnavError, match="no such episode set; there are: test"):
        episodes.load(tmp_path / "other.json")


def test_goal_in_a_wall_is_found(drawn: EpisodeSet, world: World, tmp_path: Path) -> None:
    """A set that does not fit its terrain, as after a change of the generator, is refused whole."""
    wrong = EpisodeSet("test", drawn.world, {**drawn.columns, "spawn_x": np.full(48, 0.05)})
    with pytest.raises(RomnavError, match=r"episode 0 does not fit its terrain .* drawn by another world generator"):
        episodes.terrain(wrong, tmp_path / "test.json", None)


@pytest.mark.parametrize("name", ["paired-2", "dev"])
def test_the_shipped_sets(name: str) -> None:
    """They fit today's generator, on terrain of other seeds than training and each other."""
    path = Path(__file__).parents[2] / "experiments" / "episodes" / f"{name}.json"
    paired = episodes.load(path)
    assert len(paired) == 1024
    assert paired.cross.sum() == 488
    assert paired.world.seed == {"paired-2": 3000, "dev": 2000}[name] != WorldSpec().seed
    world = episodes.terrain(paired, path, None)
    assert not np.isin(spawn_nodes(paired, world), world.spawn.numpy()).any()
