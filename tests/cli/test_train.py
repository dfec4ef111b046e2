"""Training one part."""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.cli.conftest import ROOT, edit, fails, romnav


def test_several_processes_train_policies_alone(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WORLD_SIZE", "2")
    assert fails("run", "ablation", "spawn-goal").endswith("train a policy alone; start this without torchrun")
    assert "start them by torchrun" in fails("train", "policy", "rom")


@pytest.mark.slow
def test_torchrun_makes_what_is_upstream_once_and_one_record(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    (project / "experiments" / "scales" / "tiny.toml").write_text(importlib.import_module("_kills").TINY)

    def torchrun(processes: int) -> subprocess.CompletedProcess[str]:
        launcher = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(processes)]
        command = [*launcher, "-m", "romnav.cli", "train", "policy", "rom", "--scale", "tiny"]
        return subprocess.run(command, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": str(ROOT)})

    refused = torchrun(3)
    assert refused.returncode == 1
    assert "error: navigation.env.envs: 16 in 2 minibatches (ppo.minibatches) cannot be shared by 3" in refused.stderr
    done = torchrun(2)
    assert done.returncode == 0, done.stderr
    assert "encoder lidar" not in done.stderr
    record = json.loads((project / "results" / "tiny" / "rom" / "seed-0" / "spec.json").read_text())
    assert record["facts"]["processes"] == 2
    assert record["facts"]["steps"] == 5120
    assert torchrun(2).stderr.count("nothing to do") == 1
    assert "nothing to do" in romnav("train", "policy", "rom", "--scale", "tiny").stderr


@pytest.mark.slow
def test_locomotion_is_trained_continued_and_recorded(project: Path) -> None:
    edit(project / "experiments" / "scales" / "smoke.toml", "iterations = 60", "iterations = 1")
    edit(project / "experiments" / "scales" / "smoke.toml", "robots = 128", "robots = 16")
    assert romnav("train", "locomotion").exit_code == 0
    assert "nothing to do" in romnav("train", "locomotion").stderr
    record = json.loads((project / "results" / "smoke" / "locomotion" / "policy.json").read_text())
    assert record["facts"]["iterations"] == 1
    edit(project / "experiments" / "scales" / "smoke.toml", "iterations = 1 ", "iterations = 2 ")
    assert romnav("train", "locomotion").exit_code == 0
    curve = (project / "results" / "smoke" / "locomotion" / "curve.csv").read_text().splitlines()
    assert len(curve) == 3
    assert romnav("play", "locomotion").exit_code == 0
    assert (project / "results" / "smoke" / "figures" / "locomotion-stairs-low.png").stat().st_size > 1000
    edit(project / "experiments" / "scales" / "smoke.toml", "robots = 16", "robots = 32")
    refused = romnav("train", "locomotion")
    assert refused.exit_code == 1
    assert "trained by another specification; use another directory or --no-resume" in refused.stderr
