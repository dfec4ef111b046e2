from __future__ import annotations

import numpy as np
import pytest
import torch

from romnav.evaluation import episodes
from romnav.evaluation.episodes import EpisodeSet
from romnav.evaluation.paired.failures import classify, on_connector
from romnav.evaluation.paired.run import run
from romnav.evaluation.rollout import Oracle, Straight, View
from romnav.evaluation.spec import EpisodeSetSpec, EvaluationSpec
from romnav.evaluation.tracks import Recorder
from romnav.navigation.spec import EnvSpec
from romnav.world.build import build
from romnav.world.spec import SamplerSpec, WorldSpec
from romnav.world.world import World

SPEC = EpisodeSetSpec(
    world=WorldSpec(tiles=3, seed=53, goals_per_tile=16),
    episodes=60,
    cross=30,
    sampler=SamplerSpec(stair_probability=0.0),
)


class Fixed:
    """The same command always."""

    def __init__(self, *command: float) -> None:
        self._command = torch.tensor(command)

    def command(self, view: View) -> torch.Tensor:
        return self._command.expand(len(view.episode), 3)

    def select(self, keep: torch.Tensor) -> None:
        pass


@pytest.fixture(scope="module")
def world() -> World:
    return build(SPEC.world)


@pytest.fixture(scope="module")
def paired(world: World) -> EpisodeSet:
    return episodes.draw("test", SPEC, world)


def failures(driver: object, world: World, paired: EpisodeSet, duration: float) -> tuple[np.ndarray, ...]:
    recorder = Recorder()
    out = run(driver, world, paired, EnvSpec(), EvaluationSpec(duration=duration), recorder=recorder)
    rows = {**out, "goal_z": paired.columns["goal_z"], "level": np.where(paired.cross, "cross", "same")}
    rows["tile"] = paired.columns["tile"]
    where, how = classify(recorder.tracks(len(paired)), rows, world, 0.2)
    assert ((where == "") == (out["outcome"] == "success")).all()
    assert ((how == "") == (where == "")).all()
    return where, how, out["outcome"] != "success"


def test_who_stands_stood(world: World, paired: EpisodeSet) -> None:
    where, how, failed = failures(Fixed(0.0, 0.0, 0.0), world, paired, 5.0)
    assert (how[failed] == "stood").all()
    assert (where[failed & ~paired.cross] == "same level").all()
    assert (where[failed & paired.cross] == "never on a stair").all()


def test_who_goes_round_circled(world: World, paired: EpisodeSet) -> None:
    """A circle of 1 m: within 20 s three times around, but for those that meet a wall."""
    _, how, failed = failures(Fixed(0.9, 0.0, 0.9), world, paired, 25.0)
    assert (how[failed] == "circled").mean() > 0.4
    assert np.isin(how[failed], ("circled", "pressed", "roamed")).all()


def test_who_walks_into_a_wall_pressed(world: World, paired: EpisodeSet) -> None:
    _, how, failed = failures(Straight(), world, paired, 60.0)
    assert (how[failed] == "pressed").mean() > 0.9


def test_who_knows_the_way_was_on_a_stair_or_on_the_level(world: World, paired: EpisodeSet) -> None:
    """The oracle, stopped early, roams; where it has climbed it is on a stair or beyond."""
    recorder = Recorder()
    out = run(Oracle(), world, paired, EnvSpec(), EvaluationSpec(duration=12.0), recorder=recorder)
    rows = {**out, "goal_z": paired.columns["goal_z"], "level": np.where(paired.cross, "cross", "same")}
    rows["tile"] = paired.columns["tile"]
    tracks = recorder.tracks(len(paired))
    where, how = classify(tracks, rows, world, 0.2)
    failed = np.flatnonzero(out["outcome"] == "timeout")
    assert len(failed) > 10
    assert (how[failed] == "roamed").mean() > 0.9
    for episode in failed[paired.cross[failed]]:
        z = tracks.position[tracks.of(episode), 2]
        climbed = np.ptp(z) > 0.5
        assert climbed == (where[episode] != "never on a stair") or where[episode] == "on a stair"
        assert (where[episode] == "on the goal's level") == (np.abs(z - rows["goal_z"][episode]) <= 0.5).any()


def test_connectors_are_those_of_the_nodes(world: World) -> None:
    for tile, grids in enumerate(world.grids):
        assert (on_connector(world, tile, grids.position.astype(float)) == grids.connector).all()
