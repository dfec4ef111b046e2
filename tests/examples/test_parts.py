"""The examples of parts from outside do what they say."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.sparse.csgraph import connected_components

from romnav.errors import RomnavError
from romnav.evaluation import episodes
from romnav.evaluation.paired import rows
from romnav.evaluation.paired.run import run
from romnav.evaluation.paired.statistics import Bootstrap
from romnav.evaluation.rollout import Oracle, Straight
from romnav.evaluation.spec import EpisodeSetSpec, EvaluationSpec
from romnav.experiment.kinds import episodes as kinds
from romnav.experiment.kinds import reports
from romnav.experiment.kinds.locomotion import body
from romnav.experiment.kinds.policy import policy
from romnav.experiment.project import Project
from romnav.experiment.spec import DRIVERS
from romnav.experiment.workspace import Workspace
from romnav.navigation import checkpoint
from romnav.navigation.env import NavigationEnv
from romnav.navigation.train import train
from romnav.report.paired.tables import build as build_table
from romnav.report.spec import PAIRED
from romnav.world.build import build
from romnav.world.spec import SamplerSpec, WorldSpec
from romnav.world.tiles.generate import generate
from tests.examples.conftest import ROOT, SCALE
from tests.navigation.conftest import FakePerception

MAZE = "examples.maze:Maze"


def test_every_arm_says_in_its_key_what_code_it_runs(work: Workspace) -> None:
    named = {
        "maze": "world",
        "no-progress": "navigation",
        "without-attention": "navigation",
        "unicycle": "navigation",
    }
    for arm, section in named.items():
        stage = policy(work, arm, 0)
        assert "@" in str(stage.spec[section])
        assert "examples." in str(stage.spec[section])
    driven = kinds.episodes(work, "wall-follower", 0)
    assert driven.upstream == ()
    assert driven.spec["code"][-1].startswith("examples.wall_follower:WallFollower@")
    assert "@" in kinds.episodes(work, "unicycle", 0).upstream[-1].spec["navigation"]["dynamics"]


def test_a_maze_is_perfect(work: Workspace) -> None:
    """All of its cells are connected; and by one way only, so that a wall more would cut it."""
    spec = WorldSpec(classes=(MAZE,), tiles=1, side=20.0)
    tile, grids = generate(spec, 0)
    assert tile.kind == MAZE
    assert tile.draws == 1
    cells = 8
    middles = (np.arange(cells) + 0.5) * 2.5
    at = (middles / grids.cell).astype(int)
    free = grids.node[0] >= 0
    assert free[np.ix_(at, at)].all()
    across = [(i, j, i + 1, j) for i in range(cells - 1) for j in range(cells)]
    across += [(i, j, i, j + 1) for i in range(cells) for j in range(cells - 1)]
    links = np.zeros((cells**2, cells**2))
    for i, j, k, m in across:
        between = (at[i] + at[k]) // 2, (at[j] + at[m]) // 2
        links[i * cells + j, k * cells + m] = free[between]
    assert links.sum() == cells**2 - 1
    assert connected_components(links, directed=False)[0] == 1


def test_steps_without_progress_cost_their_weight(work: Workspace) -> None:
    plain, settings = work.settings.navigation.env, work.arm_settings("no-progress").navigation.env
    world = build(work.settings.world)
    total = []
    for spec in (plain, settings):
        env = NavigationEnv(
            world, body(work, work.settings, 0, "cpu", 1)(world, 8, 0.2), FakePerception(), spec, 0, "cpu"
        )
        action = torch.zeros(8, 3) + torch.tensor([-1 / 3, 0.0, 1.0])  # turns on the spot
        total.append(sum(env.step(action)[1] for _ in range(3)))
        reward = env.statistics().reward
    torch.testing.assert_close(total[1] - total[0], torch.full((8,), -0.05 * 0.2 * 3))
    assert reward["examples.no_progress:no_progress"] == pytest.approx(-0.01)


def test_a_policy_without_attention_is_trained_and_loaded(work: Workspace, tmp_path: Path) -> None:
    spec = work.arm_settings("without-attention").navigation
    perception = FakePerception()
    path = train(spec, build(work.settings.world), perception, tmp_path, 0)
    actor = checkpoint.load_actor(path, perception.encoder)
    assert type(actor).__name__ == "WithoutAttention"
    assert not any("qkv" in name for name in actor.state_dict())


def test_a_unicycle_takes_no_sidesteps(work: Workspace) -> None:
    settings, world = work.arm_settings("unicycle"), build(work.settings.world)
    robots = body(work, settings, 0, "cpu", 1)(world, 4, 0.2)
    free = torch.from_numpy(np.flatnonzero(world.layer[: world.node_start[1]] == 0))[:4]
    robots.position[:, :2] = world.position[free, :2]
    before = robots.position.clone()
    robots.step(torch.tensor([[0.0, 0.25, 0.0]]).repeat(4, 1))
    assert torch.equal(robots.position[:, :2], before[:, :2])
    robots.step(torch.tensor([[0.0, 0.0, 1.0]]).repeat(4, 1))
    assert robots.yaw[0].item() == pytest.approx(0.2)


def test_following_walls_lies_between_the_other_bounds(work: Workspace) -> None:
    """In rooms: better than straight ahead, worse than one who knows the map."""
    spec = EpisodeSetSpec(
        world=WorldSpec(classes=("room",), tiles=4, seed=9, goals_per_tile=16, side=20.0),
        episodes=96,
        cross=0,
        sampler=SamplerSpec(stair_probability=0.0, min_distance=6.0),
    )
    world = build(spec.world)
    paired = episodes.draw("rooms", spec, world)
    env, evaluation = work.settings.navigation.env, EvaluationSpec(duration=60.0)
    drivers = [Straight(), DRIVERS.load("examples.wall_follower:WallFollower"), Oracle()]
    reached = [(run(d, world, paired, env, evaluation)["outcome"] == "success").mean() for d in drivers]
    assert reached[0] + 0.05 < reached[1] < reached[2]


@pytest.mark.parametrize(
    ("arm", "key", "message"),
    [
        ("without-attention", "navigation.policy.network", "policy network examples.maze:Maze: lacks the base class"),
        ("unicycle", "navigation.dynamics", "body examples.maze:Maze: lacks proprioception, see"),
    ],
)
def test_a_part_of_another_kind_is_one_clear_line(
    work: Workspace, tmp_path: Path, arm: str, key: str, message: str
) -> None:
    shutil.copytree(work.project.root, tmp_path, dirs_exist_ok=True)
    file = tmp_path / "experiments" / "parts.toml"
    name = {"without-attention": "without_attention:WithoutAttention", "unicycle": "unicycle:Unicycle"}[arm]
    file.write_text(file.read_text().replace(f"examples.{name}", MAZE))
    broken = Workspace(Project(tmp_path, tmp_path / "results"), "smoke")
    with pytest.raises(RomnavError, match=f"parts.toml: arms.{arm}.{key}: {message}"):
        broken.arm_settings(arm)


def test_a_table_shows_the_detours_of_successes(work: Workspace, episode_rows: Any) -> None:
    """Ratios of sums, with intervals, over all episodes and over those across levels."""
    experiment = work.project.experiment("parts")
    (stage,) = [s for s in reports(work, "parts", [0]) if s.kind == "tables"]
    assert "examples.detour:Detour@" in stage.spec["tables"]["parts"]["columns"][1]["metric"]
    runs = [episode_rows(arm, skill) for arm, skill in {"maze": 0.5, "unicycle": 0.8}.items()]
    spec = experiment.declared("parts", PAIRED).tables["parts"]
    bootstrap = Bootstrap(rows.pair(runs), resamples=50, outside=["examples.detour:Detour"])
    table = build_table("parts", spec, "Parts", bootstrap)
    shown = {row.label: row.cells for block in table.blocks for row in block.rows}
    assert "Detour: metres walked by successful robots" in table.caption
    for evaluated, label in zip(runs, ("Half of the tiles mazes", "No sidesteps"), strict=True):
        c = evaluated.columns
        for k, level in ((1, np.ones(len(evaluated), bool)), (2, c["level"] == "cross")):
            reached = (c["outcome"] == "success") & level
            expected = c["path_length"][reached].sum() / c["geodesic"][reached].sum()
            cell = shown[label][k]
            assert cell.value == pytest.approx(expected)
            assert cell.facts["lo"] < expected < cell.facts["hi"]


@pytest.mark.slow
def test_one_command_makes_their_table(tmp_path: Path) -> None:
    """Every arm with its part, trained, evaluated and tabulated in processes of their own."""
    shutil.copytree(ROOT / "examples", tmp_path / "examples")
    (tmp_path / "experiments" / "scales").mkdir(parents=True)
    (tmp_path / "experiments" / "scales" / "smoke.toml").write_text(
        SCALE + "[lidar]\nrows = 15\ncolumns = 55\n[pretrain]\nimages = 256\nepochs = 1\n"
        '[evaluation]\nepisodes = "tiny"\nduration = 45.0\n'
    )
    shutil.copy(ROOT / "examples" / "parts.toml", tmp_path / "experiments")
    for words in (["episodes", "tiny", "--tiles", "2", "--count", "32"], ["run", "ablation", "parts"]):
        command = [sys.executable, "-m", "romnav.cli", *words]
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr[-2000:]
    table = (tmp_path / "results" / "smoke" / "tables" / "parts.md").read_text()
    labels = Project(tmp_path, tmp_path / "results").experiment("parts").labels.values()
    for word in ("Detour, cross", *labels):
        assert word in table
