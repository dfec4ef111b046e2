"""The benchmark harness on sizes that take seconds: reports are right, comparisons notice a difference."""

from __future__ import annotations

import importlib
import json
import math
import os
import signal
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from romnav.robot.gaits import Gait, GaitLibrary
from romnav.sensing.lidar import Lidar
from romnav.sensing.spec import LidarSpec
from romnav.world.solids import SolidsBuilder
from tests.test_stopping import ends

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


@pytest.fixture(scope="module")
def common() -> Iterator[ModuleType]:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(BENCHMARKS)
        yield importlib.import_module("_common")


@pytest.fixture(scope="module")
def training(common: ModuleType) -> ModuleType:
    return importlib.import_module("training")


@pytest.fixture(scope="module")
def learners(training: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    s = training.scale("smoke", envs=12, tiles=2)
    ppo = s.navigation.ppo.model_copy(update={"steps": 6, "minibatches": 2, "epochs": 1})
    s = s.model_copy(update={"navigation": s.navigation.model_copy(update={"ppo": ppo})})
    world = training.load_world(s.world, tmp_path_factory.mktemp("cache"))
    return {name: make(s, world) for name, make in training.MAKERS.items()}


@pytest.mark.parametrize(("larger", "ratio"), [(False, 2.5), (True, 0.4)])
def test_report(common: ModuleType, tmp_path: Path, larger: bool, ratio: float) -> None:
    peers = {"slow": [50.0, 70.0, 60.0], "best": [6.0, 4.0, 5.0]} if not larger else {"best": [5.0], "slow": [0.1]}
    common.report("x", "Work", "s", [1.0, 2.0, 9.0], peers, tmp_path, agree=True, larger_is_better=larger, extra=3)
    record = json.loads((tmp_path / "x.json").read_text())
    assert record["ours"] == 2.0
    assert record["ratio_to_best_peer"] == pytest.approx(ratio)
    assert record["extra"] == 3
    assert {"work", "peers", "unit", "agree", "machine", "commit"} < record.keys()
    table = (tmp_path / "x.md").read_text()
    assert "| romnav | 2 | 1 to 9 |  |" in table
    assert f"| {ratio:.2f} |" in table


def test_works_take_turns_and_warm_up(common: ModuleType) -> None:
    calls: list[str] = []
    now = iter(range(100))
    works = {name: lambda name=name: calls.append(name) for name in "ab"}
    times = common.take_turns(works, 2, lambda: float(next(now)))
    assert calls == ["a", "b"] * 3
    assert times == {"a": [1.0, 1.0], "b": [1.0, 1.0]}


def test_children_are_processes_of_their_own(common: ModuleType) -> None:
    runs = common.in_children(os.getpid, count=2)
    assert os.getpid() not in [pid for pid, _ in runs]
    assert all(peak > 1.0 for _, peak in runs)


def test_peer_learns_the_same_task(training: ModuleType, learners: dict[str, Any]) -> None:
    assert training.agreement(learners)
    for learner in learners.values():
        assert learner.iterate() > 0.0
        assert all(map(math.isfinite, learner.losses.values()))


def test_agreement_notices_other_weights(training: ModuleType, learners: dict[str, Any]) -> None:
    with torch.no_grad():
        learners["stock rsl-rl"].algorithm.actor.mlp[-2].bias += 1.0
    assert not training.agreement(learners)


def test_shares_cover_the_iteration(training: ModuleType, learners: dict[str, Any]) -> None:
    parts = training.shares(learners["romnav"], 1)
    assert sum(parts.values()) == pytest.approx(1.0)
    assert {"LiDAR", "encoder", "update: attention", "update: GRU", "policy inference"} < parts.keys()
    assert min(parts[k] for k in training.SENSING if k != "resets") > 0.0


@given(
    st.lists(st.tuples(st.floats(1, 100), st.sets(st.integers(0, 11), max_size=3)), min_size=1, max_size=12),
    st.integers(1, 5),
)
@settings(max_examples=60, deadline=None)
def test_simulated_stages_keep_order_and_bounds(common: ModuleType, drawn: Any, cores: int) -> None:
    """Without chance, the end lies between the critical path and Graham's bound for list scheduling."""
    cluster = importlib.import_module("cluster")
    stages: list[Any] = []
    for k, (_, above) in enumerate(drawn):
        stages.append(
            SimpleNamespace(name=str(k), upstream=tuple(stages[other] for other in sorted(above) if other < k))
        )
    lasts = {str(k): seconds for k, (seconds, _) in enumerate(drawn)}
    path: dict[str, float] = {}
    for stage in stages:
        path[stage.name] = lasts[stage.name] + max((path[other.name] for other in stage.upstream), default=0.0)
    end, work = cluster.simulate(stages, lasts, cores, 0.0, math.inf, 0)
    assert work == pytest.approx(sum(lasts.values()))
    assert end >= max(max(path.values()), work / cores) - 1e-6
    assert end <= work / cores + (1 - 1 / cores) * max(path.values()) + 1e-6


@pytest.mark.parametrize("kind", ["policy or checkpoint", "world", "episode set", "tracks", "record", "experiment"])
def test_damaged_files_are_told_apart_by_what_readers_make_of_them(
    common: ModuleType, tmp_path: Path, kind: str
) -> None:
    damage = importlib.import_module("_damage")
    found = {damage._try(kind, n, tmp_path) for n in range(8)}
    assert "refused" in found
    assert found <= {"refused", "unharmed", "another"}


@pytest.mark.parametrize("overlap", [-5e-6, 0.05], ids=["ray along an edge", "ray at a face"])
def test_a_lost_solid_is_one_that_no_rounding_explains(common: ModuleType, overlap: float) -> None:
    """A wall, and behind it a pole that one column sees past the wall's edge or does not see."""
    lidar = importlib.import_module("lidar")
    spec = LidarSpec(rows=15, columns=55, field=(-90.0, 90.0))
    slope = math.tan(math.radians(20.0))  # of a column's rays
    boxes = [((2.0, 2.1), (-3.0, 2.0 * slope + overlap)), ((4.0, 4.1), (4.0 * slope - 0.02, 4.0 * slope + 0.02))]

    def cast(bundle: NDArray) -> tuple[NDArray, NDArray]:
        """By slabs, in float64."""
        origin, direction = bundle[..., :3].astype(float), bundle[..., 3:].astype(float)
        hits = []
        for x, y in boxes:
            with np.errstate(divide="ignore"):
                t = (np.array([x, y, (0.0, 3.0)]).T[:, None, None, None] - origin) / direction
            near, far = t.min(0).max(-1), t.max(0).min(-1)
            hits.append(np.where((near <= far) & (far > 0), near, np.inf))
        return np.min(hits, axis=0), np.argmin(hits, axis=0)

    def images(shown: list[Any]) -> tuple[Lidar, NDArray]:
        b = SolidsBuilder()
        for x, y in shown:
            b.box((sum(x) / 2, sum(y) / 2), (x[1] - x[0], y[1] - y[0]), (0.0, 3.0))
        sensor = Lidar([b.build()], spec)
        return sensor, sensor.scan(*poses).numpy()

    poses = lidar.Poses(torch.zeros(1, dtype=torch.int32), torch.tensor([[0.0, 0.0, 1.265]]), torch.zeros(1))
    sensor, ranges = images(boxes)
    assert lidar.lost([cast], poses, sensor.directions, ranges) == (1, 0)
    boxes[0] = boxes[0][0], (-3.0, 2.0 * slope - 0.05)
    assert lidar.lost([cast], poses, sensor.directions, images(boxes)[1]) == (2, 0)
    assert lidar.lost([cast], poses, sensor.directions, images(boxes[:1])[1]) == (2, 1)


def test_the_guarantee_counts_collisions(common: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    guarantee = importlib.import_module("_guarantee")
    monkeypatch.setattr(guarantee, "WORLDS", 8)
    closest, way = guarantee.batch(1, 1)
    assert closest > 0.0
    assert way > 1.0

    class Careless:
        def __init__(self, *told: Any, **more: Any) -> None:
            pass

        def __call__(self, points: torch.Tensor, velocity: torch.Tensor) -> SimpleNamespace:
            return SimpleNamespace(velocity=velocity)

    monkeypatch.setattr(guarantee, "SafetyFilter", Careless)
    assert guarantee.batch(1, 1)[0] < 0.0


@pytest.fixture
def kills(common: ModuleType, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    module = importlib.import_module("_kills")
    monkeypatch.setattr(module, "TRAININGS", {"one": module.Training(("train",), ("policy.pt",))})
    return module


@pytest.mark.parametrize("alone", [True, False])
def test_a_training_is_killed_alone_or_with_what_it_started(
    kills: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, alone: bool
) -> None:
    starts = "import subprocess, sys; child = subprocess.Popen(['sleep', '60']); "
    monkeypatch.setattr(kills, "OFTEN", f"{starts} print(child.pid, file=sys.stderr, flush=True); child.wait()")
    assert kills._run(kills.TRAININGS["one"], tmp_path, "x", 3.0, alone) == -signal.SIGKILL
    child = int(kills._said(tmp_path, "x"))
    assert ends(child, 1.0 if alone else 30.0) != alone
    if alone:
        os.kill(child, signal.SIGKILL)


@pytest.mark.parametrize(
    ("ends", "weights", "counted"),
    [
        ([0, -signal.SIGKILL, 0], "whole", {"same bits": 1}),
        ([0, 0, 0, -signal.SIGKILL, 0], "whole", {"same bits": 1}),
        ([0, -signal.SIGKILL, 0], "other", {"lost": 1}),
        ([0, -signal.SIGKILL, 1], "whole", {"lost": 1}),
        ([0, 1], "whole", {"lost": 1}),
    ],
    ids=["resumed", "ended before it was killed", "other weights", "fails when resumed", "fails by itself"],
)
def test_what_counts_is_a_training_that_was_killed_and_ends_in_the_same_weights(
    kills: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ends: list[int], weights: str, counted: Any
) -> None:
    given = iter(ends)
    after: list[float] = []

    def run(training: Any, project: Path, results: str, seconds: float = math.inf, alone: bool = False) -> int:
        (project / results).mkdir(exist_ok=True)
        (project / f"{results}.log").touch()
        after.append(seconds)
        return next(given)

    monkeypatch.setattr(kills, "_run", run)
    monkeypatch.setattr(
        kills, "_weights", lambda training, project, results: ["whole" if results == "whole" else weights]
    )
    assert kills.kill("one", range(1), tmp_path / "one") == counted
    assert next(given, None) is None
    tries = [seconds for seconds in after if math.isfinite(seconds)]
    assert tries == sorted(tries, reverse=True)
    assert len(set(tries)) == len(tries)


def test_a_gait_library_is_the_same_where_every_frame_is(kills: ModuleType, tmp_path: Path) -> None:
    training = kills.Training(("train", "gaits"), ("gaits.pt",))

    def digests(name: str, slope: float, height: float) -> list[str]:
        frames = {"base": torch.tensor([0.7, height])}
        GaitLibrary([Gait("stair", 1, slope, frames)]).save(tmp_path / name / "tiny" / "gaits.pt")
        found: list[str] = kills._weights(training, tmp_path, name)
        return found

    whole = digests("whole", 0.5, 0.8)
    assert digests("again", 0.5, 0.8) == whole
    assert digests("higher", 0.5, 0.9) != whole
    assert digests("steeper", 0.6, 0.8) != whole


def test_the_humanoid_of_a_training_comes_without_what_it_makes(
    kills: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kills, "OFTEN", "")
    walking = tmp_path / "results/cpu/locomotion"
    walking.mkdir(parents=True)
    for name in ("policy.pt", "gaits.pt", "gaits-record.json"):
        (walking / name).touch()
    monkeypatch.setattr(kills, "ROOT", tmp_path)
    for makes, left in (("", 3), ("gaits*", 1)):
        training = kills.Training(("train", "gaits"), (), walks=True, makes=makes)
        assert kills._run(training, tmp_path, f"without {makes}") == 0
        assert len([*(tmp_path / f"without {makes}" / "tiny" / "locomotion").iterdir()]) == left


@pytest.mark.parametrize("count", [1, 8])
def test_kills_are_shared_among_all_trainings(
    common: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, count: int
) -> None:
    faults = importlib.import_module("faults")
    tried: dict[str, int] = {}

    def kill(kind: str, trials: range, folder: Path) -> Counter[str]:
        tried[kind] = len(trials)
        return Counter(lost=len(trials))

    monkeypatch.setattr(faults._kills, "kill", kill)
    none = ["--warp", "0", "--worlds", "0", "--damages", "0"]
    monkeypatch.setattr("sys.argv", ["faults.py", *none, "--kills", str(count), "--out", str(tmp_path)])
    faults.main()
    assert sum(tried.values()) == count
    assert len(tried) == min(count, len(faults._kills.TRAININGS))


def test_faults_are_counted_over_several_calls(
    common: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    faults = importlib.import_module("faults")
    tried: list[int] = []

    def damage(kind: str, trials: range, folder: Path) -> Counter[str]:
        tried.extend(trials)
        return Counter(refused=len(trials) - 1, another=1)

    monkeypatch.setattr(faults._damage, "damage", damage)
    monkeypatch.setattr(faults._damage, "FILES", {"tracks": faults._damage.FILES["tracks"]})
    monkeypatch.setattr("sys.argv", ["faults.py", "--kills", "0", "--warp", "0", "--worlds", "0", "--damages", "5"])
    monkeypatch.setattr("sys.argv", [*sys.argv, "--out", str(tmp_path)])
    faults.main()
    faults.main()
    assert tried == list(range(10))
    assert "| tracks | 10 | 8 | 0 | 2 | 0 | 0 |" in (tmp_path / "faults.md").read_text()
