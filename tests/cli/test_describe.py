"""Describing terrain."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from romnav.experiment import describe
from romnav.experiment.scales import ScaleFile
from romnav.navigation.env import NavigationEnv
from romnav.navigation.ppo import make_ppo
from romnav.robot.rom import ReducedOrderModel
from romnav.sensing.encoder import Autoencoder
from romnav.sensing.lidar import Lidar
from romnav.world.build import build
from tests.cli.conftest import ROOT, edit, fails, romnav
from tests.navigation.conftest import FakePerception


@pytest.fixture
def small(project: Path) -> Path:
    """A project with a scale of the user's own: three small tiles."""
    text = (ROOT / "experiments" / "scales" / "smoke.toml").read_text()
    world = '[world]\ntiles = 3\nside = 22.0\nclasses = ["building", "room", "room"]\n'
    (project / "experiments" / "scales" / "mine.toml").write_text(text.replace("[world]\n", world, 1))
    edit(project / "experiments" / "scales" / "mine.toml", "goals_per_tile = 64", "goals_per_tile = 8")
    return project


def test_a_world_is_described_for_every_sampler_of_an_experiment(small: Path) -> None:
    result = romnav("describe", "world", "--scale", "mine", "--json")
    assert result.exit_code == 0, result.output
    told = json.loads(result.stdout)
    assert list(told["samplers"]) == ["rom", "uniform", "nocap", "uniform-nocap"]
    for shares in told["samplers"].values():
        names = "mean_geodesic cross_share storey_share two_storey_share beyond_30 beyond_45 on_connector"
        assert list(shares) == names.split()
        assert all(0.0 <= v <= 1.0 for k, v in shares.items() if k != "mean_geodesic")
    assert told["samplers"]["rom"]["beyond_30"] == 0.0
    assert told["tiles"] == {"building": 1, "room": 2}
    assert told["oracle_t2g"] > 1.0
    assert 0.0 <= told["straight_sr_120_same"] <= 100.0
    assert told["build_s"] > 0.0 < told["memory_mb"]
    picture = small / "results" / "mine" / "figures" / "describe-spawn-goal.png"
    assert picture.read_bytes().startswith(b"\x89PNG")

    again = romnav("describe", "world", "--scale", "mine", "--experiment", "pretrain", "--out", "here.png")
    assert again.exit_code == 0, again.output
    assert "1 building, 2 room" in again.stdout
    assert "frozen" in again.stdout
    assert "scratch" not in again.stdout  # the same sampler as the first arm's
    assert (small / "here.png").exists()


def test_a_picture_that_cannot_be_written_is_refused_before_anything_is_built(
    small: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (small / "file").touch()
    monkeypatch.setattr(describe, "build", None)
    message = fails("describe", "world", "--scale", "mine", "--out", "file/here.png")
    assert message.startswith("file/here.png: cannot be written (file exists)")
    assert fails("describe", "world", "--scale", "mine", "--experiment", "../x").startswith("unknown experiment ../x")
    assert not (small / "results").exists()


def test_a_bad_world_is_one_line_before_anything_is_built(small: Path) -> None:
    scale = small / "experiments" / "scales" / "mine.toml"
    edit(scale, "side = 22.0", "side = nan")
    assert "mine.toml: key world.side: " in fails("describe", "world", "--scale", "mine")
    edit(scale, "side = nan", "side = 22.1")
    assert "whole number" in fails("describe", "world", "--scale", "mine")
    assert "unknown experiment" in fails("describe", "world", "--experiment", "nothing")


@pytest.mark.parametrize("terrain", ["world.seed", "navigation.tiles"])
def test_arms_on_other_terrain_have_no_one_world(small: Path, terrain: str) -> None:
    file = small / "experiments" / "spawn-goal.toml"
    edit(file, "[arms.nocap]", f"[arms.nocap]\n{terrain} = 4")
    assert "arms.nocap has another terrain" in fails("describe", "world", "--scale", "mine")


def test_memory_of_a_scale_is_that_of_the_run(small: Path) -> None:
    """A rollout as training fills it, with other robots than those that the description makes."""
    told = json.loads(romnav("describe", "scale", "mine", "--json").stdout)
    assert "512 robots x 32 steps, 3 tiles" in romnav("describe", "scale", "mine").stdout
    settings = ScaleFile(small / "experiments" / "scales", "mine").settings
    spec, tokens = settings.navigation, settings.pretrain.encoder
    world = build(settings.world)
    assert told["world"] == pytest.approx(sum(v.nbytes for v in vars(world).values() if hasattr(v, "nbytes")) / 1e6)
    env = NavigationEnv(world, ReducedOrderModel(world, 512, 0.2), FakePerception(), spec.env, 0, "cpu")
    obs = env.get_observations()
    lidar = Lidar([tile.solids for tile in world.tiles], settings.lidar)
    encoder = Autoencoder(tokens, lidar.directions).encoder
    seen = encoder(torch.zeros(1, settings.lidar.rows, settings.lidar.columns)).to(torch.bfloat16)
    obs["lidar"] = seen.expand(512, *seen.shape[1:]).contiguous()
    ppo = make_ppo(obs, spec.policy, spec.ppo, 512, "cpu")
    ppo.train_mode()
    with torch.inference_mode():
        ppo.act(obs)
        ppo.process_env_step(obs, torch.zeros(512), torch.zeros(512), {})
    stored = vars(ppo.storage)
    tensors = [value for value in stored.values() if isinstance(value, torch.Tensor)]
    tensors += [*ppo.storage.observations.values(), *ppo.storage.distribution_params]
    kept = {tensor.data_ptr(): tensor.nbytes for tensor in tensors}
    assert told["rollout"] == pytest.approx(sum(kept.values()) / 1e6, rel=0.05)
