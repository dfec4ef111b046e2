"""Encoder: shapes at every resolution, frozen tokens against the network, checkpoints and their errors."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from romnav.errors import RomnavError
from romnav.sensing import encoder as checkpoints
from romnav.sensing.encoder import Autoencoder, Encoder
from romnav.sensing.spec import EncoderSpec

SMALL = EncoderSpec(widths=(8, 16), strides=((2, 4), (2, 2)), latent=4)


def fan(rows: int, columns: int) -> torch.Tensor:
    azimuth, elevation = torch.linspace(1.9, -1.9, columns), torch.linspace(0.07, -0.96, rows)[:, None]
    flat = elevation.cos()
    return torch.stack([flat * azimuth.cos(), flat * azimuth.sin(), elevation.sin().expand(rows, columns)], -1)


def scene(count: int, rows: int, columns: int) -> torch.Tensor:
    ranges = 0.5 + 8 * torch.rand(count, rows, columns, generator=torch.Generator().manual_seed(0))
    return torch.where(ranges < 2, 0, ranges)


@pytest.mark.parametrize(
    ("spec", "image", "tokens", "channels"),
    [
        (EncoderSpec(), (15, 55), 8, 5),
        (EncoderSpec(widths=(16, 32, 64), strides=((2, 2),) * 3), (15, 55), 14, 5),
        (EncoderSpec(strides=((4, 4), (2, 2), (2, 2), (1, 2)), latent=64), (59, 220), 28, 5),
        (EncoderSpec(cartesian=False), (26, 30), 8, 2),
    ],
)
def test_any_resolution_becomes_a_map_of_tokens(
    spec: EncoderSpec, image: tuple[int, int], tokens: int, channels: int
) -> None:
    model = Autoencoder(spec, fan(*image))
    ranges = scene(3, *image)
    assert model.encoder.token_shape == (tokens, spec.latent)
    assert model.encoder.tokens(ranges).shape == (3, tokens, spec.latent)
    assert model.encoder.image(ranges).shape[1] == channels
    mean, _ = model.encoder.posterior(ranges)
    out = model.decoder(mean)
    assert out.range.shape == out.valid.shape == (3, *image)
    assert out.classes.shape == (3, 4, *image)
    assert out.xyz.shape[1] == 3 * spec.cartesian


def test_channels_are_range_point_and_validity() -> None:
    encoder = Encoder(EncoderSpec(scale=2.0), fan(15, 55))
    ranges = scene(2, 15, 55)
    image = encoder.image(ranges)[:, :, :15, :55]
    torch.testing.assert_close(image[:, 0] * 2, ranges)
    torch.testing.assert_close(image[:, 1:4].permute(0, 2, 3, 1) * 2, ranges[..., None] * fan(15, 55))
    assert torch.equal(image[:, 4], (ranges > 0).float())


def test_frozen_tokens_are_the_posterior_means() -> None:
    encoder = Encoder(EncoderSpec(), fan(15, 55))
    ranges = scene(16, 15, 55)
    mean, _ = encoder.posterior(ranges)
    exact = mean.flatten(2).transpose(1, 2)
    assert encoder(ranges).requires_grad
    frozen = encoder.tokens(ranges)
    assert not frozen.requires_grad
    assert torch.equal(frozen, encoder(ranges))
    torch.testing.assert_close(frozen, exact, atol=0.02 * exact.std().item(), rtol=0.02)


def test_tokens_do_not_depend_on_threads_or_neighbours() -> None:
    encoder = Encoder(EncoderSpec(), fan(15, 55))
    ranges = scene(32, 15, 55)
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        one = encoder.tokens(ranges)
        torch.set_num_threads(2)
        two = encoder.tokens(ranges)
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(one, two)
    assert torch.equal(encoder.tokens(ranges.flip(0)).flip(0), one)


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    path = tmp_path / "encoder.pt"
    checkpoints.save(path, Autoencoder(SMALL, fan(8, 16)))
    return path


def test_a_checkpoint_restores_the_encoder(tmp_path: Path) -> None:
    model = Autoencoder(SMALL, fan(8, 16))
    checkpoints.save(tmp_path / "encoder.pt", model)
    encoder = checkpoints.load(tmp_path / "encoder.pt")
    ranges = scene(4, 8, 16)
    assert torch.equal(encoder.tokens(ranges), model.encoder.tokens(ranges))
    assert encoder.digest() == model.encoder.digest()
    assert encoder.digest() != Autoencoder(SMALL, fan(8, 16)).encoder.digest()
    assert not any(p.requires_grad for p in encoder.parameters())


def test_a_missing_checkpoint_is_named(tmp_path: Path) -> None:
    with pytest.raises(RomnavError, match=r"gone\.pt: no such encoder checkpoint; run `romnav train encoder`"):
        checkpoints.load(tmp_path / "gone.pt")


@pytest.mark.parametrize("keep", [0.0, 0.3, 0.9])
def test_a_truncated_checkpoint_is_named(checkpoint: Path, keep: float) -> None:
    data = checkpoint.read_bytes()
    checkpoint.write_bytes(data[: int(keep * len(data))])
    with pytest.raises(RomnavError, match=r"encoder\.pt: damaged"):
        checkpoints.load(checkpoint)


def test_weights_that_are_not_finite_are_refused(checkpoint: Path) -> None:
    content = checkpoints.read(checkpoint)
    content["weights"]["encoder.mean.bias"][0] = torch.nan
    torch.save(content, checkpoint)
    with pytest.raises(RomnavError, match=r"encoder\.pt: encoder\.mean\.bias not finite"):
        checkpoints.load(checkpoint)


def test_another_file_is_refused(checkpoint: Path) -> None:
    torch.save({"weights": {}}, checkpoint)
    with pytest.raises(RomnavError, match="key 'format'"):
        checkpoints.load(checkpoint)


def test_another_architecture_is_refused(checkpoint: Path) -> None:
    with pytest.raises(RomnavError, match=r"encoder\.pt: key 'encoder\.latent' is 4 in the checkpoint but 8"):
        checkpoints.load(checkpoint, SMALL.model_copy(update={"latent": 8}))
    content = torch.load(checkpoint)
    content["spec"] = SMALL.model_copy(update={"latent": 8}).model_dump_json()
    torch.save(content, checkpoint)
    with pytest.raises(RomnavError, match="weights of another architecture"):
        checkpoints.load(checkpoint)
    content["spec"] = SMALL.model_dump_json().replace("latent", "hidden")
    torch.save(content, checkpoint)
    with pytest.raises(RomnavError, match=r"key 'spec\.hidden'"):
        checkpoints.load(checkpoint)
