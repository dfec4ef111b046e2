"""Pretraining: losses against closed forms, learning, poses, exact resume, determinism, held-out quality."""

from __future__ import annotations

import csv
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from romnav.errors import RomnavError
from romnav.sensing import encoder as checkpoints
from romnav.sensing.depth import DepthCamera
from romnav.sensing.encoder import Autoencoder
from romnav.sensing.lidar import Lidar
from romnav.sensing.pretrain import TERMS, Poses, corrupter, divergence, loss_terms, pretrain, quality
from romnav.sensing.spec import (
    UPRIGHT,
    WALKING,
    CorruptionSpec,
    DepthPretrainSpec,
    DepthSpec,
    EncoderSpec,
    LidarSpec,
    PretrainSpec,
)
from romnav.stopping import Stopped
from romnav.world.grids import Grids, rasterise
from romnav.world.solids import Label, SolidsBuilder
from romnav.world.spec import GridSpec
from romnav.world.tile import Tile, TileClass
from tests.test_journal import told

HEIGHT = 1.265
SPEC = PretrainSpec(
    encoder=EncoderSpec(widths=(8, 16, 16), strides=((2, 2), (2, 2), (2, 4)), latent=8),
    images=256,
    epochs=3,
    batch=32,
    seed=1,
)


@pytest.fixture(scope="module")
def tiles() -> list[tuple[Tile, Grids]]:
    """A walled yard with a platform, four steps up to it and a ramp down."""
    b = SolidsBuilder()
    b.box((4, 4), (8, 8), (-0.2, 0.0), label=Label.GROUND, layers=(0, 0))
    for centre, size in (((4, 0), (8, 0.2)), ((4, 8), (8, 0.2)), ((0, 4), (0.2, 8)), ((8, 4), (0.2, 8))):
        b.box(centre, size, (0.0, 2.5))
    b.box((6.6, 4.0), (1.8, 3.0), (0.0, 0.6), label=Label.GROUND, layers=(0, 0))
    for k in range(3):
        b.box((4.85 + 0.3 * k, 3.0), (0.3, 1.4), (0.0, 0.15 * (k + 1)), label=Label.STAIR, layers=(0, 0))
    b.box((6.6, 6.7), (2.4, 1.4), (0.0, 0.3), yaw=-np.pi / 2, slope=0.25, label=Label.RAMP, layers=(0, 0))
    b.cylinder((2.0, 5.0), 0.2, (0.0, 2.0))
    tile = Tile(TileClass.OUTDOOR, 0, 8.0, b.build(), (0.0,), (0,), ())
    return [(tile, rasterise(tile, GridSpec()))]


@pytest.fixture(scope="module")
def lidar(tiles: list[tuple[Tile, Grids]]) -> Lidar:
    return Lidar([tile.solids for tile, _ in tiles], LidarSpec(rows=15, columns=31))


def test_divergence_is_that_of_gaussians() -> None:
    mean, log_variance = torch.randn(2, 5, 3, 2, 4, generator=torch.Generator().manual_seed(0))
    posterior = torch.distributions.Normal(mean, (0.5 * log_variance).exp())
    prior = torch.distributions.Normal(torch.zeros(()), torch.ones(()))
    expected = torch.distributions.kl_divergence(posterior, prior).mean(0)
    torch.testing.assert_close(divergence(mean, log_variance), expected)


