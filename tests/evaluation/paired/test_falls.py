"""Falls by place, against a count of one robot after the other."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from romnav.evaluation import episodes
from romnav.evaluation.paired import falls
from romnav.evaluation.rollout import Oracle
from romnav.evaluation.spec import EpisodeSetSpec, EvaluationSpec
from romnav.navigation.spec import EnvSpec
from romnav.robot.rom import ReducedOrderModel
from romnav.world.build import build
from romnav.world.spec import WorldSpec
from romnav.world.world import World

SPEC = EpisodeSetSpec(world=WorldSpec(tiles=2, seed=51, goals_per_tile=12), episodes=24, cross=12)


class Stumbling(ReducedOrderModel):
    """Falls on the step on which its height has changed for the third time, and logs its way."""

    made: list[Stumbling] = []  # noqa: RUF012 - the test reads it

    def __init__(self, world: World, envs: int, period: float) -> None:
        super().__init__(world, envs, period)
        self.env = torch.arange(envs)
        self.climbs = torch.zeros(envs)
        self.way = torch.zeros(envs, dtype=torch.float64)
        self.total = torch.zeros(envs, dtype=torch.float64)
        self.fell = torch.zeros(envs, dtype=torch.bool)
        self.made.append(self)

    def step(self, command: Tensor) -> None:
        before, lying = self.position.clone(), self.fallen.clone()
        super().step(torch.where(lying[:, None], 0.0, command))
        self.climbs += ((self.position - before)[:, 2].abs() > 0.02).float()
        self.fallen = lying | (self.climbs >= 3)
        walked = torch.linalg.vector_norm((self.position - before)[:, :2], dim=1).double()
        self.total[self.env] += torch.where(lying, 0.0, walked)
        self.fell[self.env] |= self.fallen

    def select(self, envs: Tensor) -> None:
        super().select(envs)
        self.climbs, self.env = self.climbs[envs], self.env[envs]


@pytest.fixture(scope="module")
def counted() -> tuple[list[dict], Stumbling]:
    world = build(SPEC.world)
    drawn = episodes.draw("test", SPEC, world)
    spec = EvaluationSpec(duration=30.0)
    rows = falls.count("oracle", Oracle(), world, drawn, EnvSpec(), spec, Stumbling)
    return rows, Stumbling.made[-1]


def test_places_add_up_to_all(counted: tuple[list[dict], Stumbling]) -> None:
    (whole, *places), robots = counted
    assert [row["place"] for row in places] == list(falls.PLACES)
    assert {row["driver"] for row in (whole, *places)} == {"oracle"}
    assert {row["episodes"] for row in (whole, *places)} == {24}
    assert whole["fell"] == pytest.approx(robots.fell.float().mean().item())
    assert sum(row["fell"] for row in places) == pytest.approx(whole["fell"])
    assert 0.2 < whole["fell"] < 0.9
    assert 0.0 < whole["sr_45"] <= whole["sr_120"] < 1.0 - whole["fell"] + 1e-9
    # who has arrived walks on until the batch is made smaller, which counts nowhere
    assert sum(row["way"] for row in places) == pytest.approx(whole["way"])
    assert whole["way"] < robots.total.sum().item()


def test_falls_on_stairs_are_counted_there(counted: tuple[list[dict], Stumbling]) -> None:
    rows, _ = counted
    by_place = {row["place"]: row for row in rows}
    climbing = sum(by_place[place]["fell"] for place in ("stair up", "stair down", "ramp", "at a wall"))
    assert climbing >= 0.8 * by_place["all"]["fell"]
    for row in rows:
        if row["way"] > 0:
            expected = 100.0 * row["fell"] * 24 / row["way"]
            assert row["falls_per_100m"] == pytest.approx(expected)
        else:
            assert row["falls_per_100m"] is None
    assert np.isfinite([row["way"] for row in rows]).all()
