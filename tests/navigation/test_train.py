from __future__ import annotations

import csv
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
import torch

from romnav.errors import RomnavError
from romnav.navigation import checkpoint, train
from romnav.navigation.rewards import TERMS
from romnav.navigation.spec import NavigationSpec, RewardSpec
from romnav.world.world import World

from .conftest import TOKENS


def weights(folder: Path) -> dict[str, torch.Tensor]:
    return checkpoint.read(folder / "policy.pt")["actor"]


def assert_same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> None:
    assert a.keys() == b.keys()
    for key in a:
        assert torch.equal(a[key], b[key]), key


def test_same_spec_same_weights(world: World, perception: object, spec: NavigationSpec, tmp_path: Path) -> None:
    for name in "ab":
        train.train(spec, world, perception, tmp_path / name, 1)
    assert_same(weights(tmp_path / "a"), weights(tmp_path / "b"))
    other = train.train(spec, world, perception, tmp_path / "c", 2)
    assert not torch.equal(
        checkpoint.read(other)["actor"]["attention.place"], weights(tmp_path / "a")["attention.place"]
    )


def test_the_machines_threads_do_not_matter(
    world: World, perception: object, spec: NavigationSpec, tmp_path: Path
) -> None:
    before = torch.get_num_threads()
    wide = spec.model_copy(update={"env": spec.env.model_copy(update={"envs": 96})})
    try:
        for count in (1, 2):
            torch.set_num_threads(count)
            train.train(wide, world, perception, tmp_path / str(count), 1)
            assert torch.get_num_threads() == count
    finally:
        torch.set_num_threads(before)
    assert_same(weights(tmp_path / "1"), weights(tmp_path / "2"))


def test_killed_and_resumed_equals_left_alone(
    world: World, perception: object, spec: NavigationSpec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A child process is killed with SIGKILL in the middle of the run; resuming gives the same weights and curve."""
    monkeypatch.setattr(train, "SAVE_EVERY", 0.0)
    train.train(spec, world, perception, tmp_path / "whole", 1)
    script = textwrap.dedent(
        f"""
        import os, signal, sys
        from pathlib import Path
        sys.path.insert(0, {str(Path(__file__).parents[2])!r})
        from tests.navigation.conftest import FakePerception
        from romnav.navigation import train
        from romnav.navigation.spec import NavigationSpec
        from romnav.world.spec import WorldSpec
        from romnav.world.world import build
        train.SAVE_EVERY = 0.0
        def progress(done, total, metric):
            if done == 3 * total // 4:
                os.kill(os.getpid(), signal.SIGKILL)
        spec = NavigationSpec.model_validate_json({spec.model_dump_json()!r})
        world = build(WorldSpec.model_validate_json({world.spec.model_dump_json()!r}))
        train.train(spec, world, FakePerception(), Path({str(tmp_path / "killed")!r}), 1, progress=progress)
        """
    )
    killed = subprocess.run([sys.executable, "-c", script])
    assert killed.returncode == -signal.SIGKILL
    assert not (tmp_path / "killed" / "policy.pt").exists()
    assert checkpoint.read(tmp_path / "killed" / "checkpoint.pt")["iterations"] == 2
    train.train(spec, world, perception, tmp_path / "killed", 1)
    assert_same(weights(tmp_path / "whole"), weights(tmp_path / "killed"))
    assert not (tmp_path / "killed" / "checkpoint.pt").exists()
    curves = [
        [{**row, "seconds": ""} for row in csv.DictReader((tmp_path / name / "curve.csv").open())]
        for name in ("whole", "killed")
    ]
    assert curves[0] == curves[1]
    assert len(curves[0]) == spec.ppo.iterations


def test_learning_rate_stays_in_bounds(world: World, perception: object, spec: NavigationSpec, tmp_path: Path) -> None:
    low, high = spec.ppo.learning_rate_range
    tight = spec.model_copy(update={"ppo": spec.ppo.model_copy(update={"desired_kl": 1e-9, "iterations": 6})})
    train.train(tight, world, perception, tmp_path, 1)
    rates = [float(row["learning_rate"]) for row in csv.DictReader((tmp_path / "curve.csv").open())]
    assert rates[-1] == low
    assert all(low <= rate <= high for rate in rates)


def test_learning_raises_the_return(world: World, perception: object, spec: NavigationSpec, tmp_path: Path) -> None:
    """Paid for steady commands alone, the policy becomes steady: the sign of every gradient is right."""
    terms = {name: 0.0 for name in RewardSpec.model_fields if name in TERMS}
    reward = RewardSpec(**(terms | {"action_rate": (-1.0, -1.0)}))
    learner = spec.model_copy(
        update={
            "env": spec.env.model_copy(update={"envs": 48, "reward": reward}),
            "ppo": spec.ppo.model_copy(update={"iterations": 10, "steps": 12, "epochs": 4, "gamma": 0.9}),
        }
    )
    train.train(learner, world, perception, tmp_path, 1)
    rows = list(csv.DictReader((tmp_path / "curve.csv").open()))
    assert float(rows[-1]["reward_action_rate"]) > 0.7 * float(rows[0]["reward_action_rate"])


def test_checkpoint_of_another_run_is_refused(
    world: World, perception: object, spec: NavigationSpec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(train, "SAVE_EVERY", 0.0)

    class Stop(Exception):
        pass

    def stop(done: int, total: int, metric: str) -> None:
        if done == total // 2:
            raise Stop

    with pytest.raises(Stop):
        train.train(spec, world, perception, tmp_path, 1, progress=stop)
    with pytest.raises(RomnavError, match=r"checkpoint\.pt: belongs to a run with another seed; delete it"):
        train.train(spec, world, perception, tmp_path, 2)
    train.train(spec, world, perception, tmp_path, 2, resume=False)


def test_policy_errors_name_file_and_fix(
    world: World, perception: object, spec: NavigationSpec, tmp_path: Path
) -> None:
    path = train.train(spec, world, perception, tmp_path, 1)
    assert checkpoint.load_actor(path, TOKENS, "fake")
    with pytest.raises(RomnavError, match="key 'encoder' is fake, but the encoder at hand is other"):
        checkpoint.load_actor(path, TOKENS, "other")
    with pytest.raises(RomnavError, match=r"policy\.pt: a policy of another architecture .*attention\.place"):
        checkpoint.load_actor(path, (TOKENS[0] + 1, TOKENS[1]), "fake")
    with pytest.raises(RomnavError, match=r"none\.pt: no such policy; train it"):
        checkpoint.read(tmp_path / "none.pt")
    content = path.read_bytes()
    for cut in (0, 10, len(content) // 2, len(content) - 1):
        torn = tmp_path / "torn.pt"
        torn.write_bytes(content[:cut])
        with pytest.raises(RomnavError, match=r"torn\.pt: truncated or no checkpoint"):
            checkpoint.read(torn)
    torch.save({"weights": 1}, tmp_path / "foreign.pt")
    with pytest.raises(RomnavError, match="key 'format' is not"):
        checkpoint.read(tmp_path / "foreign.pt")