def test_loss_is_the_weighted_evidence_bound_with_free_bits() -> None:
    spec = SPEC.model_copy(
        update={
            "encoder": SPEC.encoder.model_copy(update={"bfloat16": False}),
            "class_weights": (1.0, 1.0, 3.0, 2.0),
            "kl_weight": 0.25,
        }
    )
    directions = torch.nn.functional.normalize(torch.randn(6, 8, 3), dim=-1)
    model = Autoencoder(spec.encoder, directions)
    clean = torch.rand(4, 6, 8) * 5
    clean[:, :2] = 0
    labels = torch.where(clean > 0, torch.randint(0, 4, clean.shape), -1).to(torch.int8)
    terms = loss_terms(model, spec, clean, clean, labels, torch.Generator().manual_seed(3))
    assert tuple(terms) == TERMS
    mean, log_variance = model.encoder.posterior(clean)
    noise = torch.randn(mean.shape, generator=torch.Generator().manual_seed(3))
    out = model.decoder(mean + (0.5 * log_variance).exp() * noise)
    metres = torch.distributions.Normal
    valid = clean > 0
    constant = metres(0.0, spec.sigma).log_prob(torch.zeros(()))
    log_range = metres(clean, spec.sigma).log_prob(out.range * spec.encoder.scale) - constant
    torch.testing.assert_close(terms["range"], -log_range[valid].sum() / 4)
    points = clean[..., None] * directions
    log_xyz = metres(points, spec.sigma).log_prob(out.xyz.permute(0, 2, 3, 1) * spec.encoder.scale) - constant
    torch.testing.assert_close(terms["xyz"], -log_xyz[valid].sum() / 4)
    log_valid = torch.distributions.Bernoulli(logits=out.valid).log_prob(valid.float())
    torch.testing.assert_close(terms["valid"], -log_valid.sum() / 4)
    truth = torch.stack([labels == label for label in Label], 1).float()
    log_classes = torch.distributions.Bernoulli(logits=out.classes).log_prob(truth).sum(1)
    weighted = sum(w * log_classes[labels == label].sum() for label, w in zip(Label, (1.0, 1.0, 3.0, 2.0), strict=True))
    torch.testing.assert_close(terms["classes"], -weighted / 4)
    nats = divergence(mean, log_variance)
    assert (nats < spec.free_bits).any()
    torch.testing.assert_close(terms["divergence"], 0.25 * torch.where(nats > 0.5, nats, 0.5).sum())


def test_poses_are_half_near_connectors_and_stand_on_the_surface(tiles: list[tuple[Tile, Grids]]) -> None:
    grids = tiles[0][1]
    poses = Poses([grids], HEIGHT, seed=0)
    index = torch.arange(4000)
    tile, origin, yaw, tilt = poses(index)
    assert (tile == 0).all()
    assert (tilt == 0).all()
    nodes = torch.tensor(grids.position)
    gap = torch.cdist(origin - torch.tensor([0.0, 0.0, HEIGHT]), nodes).min(1).values
    assert gap.max() < 0.16
    stairs = torch.cdist(origin - torch.tensor([0.0, 0.0, HEIGHT]), nodes[torch.tensor(grids.connector)]).min(1).values
    assert stairs[1::2].max() < 2.2
    assert stairs[::2].max() > 3.0
    turned = torch.histc(yaw, 8, 0.0, 2 * torch.pi)
    assert turned.min() > 400
    again = poses(index[100:200])
    assert torch.equal(again[1], origin[100:200])


def test_the_mask_of_the_head_tells_nothing_of_the_pose(tiles: list[tuple[Tile, Grids]]) -> None:
    """Nodes lie row by row, so that the one which is drawn tells of the place."""
    index, box, nothing = torch.arange(4000), (0.3, 0.7, 0.3, 0.7), (0.0, 0.0, 0.0, 0.0)
    poses = Poses([tiles[0][1]], HEIGHT, 3, sway=WALKING)(index)
    drawn = torch.stack([*poses.origin.T, poses.yaw, *poses.tilt.T])
    for boxes in ((box,), (nothing, box), (nothing, nothing, box)):  # four random numbers each
        spec = CorruptionSpec(noise=(0.0, 0.0, 0.0), dropout=(0.0, 0.0), occlusion=boxes, occlusion_jitter=0.1)
        lost = corrupter(spec, 3)(torch.ones(4000, 60, 60), index, index) == 0
        lost[:, :8] = lost[:, :, :8] = False  # what the jitter makes of nothing
        columns, rows = lost.any(1).int(), lost.any(2).int()
        edges = torch.stack([columns.argmax(1), columns.flip(1).argmax(1), rows.argmax(1), rows.flip(1).argmax(1)])
        assert (edges.float().std(1) > 2).all()
        for half in (index % 2 == 0, index % 2 == 1):
            seen = torch.cat([edges, drawn])[:, half].double()
            assert torch.corrcoef(seen)[:4, 4:].abs().max() < 0.1


def test_a_walking_head_is_lower_and_leans(tiles: list[tuple[Tile, Grids]]) -> None:
    index = torch.arange(4000)
    upright, walking = (Poses([tiles[0][1]], HEIGHT, 0, sway=sway)(index) for sway in (UPRIGHT, WALKING))
    for mine, theirs in ((upright.tile, walking.tile), (upright.yaw, walking.yaw)):
        assert torch.equal(mine, theirs)
    sink = upright.origin - walking.origin
    assert (sink[:, :2] == 0).all()
    for drawn, (low, high) in zip(
        (*walking.tilt.T, sink[:, 2]), (WALKING.roll, WALKING.pitch, WALKING.sink), strict=True
    ):
        assert low - 1e-5 <= drawn.min() < low + 0.05 * (high - low)
        assert high + 1e-5 >= drawn.max() > high - 0.05 * (high - low)


