"""Stages on a Ray cluster of two machines, which are processes of this one."""

from __future__ import annotations

import importlib
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from romnav import stopping
from romnav.errors import RomnavError
from romnav.evaluation import episodes
from romnav.evaluation.spec import EpisodeSetSpec
from romnav.experiment.graph import records
from romnav.experiment.graph.cluster import GRACE, execute_on_ray
from romnav.experiment.graph.run import pending
from romnav.experiment.graph.stage import Session, Stage
from romnav.progress import Progress
from romnav.world.build import build
from romnav.world.spec import WorldSpec
from tests.experiment.graph.test_run import Settings, stage, write

NEEDS = {"num_cpus": 1, "num_gpus": 0, "memory": 1e8}
STEPS = 40


def count(this: Stage, session: Session, progress: Progress) -> dict[str, Any]:
    """Goes on from its checkpoint, and says in which processes it ran."""
    this.folder.mkdir(parents=True, exist_ok=True)
    state, ran = this.folder / "checkpoint", this.folder / "processes"
    with ran.open("a") as file:
        file.write(f"{os.getpid()}\n")
    done = int(state.read_text()) if state.exists() else 0
    for step in range(done, STEPS):
        time.sleep(0.1)
        state.with_suffix(".new").write_text(str(step + 1))
        state.with_suffix(".new").replace(state)
        progress(step + 1, STEPS, "counted")
    return write(this, session, progress)


def tell_when(this: Stage, session: Session, progress: Progress) -> dict[str, Any]:
    """Has much to say, and tells when it ran."""
    begun = time.time()
    for _ in range(STEPS):
        time.sleep(0.2)  # long enough for another worker to start meanwhile
        print(*range(20), sep="\n", file=sys.stderr)
    return write(this, session, progress) | {"span": [begun, time.time()]}


def save_when_asked(this: Stage, session: Session, progress: Progress) -> dict[str, Any]:
    """Has nothing on disk until it is stopped, as a training between two checkpoints."""
    this.folder.mkdir(parents=True, exist_ok=True)
    (this.folder / "began").touch()
    with stopping.deferred() as stop:
        for _ in range(1000):
            time.sleep(0.1)
            if stop:
                (this.folder / "checkpoint").write_text("saved")
            stop.obey()
    return write(this, session, progress)


def fail(this: Stage, session: Session, progress: Progress) -> dict[str, Any]:
    raise RomnavError("this stage cannot")


def test_another_engine_is_refused() -> None:
    with pytest.raises(RomnavError, match="--on slurm: no engine; give ray or ray://host:port"):
        execute_on_ray("slurm", NEEDS, [], Session(), print)


@pytest.fixture
def cluster() -> Iterator[Any]:
    pytest.importorskip("ray", reason="Ray is not installed: pip install -e '.[ray]'")
    from ray.cluster_utils import Cluster

    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
    made.nodes = [made.add_node(num_cpus=1) for _ in range(2)]
    os.environ["RAY_ADDRESS"] = made.address
    yield made
    del os.environ["RAY_ADDRESS"]
    made.shutdown()


@pytest.mark.slow
def test_stages_run_in_order_and_survive_a_machine(
    tmp_path: Path, cluster: Any, capfd: pytest.CaptureFixture[str]
) -> None:
    first = stage(tmp_path, "a", Settings())
    long = [stage(tmp_path, key, Settings(), (first,), make=count, scratch=("checkpoint",)) for key in "bc"]
    last = stage(tmp_path, "d", Settings(), tuple(long))
    stages = pending([last])

    def pull_the_plug() -> None:
        while not all((one.folder / "checkpoint").exists() for one in long):
            time.sleep(0.1)
        time.sleep(0.5)
        cluster.remove_node(cluster.nodes[0], allow_graceful=False)

    killer = threading.Thread(target=pull_the_plug)
    killer.start()
    execute_on_ray("ray", NEEDS, stages, Session(), print)
    killer.join()
    assert all(records.finished(one) for one in stages)
    assert sorted(len((one.folder / "processes").read_text().split()) for one in long) == [1, 2]
    assert not pending([last])
    assert "counted" in capfd.readouterr().err


