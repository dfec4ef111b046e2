"""Episodes walked on a small world, for what is made of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from romnav.evaluation import episodes, tracks
from romnav.evaluation.paired import rows
from romnav.evaluation.paired.failures import classify
from romnav.evaluation.paired.run import run
from romnav.evaluation.paired.statistics import Bootstrap
from romnav.evaluation.rollout import SCRIPTED
from romnav.evaluation.spec import EpisodeSetSpec, EvaluationSpec
from romnav.experiment.project import Project
from romnav.navigation.spec import EnvSpec
from romnav.report.formats import Table
from romnav.report.paired import tables
from romnav.report.paired.gallery import EpisodeGallery
from romnav.report.spec import PAIRED
from romnav.world.build import build as build_world
from romnav.world.spec import SamplerSpec, WorldSpec

ROOT = Path(__file__).parents[2]
PAPER = Project(ROOT, ROOT / "results")
Walk = Callable[[int], dict[str, EpisodeGallery]]


@pytest.fixture(scope="session")
def papers_tables() -> Callable[[Sequence[rows.Arm]], dict[str, Table]]:
    """Makes those of the paper's tables of paired episodes that compare some of these arms."""

    def build(arms: Sequence[rows.Arm]) -> dict[str, Table]:
        bootstrap, made = Bootstrap(arms), {}
        for experiment in ("spawn-goal", "kickstart"):
            declared = PAPER.experiment(experiment).declared(experiment, PAIRED)
            for name, spec in declared.tables.items():
                if len(tables.evaluated(spec, bootstrap)) > 1:
                    made[name] = tables.build(name, spec, declared.title, bootstrap, PAPER.published(experiment))
        return made

    return build


@pytest.fixture(scope="session")
def walk() -> Walk:
    """Lets both scripted arms walk a number of episodes on three tiles, a building, an outdoor one and a room."""
    world = build_world(WorldSpec(tiles=3, seed=51, goals_per_tile=12))

    def walked(count: int) -> dict[str, EpisodeGallery]:
        spec = EpisodeSetSpec(
            world=world.spec, episodes=count, cross=count // 2, sampler=SamplerSpec(stair_probability=0.0)
        )
        drawn = episodes.draw("test", spec, world)
        return {name: _gallery(name, drawn, world) for name in SCRIPTED}

    return walked


@pytest.fixture(scope="session")
def galleries(walk: Walk) -> dict[str, EpisodeGallery]:
    """Thirty-two episodes of both."""
    return walk(32)


def _gallery(name: str, drawn: episodes.EpisodeSet, world: episodes.World) -> EpisodeGallery:
    recorder, count = tracks.Recorder(), len(drawn)
    measured = run(SCRIPTED[name](), world, drawn, EnvSpec(), EvaluationSpec(), recorder=recorder)
    columns = {
        "arm": [name] * count,
        "seed": [0] * count,
        "episode": range(count),
        "tile_class": [str(world.tiles[t].kind) for t in drawn.columns["tile"]],
        "multi_story": [world.tiles[t].multi_story for t in drawn.columns["tile"]],
        "level": np.where(drawn.cross, "cross", "same"),
        **{key: values for key, values in drawn.columns.items() if key in rows.SCHEMA.names},
        **measured,
    }
    ways = recorder.tracks(count)
    columns["where"], columns["how"] = classify(ways, columns, world, EnvSpec().period)
    provenance = rows.Provenance(
        scale="smoke", commit="0123456789abcdef", spec_hash="spec", checkpoint_sha256=None,
        episode_set=drawn.digest, version="0.1.0", steps=0, hours=0.0, machine="2 cores",
    )  # fmt: skip
    made = rows.make(columns, provenance, f"results/smoke/{name}/seed-0/episodes.parquet")
    return EpisodeGallery(made, ways, drawn, world, EnvSpec().period)