def test_a_sensor_that_is_held_upright_has_the_key_of_one_without_sway() -> None:
    assert "sway" not in PretrainSpec().model_dump()
    assert "sway" in DepthPretrainSpec().model_dump()


@pytest.mark.slow
def test_overfits_a_few_images(tiles: list[tuple[Tile, Grids]], lidar: Lidar) -> None:
    spec = SPEC.model_copy(update={"kl_weight": 0.02, "sigma": 0.5})
    index = torch.arange(64)
    clean, labels = Poses([tiles[0][1]], HEIGHT, 0)(index).scan(lidar, labels=True)
    torch.manual_seed(0)
    model = Autoencoder(spec.encoder, lidar.directions)
    optimizer = torch.optim.AdamW(model.parameters(), 6e-3)
    for step in range(200):
        terms = loss_terms(model, spec, clean, clean, labels, torch.Generator().manual_seed(step))
        optimizer.zero_grad()
        sum(terms.values()).backward()
        optimizer.step()
    out = model.decoder(model.encoder.posterior(clean)[0])
    valid = clean > 0
    error = (out.range * spec.encoder.scale - clean)[valid].abs().mean()
    average = clean.sum(0) / valid.sum(0).clamp(min=1)
    assert error < 0.35 * (average - clean)[valid].abs().mean()
    assert (out.classes.argmax(1) == labels)[valid].float().mean() > 0.9
    assert ((out.valid > 0) == valid).float().mean() > 0.97


def weights(path: Path) -> dict[str, torch.Tensor]:
    return checkpoints.read(path)["weights"]


