"""Training one part."""

from __future__ import annotations

import importlib
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest
import torch

from romnav.navigation import checkpoint
from tests.cli.conftest import ROOT, edit, fails, romnav


def test_several_processes_train_policies_alone(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WORLD_SIZE", "2")
    assert fails("run", "ablation", "spawn-goal").endswith("train a policy alone; start this without torchrun")
    assert "start them by torchrun" in fails("train", "policy", "rom")


WITNESS = """
import os
import torch
from romnav.cli import app
from romnav.navigation import train

def make(*words):
    made.append(make_ppo(*words))
    return made[-1]

made, make_ppo, train.make_ppo = [], train.make_ppo, make
try:
    app()
finally:
    torch.save({"actor": made[0].actor.state_dict(), "critic": made[0].critic.state_dict()}, os.environ["RANK"])
"""
"""The command line, of which every process writes what it has learned into a file called by its rank."""


@pytest.mark.slow
def test_torchrun_trains_what_one_process_would_and_makes_one_record(
    project: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Actions are drawn by each process, so the weights are not those of one; starts and ends of episodes are."""
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    (project / "experiments" / "scales" / "tiny.toml").write_text(importlib.import_module("_kills").TINY)
    (project / "witness.py").write_text(WITNESS)

    def torchrun(processes: int, *program: str) -> subprocess.CompletedProcess[str]:
        launcher = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(processes)]
        command = [*launcher, *program, "train", "policy", "rom", "--scale", "tiny"]
        return subprocess.run(command, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": str(ROOT)})

    refused = torchrun(3, "-m", "romnav.cli")
    assert refused.returncode == 1
    assert "error: navigation.env.envs: 16 in 2 minibatches (ppo.minibatches) cannot be shared by 3" in refused.stderr
    done = torchrun(2, "witness.py")
    assert done.returncode == 0, done.stderr
    assert "encoder lidar" not in done.stderr
    made = project / "results" / "tiny"
    record = json.loads((made / "rom" / "seed-0" / "spec.json").read_text())
    assert record["facts"]["processes"] == 2
    assert torchrun(2, "-m", "romnav.cli").stderr.count("nothing to do") == 1
    assert "nothing to do" in romnav("train", "policy", "rom", "--scale", "tiny").stderr

    policy, second = checkpoint.read(made / "rom" / "seed-0" / "policy.pt"), torch.load("1")
    for owner in ("actor", "critic"):
        assert policy[owner].keys() == second[owner].keys()
        for name, value in policy[owner].items():
            assert value.isfinite().all()
            assert torch.equal(value, second[owner][name]), name

    shutil.copytree(made / "encoder", project / "alone" / "tiny" / "encoder")
    assert romnav("train", "policy", "rom", "--scale", "tiny", "--results", "alone").exit_code == 0
    both, alone = (pd.read_csv(results / "rom" / "seed-0" / "curve.csv") for results in (made, Path("alone", "tiny")))
    assert record["facts"]["steps"] == alone.steps.iloc[-1] == 5120
    pd.testing.assert_frame_equal(both[["iteration", "steps", "episodes"]], alone[["iteration", "steps", "episodes"]])
    assert both.reward_height[0] == pytest.approx(alone.reward_height[0], rel=1e-3)


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