@pytest.mark.slow
def test_no_more_stages_run_at_once_than_there_are_cores(tmp_path: Path, cluster: Any) -> None:
    stages = [stage(tmp_path, key, Settings(), make=tell_when) for key in "abcd"]
    execute_on_ray("ray", NEEDS, stages, Session(), print)
    spans = [records.read(one).facts["span"] for one in stages]
    assert max(sum(begun <= start < ended for begun, ended in spans) for start, _ in spans) <= 2


@pytest.mark.slow
def test_the_first_failure_names_its_reason(tmp_path: Path, cluster: Any) -> None:
    good, bad = stage(tmp_path, "a", Settings(), make=count), stage(tmp_path, "b", Settings(), make=fail)
    with pytest.raises(RomnavError, match="this stage cannot"):
        execute_on_ray("ray", NEEDS, [good, bad], Session(), print)
    assert not records.finished(good)


@pytest.mark.slow
def test_stages_save_when_they_are_interrupted(tmp_path: Path, cluster: Any) -> None:
    long = [stage(tmp_path, key, Settings(), make=save_when_asked, scratch=("checkpoint",)) for key in "ab"]

    def interrupt() -> None:
        while not all((one.folder / "began").exists() for one in long):
            time.sleep(0.1)
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt).start()
    begun = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        execute_on_ray("ray", NEEDS, long, Session(), print)
    assert time.monotonic() - begun < GRACE
    assert [(one.folder / "checkpoint").read_text() for one in long] == ["saved"] * 2


EXPERIMENT = """
kind = "ablation"
title = "Two arms"

[tables.pair]
caption = "Two arms"

[arms.rom]
label = "RoM"

[arms.uniform]
label = "Uniform"
navigation.env.sampler.stair_probability = 0.0
"""
EVALUATION = """
[evaluation]
episodes = "few"
duration = 8.0
"""


@pytest.fixture
def ablation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Any, Path]:
    """The benchmark, and a project whose ablation "pair" takes a minute at scale "tiny"."""
    pytest.importorskip("ray", reason="Ray is not installed: pip install -e '.[ray]'")
    monkeypatch.syspath_prepend(Path(__file__).parents[3] / "benchmarks")
    project = tmp_path / "project"
    (project / "experiments" / "scales").mkdir(parents=True)
    (project / "experiments" / "pair.toml").write_text(EXPERIMENT)
    (project / "experiments" / "scales" / "tiny.toml").write_text(importlib.import_module("_kills").TINY + EVALUATION)
    terrain = WorldSpec(tiles=2, seed=3000, side=20.0, classes=("building", "outdoor"), goals_per_tile=8)
    drawn = episodes.draw("few", EpisodeSetSpec(world=terrain, episodes=16, cross=4), build(terrain))
    episodes.save(project / "experiments" / "episodes" / "few.json", drawn)
    return importlib.import_module("raylets"), project


@pytest.mark.slow
def test_an_ablation_has_the_same_rows_on_a_cluster_that_loses_a_machine(
    tmp_path: Path, ablation: tuple[Any, Path]
) -> None:
    raylets, project = ablation
    raylets.warm(project, "tiny")
    raylets.ablation(project, "pair", "tiny", tmp_path / "alone")
    began = [tmp_path / "ray" / "tiny" / arm / "seed-0" / "spec.json" for arm in ("rom", "uniform")]
    raylets.on_ray(project, "pair", "tiny", tmp_path / "ray", plug=lambda: all(map(Path.exists, began)))
    assert raylets.same_rows(tmp_path / "alone", tmp_path / "ray")
    assert not raylets.same_rows(tmp_path / "alone", tmp_path / "none")
    stages = raylets.stages(project, "pair", "tiny", tmp_path / "alone")
    assert len(stages) > 6
    assert 0.0 < raylets.simulated(stages) < sum(records.read(stage).seconds for stage in stages)
