"""Variational autoencoder of range images; its latent map is the token sequence of the policy's attention."""

from __future__ import annotations

import hashlib
import math
from pathlib import Path
from typing import Any, NamedTuple

import torch
from pydantic import ValidationError
from torch import Tensor, nn

from romnav.errors import RomnavError
from romnav.precision import product_dtype, reduced_precision
from romnav.sensing.spec import EncoderSpec
from romnav.tensors import Kind, require_finite
from romnav.world.solids import Label

LOGIT = 10.0
"""Size of a logit that is 1 before scaling: lets the masks learn at the pace of the lengths."""
AGAIN = "run `romnav train encoder`"
KIND = Kind("romnav-encoder-1", "encoder checkpoint", AGAIN)
read = KIND.load


class Encoder(nn.Module):
    """Convolutions from range images to a Gaussian latent map (paper, "Pretraining Vision Encoders").

    The first stage merges disjoint patches, the others are 3 x 3 convolutions with stride; images are padded
    at the bottom and right to a multiple of the total stride.

    Args:
        spec: Network.
        directions: (rows, columns, 3) direction of each pixel: its point is ``range * direction``.
    """

    directions: Tensor

    def __init__(self, spec: EncoderSpec, directions: Tensor) -> None:
        super().__init__()
        self.spec = spec
        self.register_buffer("directions", directions.float().cpu().clone(), persistent=False)
        rows, columns = self.image_shape = (directions.shape[0], directions.shape[1])
        row_stride, column_stride = (math.prod(s[i] for s in spec.strides) for i in (0, 1))
        self.map_shape = (math.ceil(rows / row_stride), math.ceil(columns / column_stride))
        self._padded = (self.map_shape[0] * row_stride, self.map_shape[1] * column_stride)
        layers: list[nn.Module] = []
        before = self.channels
        for k, (width, stride) in enumerate(zip(spec.widths, spec.strides, strict=True)):
            kernel, padding = (stride, 0) if k == 0 else (3, 1)
            layers += [nn.Conv2d(before, width, kernel, stride, padding), nn.LeakyReLU(0.1)]
            before = width
        self.trunk = nn.Sequential(*layers)
        self.mean = nn.Conv2d(before, spec.latent, 1)
        self.log_variance = nn.Conv2d(before, spec.latent, 1)

    @property
    def channels(self) -> int:
        """Input channels: range, x, y, z, validity; or range and validity."""
        return 5 if self.spec.cartesian else 2

    @property
    def token_shape(self) -> tuple[int, int]:
        """(tokens, channels) of `tokens`."""
        return math.prod(self.map_shape), self.spec.latent

    def image(self, ranges: Tensor, dtype: torch.dtype = torch.float32) -> Tensor:
        """(B, channels, padded rows, padded columns) input for ``ranges`` (B, rows, columns) in m."""
        rows, columns = self.image_shape
        image = ranges.new_zeros(len(ranges), self.channels, *self._padded, dtype=dtype)
        inner = image[:, :, :rows, :columns]
        inner[:, 0] = ranges * (1.0 / self.spec.scale)
        if self.spec.cartesian:
            torch.mul(inner[:, :1], self.directions.permute(2, 0, 1).to(dtype), out=inner[:, 1:4])
        inner[:, -1] = ranges > 0
        return image

    def posterior(self, ranges: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log variance, each (B, latent, map rows, map columns)."""
        features = self.trunk(self.image(ranges))
        return self.mean(features), self.log_variance(features)

    def forward(self, ranges: Tensor) -> Tensor:
        """(B, tokens, channels) float32 posterior means of ``ranges`` (B, rows, columns) in m, with gradients.

        Computed in bfloat16 if the spec says so and the processor can.
        """
        image = self.image(ranges, product_dtype(ranges.device) if self.spec.bfloat16 else torch.float32)
        with reduced_precision(ranges.device, self.spec.bfloat16):
            return self.mean(self.trunk(image)).flatten(2).transpose(1, 2).float()

    @torch.no_grad()
    def tokens(self, ranges: Tensor) -> Tensor:
        """The same without gradients."""
        return self(ranges)

    def digest(self) -> str:
        """Fingerprint of architecture and weights, by which a policy names its encoder."""
        h = hashlib.sha256(self.spec.model_dump_json().encode())
        for tensor in (self.directions, *self.state_dict().values()):
            h.update(tensor.detach().cpu().contiguous().numpy().tobytes())
        return h.hexdigest()[:16]


class Reconstruction(NamedTuple):
    """Output of the heads; all in units of the image (lengths over ``spec.scale``) or logits."""

    range: Tensor
    """(B, rows, columns)."""
    xyz: Tensor
    """(B, 3 or 0, rows, columns)."""
    valid: Tensor
    """(B, rows, columns) logit of a return."""
    classes: Tensor
    """(B, 4, rows, columns) one logit per `Label`."""


class Decoder(nn.Module):
    """Deconvolutions from the latent map to the heads, mirroring the encoder's stages.

    Each pixel has a learned offset, the image that is seen on average.
    """

    def __init__(self, encoder: Encoder) -> None:
        super().__init__()
        spec = encoder.spec
        self._outputs = (1, 3 * spec.cartesian, 1, len(Label))
        before = spec.widths[-1]
        layers: list[nn.Module] = [nn.Conv2d(spec.latent, before, 3, 1, 1), nn.ELU()]
        for width, stride in zip(spec.widths[-2::-1], spec.strides[:0:-1], strict=True):
            layers += [nn.ConvTranspose2d(before, width, stride, stride), nn.ELU()]
            layers += [nn.Conv2d(width, width, 3, 1, 1), nn.ELU()]
            before = width
        self.trunk = nn.Sequential(*layers)
        self.heads = nn.ConvTranspose2d(before, sum(self._outputs), spec.strides[0], spec.strides[0])
        self.offset = nn.Parameter(torch.zeros(sum(self._outputs), *encoder.image_shape))

    def forward(self, latent: Tensor) -> Reconstruction:
        """Reconstruction from a latent map (B, latent, map rows, map columns)."""
        _, rows, columns = self.offset.shape
        outputs = self.heads(self.trunk(latent))[:, :, :rows, :columns].float() + self.offset
        ranges, xyz, valid, classes = outputs.split(self._outputs, 1)
        return Reconstruction(ranges.squeeze(1), xyz, LOGIT * valid.squeeze(1), LOGIT * classes)


class Autoencoder(nn.Module):
    """Encoder and decoder."""

    def __init__(self, spec: EncoderSpec, directions: Tensor) -> None:
        super().__init__()
        self.encoder = Encoder(spec, directions)
        self.decoder = Decoder(self.encoder)
        for trunk in (self.encoder.trunk, self.decoder.trunk):
            for layer in trunk:
                if isinstance(layer, nn.Conv2d | nn.ConvTranspose2d):
                    nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    @torch.no_grad()
    def segment(self, ranges: Tensor) -> Tensor:
        """(B, rows, columns) int8 `Label` that the decoder reads from the code of ``ranges`` (B, rows, columns), m."""
        return self.decoder(self.encoder.posterior(ranges)[0]).classes.argmax(dim=1).to(torch.int8)


def untrained(spec: EncoderSpec, directions: Tensor, seed: int) -> Autoencoder:
    """Encoder and decoder with the random weights of ``seed``."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return Autoencoder(spec, directions)


def save(path: Path, model: Autoencoder, extra: dict[str, Any] | None = None) -> None:
    """Write a checkpoint in one step; ``extra`` is whatever its writer needs to go on."""
    content = {
        "spec": model.encoder.spec.model_dump_json(),
        "directions": model.encoder.directions,
        "weights": model.state_dict(),
        **(extra or {}),
    }
    KIND.save(path, content)


def load_autoencoder(path: Path, device: str = "cpu") -> Autoencoder:
    """Encoder and decoder of a checkpoint, in evaluation mode.

    Raises:
        RomnavError: As `read`, or the weights do not fit the architecture.
    """
    content = read(path)
    try:
        spec = EncoderSpec.model_validate_json(content["spec"])
        model = Autoencoder(spec, content["directions"])
        model.load_state_dict(content["weights"])
    except KeyError as error:
        raise RomnavError(f"{path}: key {error} is missing; {AGAIN}") from error
    except ValidationError as error:
        key = ".".join(map(str, error.errors()[0]["loc"]))
        raise RomnavError(f"{path}: key 'spec.{key}' is of another version; {AGAIN}") from error
    except RuntimeError as error:
        reason = str(error).splitlines()[-1].strip()
        raise RomnavError(f"{path}: weights of another architecture ({reason}); {AGAIN}") from error
    require_finite(path, content["weights"], AGAIN)
    return model.to(device).eval()


def load(path: Path, spec: EncoderSpec | None = None, device: str = "cpu") -> Encoder:
    """Encoder of a checkpoint, frozen.

    Raises:
        RomnavError: As `load_autoencoder`, or the checkpoint is of another architecture than ``spec``.
    """
    encoder = load_autoencoder(path, device).encoder
    mine, theirs = spec.model_dump() if spec else {}, encoder.spec.model_dump()
    for key in (k for k in mine if mine[k] != theirs[k]):
        raise RomnavError(
            f"{path}: key 'encoder.{key}' is {theirs[key]} in the checkpoint but {mine[key]} in the spec; "
            f"change the spec or {AGAIN}"
        )
    return encoder.requires_grad_(False)