@pytest.fixture(scope="module")
def trained(tiles: list[tuple[Tile, Grids]], lidar: Lidar, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return pretrain(SPEC, tiles, lidar, HEIGHT, tmp_path_factory.mktemp("encoder"))


def test_the_loss_falls_and_is_logged_term_by_term(trained: Path) -> None:
    with (trained.parent / "curve.csv").open() as file:
        rows = [{k: float(v) for k, v in row.items()} for row in csv.DictReader(file)]
    assert rows[-1]["step"] == 24
    assert rows[-1]["loss"] == pytest.approx(sum(rows[-1][t] for t in TERMS), rel=1e-4)
    seen = told(trained.parent)
    for term in TERMS:
        assert seen[f"loss/{term}"] == [(row["step"], pytest.approx(row[term], rel=1e-4)) for row in rows]


class Killed(Exception):
    pass


def test_a_killed_run_resumes_to_the_same_weights(
    trained: Path,
    tiles: list[tuple[Tile, Grids]],
    lidar: Lidar,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("romnav.sensing.pretrain.CHECKPOINT_INTERVAL", 5)
    monkeypatch.setattr("romnav.sensing.pretrain.LOG_INTERVAL", 5)

    def kill(done: int, total: int, metric: str) -> None:
        if done == 13 * SPEC.batch:
            raise Killed

    with pytest.raises(Killed):
        pretrain(SPEC, tiles, lidar, HEIGHT, tmp_path, progress=kill)
    assert not (tmp_path / "encoder.pt").exists()
    seen: list[int] = []
    pretrain(SPEC, tiles, lidar, HEIGHT, tmp_path, progress=lambda done, total, metric: seen.append(done))
    assert seen[0] == 11 * SPEC.batch
    expected, found = weights(trained), weights(tmp_path / "encoder.pt")
    assert all(torch.equal(expected[k], found[k]) for k in expected)


def test_a_signal_saves_first_and_the_run_goes_on_to_the_same_weights_and_curve(
    trained: Path, tiles: list[tuple[Tile, Grids]], lidar: Lidar, tmp_path: Path
) -> None:
    def stop(done: int, total: int, metric: str) -> None:
        if done == 13 * SPEC.batch:
            signal.raise_signal(signal.SIGTERM)

    with pytest.raises(Stopped):
        pretrain(SPEC, tiles, lidar, HEIGHT, tmp_path, progress=stop)
    seen: list[int] = []
    pretrain(SPEC, tiles, lidar, HEIGHT, tmp_path, progress=lambda done, total, metric: seen.append(done))
    assert seen[0] == 14 * SPEC.batch
    expected, found = weights(trained), weights(tmp_path / "encoder.pt")
    assert all(torch.equal(expected[k], found[k]) for k in expected)
    assert (tmp_path / "curve.csv").read_text() == trained.with_name("curve.csv").read_text()


def test_weights_that_are_not_finite_are_not_saved(
    tiles: list[tuple[Tile, Grids]], lidar: Lidar, tmp_path: Path
) -> None:
    """The step that breaks them may be the last: no loss tells."""
    broken = SPEC.model_copy(update={"images": SPEC.batch, "epochs": 1, "learning_rate": 1e38, "weight_decay": 1e38})
    with pytest.raises(RomnavError, match=r"step 1: .*weight.* not finite"):
        pretrain(broken, tiles, lidar, HEIGHT, tmp_path)
    assert not (tmp_path / "encoder.pt").exists()


def test_threads_do_not_change_the_weights_and_a_finished_run_does_nothing(
    trained: Path, tiles: list[tuple[Tile, Grids]], lidar: Lidar, tmp_path: Path
) -> None:
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(1 if threads > 1 else 2)
        path = pretrain(SPEC, tiles, lidar, HEIGHT, tmp_path)
    finally:
        torch.set_num_threads(threads)
    assert checkpoints.load(path).digest() == checkpoints.load(trained).digest()
    before = path.stat().st_mtime_ns
    pretrain(SPEC, tiles, lidar, HEIGHT, tmp_path)
    assert path.stat().st_mtime_ns == before
    other = SPEC.model_copy(update={"seed": 2, "epochs": 1})
    pretrain(other, tiles, lidar, HEIGHT, tmp_path)
    assert checkpoints.load(path).digest() != checkpoints.load(trained).digest()


def test_quality_of_a_known_model(tiles: list[tuple[Tile, Grids]], lidar: Lidar) -> None:
    """A decoder that says 3 m straight through every pixel, all ground, always valid, and one dead dimension."""
    model = Autoencoder(SPEC.encoder, lidar.directions)
    with torch.no_grad():
        model.decoder.heads.weight.zero_()
        model.decoder.heads.bias.copy_(torch.tensor([0.6, 0, 0, 0, 9.0, 9.0, 0, 0, 0]))
        model.encoder.mean.weight.normal_(0, 3.0, generator=torch.Generator().manual_seed(0))
        model.encoder.mean.weight[5] = 0
    found = quality(model, tiles, lidar, HEIGHT, CorruptionSpec(), images=64)
    clean, labels = Poses([tiles[0][1]], HEIGHT, 0)(torch.arange(64)).scan(lidar, labels=True)
    valid = clean > 0
    assert found["depth_mae_m"] == pytest.approx(float((clean[valid] - 3).abs().mean()), abs=1e-3)
    assert found["xyz_error_m"] == pytest.approx(float(clean[valid].mean()), abs=1e-3)
    assert found["iou"]["ground"] == pytest.approx(float((labels == Label.GROUND).sum() / valid.sum()), abs=1e-3)
    assert found["iou"]["stair"] == 0.0
    assert found["valid_iou"] == pytest.approx(float(valid.float().mean()), abs=1e-3)
    cells = model.encoder.map_shape[0] * model.encoder.map_shape[1]
    assert found["dead_dims"] == cells
    assert found["tiles"]["outdoor"]["depth_mae_m"] == found["depth_mae_m"] == found["dropout_50"]["depth_mae_m"]


def test_a_class_of_tiles_that_no_image_is_of_has_no_errors(tiles: list[tuple[Tile, Grids]]) -> None:
    (tile, grids) = tiles[0]
    three = [(replace(tile, kind=kind), grids) for kind in "abc"]
    lidar = Lidar([tile.solids] * 3, LidarSpec(rows=15, columns=31))
    found = quality(Autoencoder(SPEC.encoder, lidar.directions), three, lidar, HEIGHT, CorruptionSpec(), images=2)
    errors = [found["tiles"][kind]["depth_mae_m"] for kind in "abc"]
    assert None in errors
    assert found["depth_mae_m"] == pytest.approx(np.mean([e for e in errors if e is not None]), rel=0.3)


def test_the_depth_camera_learns_by_the_same_code(tiles: list[tuple[Tile, Grids]], tmp_path: Path) -> None:
    camera = DepthCamera([tile.solids for tile, _ in tiles], DepthSpec())
    spec = DepthPretrainSpec(images=128, epochs=1)
    model = checkpoints.load_autoencoder(pretrain(spec, tiles, camera, HEIGHT, tmp_path))
    assert model.encoder.token_shape == (4, 32)
    found = quality(model, tiles, camera, HEIGHT, spec.corruption, images=64)
    assert found["xyz_error_m"] is None
    assert found["depth_mae_m"] < 2.0
