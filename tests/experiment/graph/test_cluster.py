"""Stages on a Ray cluster of two machines, which are processes of this one."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from romnav.errors import RomnavError
from romnav.experiment.graph import records
from romnav.experiment.graph.cluster import execute_on_ray
from romnav.experiment.graph.run import pending
from romnav.experiment.graph.stage import Session, Stage
from romnav.progress import Progress
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
def test_the_first_failure_names_its_reason(tmp_path: Path, cluster: Any) -> None:
    good, bad = stage(tmp_path, "a", Settings(), make=count), stage(tmp_path, "b", Settings(), make=fail)
    with pytest.raises(RomnavError, match="this stage cannot"):
        execute_on_ray("ray", NEEDS, [good, bad], Session(), print)
    assert not records.finished(good)
