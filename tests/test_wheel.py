"""What an installed romnav can do without a copy of the repository."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from romnav.errors import RomnavError
from romnav.experiment import template
from romnav.experiment.graph.run import pending
from romnav.experiment.kinds.encoder import encoder
from romnav.experiment.project import Project
from romnav.experiment.workspace import Workspace
from tests.cli.conftest import fails, romnav

ROOT = Path(__file__).parents[1]
EXPERIMENT = """
kind = "ablation"
title = "Is a wide view worth it?"

[arms.wide]
label = "Wide"

[arms.narrow]
label = "Narrow"
lidar.azimuth = 120.0

[tables.views]
columns = ["sr_120", "spl", "collisions"]
bounds = ["straight"]

[tables.views-differences]
kind = "contrasts"
columns = ["sr_120_same", "soft_spl"]
"""
SCALE = """
[world]
tiles = 2
side = 20.0
goals_per_tile = 8
[lidar]
rows = 15
columns = 55
[pretrain]
images = 64
epochs = 1
[navigation.env]
envs = 16
duration = 8.0
[navigation.ppo]
iterations = 2
steps = 8
epochs = 1
minibatches = 2
[evaluation]
episodes = "few"
duration = 20.0
"""


def test_a_new_project_has_all_that_a_first_run_needs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "new" / "project"
    assert romnav("init", str(folder)).exit_code == 0
    made = Project(folder, folder / "results")
    assert made.experiments.keys() == Project(ROOT, ROOT / "results").experiments.keys()
    assert {path.name for path in (folder / "experiments" / "episodes").iterdir()} >= {"dev.json", "paired-2.json"}
    monkeypatch.chdir(folder)
    assert "rom" in romnav("results").stdout
    assert not pending([encoder(Workspace(made, "smoke"), "lidar")])
    assert romnav("run", "ablation", "spawn-goal", "--print").stdout.count("\n") == 1, "only tables are to be drawn"
    assert not [*folder.rglob("checkpoint.pt")]
    assert fails("init", str(folder)).endswith("experiments: exists; name another folder")
    assert "change to a copy of the romnav repository" in fails("bench")


def test_a_place_that_cannot_be_written_is_one_clear_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(RomnavError, match="cannot be written"):
        template.init(tmp_path / "file" / "project")


@pytest.mark.slow
def test_an_ablation_with_a_table_of_its_own_from_the_wheel_alone(tmp_path: Path) -> None:
    """The wheel is built and installed beside this environment's packages; its table takes no Python."""
    run = {"check": True, "cwd": tmp_path}
    subprocess.run([sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "-w", tmp_path, ROOT], **run)
    subprocess.run([sys.executable, "-m", "venv", tmp_path / "venv"], **run)
    site = next((tmp_path / "venv").glob("lib/python*/site-packages"))
    (site / "beside.pth").write_text(next(path for path in sys.path if path.endswith("site-packages")))
    wheel = next(tmp_path.glob("romnav-*.whl"))
    subprocess.run([tmp_path / "venv" / "bin" / "pip", "install", "--quiet", "--no-deps", wheel], **run)

    def romnav(*words: str, folder: Path) -> str:
        environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
        command = [tmp_path / "venv" / "bin" / "romnav", *words]
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return done.stdout

    started = os.times()
    romnav("init", "mine", folder=tmp_path)
    project = tmp_path / "mine"
    template.init(tmp_path / "checkout")
    carried, here = ({p.relative_to(f) for p in f.rglob("*")} for f in (project, tmp_path / "checkout"))
    assert carried == here
    (project / "experiments" / "views.toml").write_text(EXPERIMENT)
    (project / "experiments" / "scales" / "tiny.toml").write_text(SCALE)
    romnav("episodes", "few", "--tiles", "3", "--count", "16", folder=project)
    printed = romnav("run", "ablation", "views", "--scale", "tiny", folder=project)
    assert "| Wide" in printed
    assert "Contact (per 100 m)" in printed
    assert "| Wide − Narrow" in printed
    assert "commit v0.1.0" in printed
    assert romnav("eval", "--paired", "--scale", "tiny", folder=project).count("wide - narrow") == 6
    for name in ("views", "views-differences"):
        assert (project / "results" / "tiny" / "tables" / f"{name}.tex").exists()
    romnav("report", "--scale", "tiny", folder=project)
    ended = os.times()  # of processors, as the machine may have other work
    assert ended.children_user + ended.children_system - started.children_user - started.children_system < 300
