"""Pretraining of an encoder on images from random poses (paper, "Pretraining Vision Encoders")."""

from __future__ import annotations

import functools
import hashlib
import math
import operator
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn import functional

from romnav import files, random, stopping
from romnav.errors import RomnavError
from romnav.journal import Journal
from romnav.precision import reduced_precision
from romnav.progress import Progress
from romnav.sensing import encoder as checkpoints
from romnav.sensing.corruption import Corruption
from romnav.sensing.encoder import Autoencoder
from romnav.sensing.spec import UPRIGHT, CorruptionSpec, PretrainSpec, SwaySpec
from romnav.tensors import not_finite
from romnav.threads import torch_threads
from romnav.world.grids import Grids
from romnav.world.solids import Label
from romnav.world.tile import Tile

NEAR = 2.0
"""Nodes this near to a stair or ramp are oversampled, m (A: both mouths and the approach to them)."""
WARM_UP = 25
"""Gradient steps over which the learning rate rises."""
LOG_INTERVAL = 25
"""Gradient steps between two rows of the curve."""
CHECKPOINT_INTERVAL = 500
"""Gradient steps between two states for resumption."""
DEAD_VARIANCE = 0.01
"""A latent dimension whose posterior mean varies less over images is dead (Burda et al. 2016)."""
TERMS = ("range", "xyz", "valid", "classes", "divergence")


class Sensor(Protocol):
    """A range sensor over the tiles to be learned from: `romnav.sensing.lidar.Lidar` is one."""

    directions: Tensor

    @property
    def scan(self) -> Callable[..., Any]:
        """(tile, origin, yaw, labels=..., tilt=...) -> ranges, or ranges and labels."""


class Pose(NamedTuple):
    """Where a sensor is in B images: tile (B,), origin (B, 3), yaw (B,), and roll and pitch (B, 2) of the torso."""

    tile: Tensor
    origin: Tensor
    yaw: Tensor
    tilt: Tensor

    def scan(self, sensor: Sensor, *, labels: bool = False) -> Any:
        """What the sensor sees there: ranges (B, rows, columns), with ``labels`` those, too."""
        return sensor.scan(self.tile, self.origin, self.yaw, labels=labels, tilt=self.tilt)


def corrupter(spec: CorruptionSpec, seed: int, device: str = "cpu") -> Corruption:
    """What corrupts images at the `Poses` of a seed: by numbers of its own, so that it tells nothing of a pose."""
    return Corruption(spec, seed + 2_000_003, device)


class Poses:
    """Random poses of a sensor, half anywhere, half on or near stairs and ramps; a function of their index.

    Args:
        grids: Grids of each tile.
        height: Sensor above the walking surface, m, of a robot that stands.
        seed: Seed of the poses.
        device: Torch device.
        sway: How the head is held.
    """

    def __init__(
        self, grids: Sequence[Grids], height: float, seed: int, device: str = "cpu", sway: SwaySpec = UPRIGHT
    ) -> None:
        self._seed, self._height, self._sway, self._cell = seed, height, sway, grids[0].cell
        self._node = torch.tensor(np.concatenate([g.position for g in grids]), device=device)
        tile = np.repeat(np.arange(len(grids)), [len(g.position) for g in grids])
        self._tile = torch.tensor(tile, dtype=torch.int32, device=device)
        near = np.concatenate([_near_connector(g) for g in grids])
        self._near = torch.tensor(np.flatnonzero(near if near.any() else ~near), device=device)

    def __call__(self, index: Tensor) -> Pose:
        """Poses of the images ``index`` (B,); odd ones are oversampled."""
        draw = [random.uniform(self._seed, index, k) for k in range(4)]
        anywhere = random.integers(len(self._node), self._seed, index, 4)
        near = self._near[random.integers(len(self._near), self._seed, index, 5)]
        node = torch.where(index % 2 == 1, near, anywhere)
        jitter = torch.stack([self._cell * (draw[0] - 0.5), self._cell * (draw[1] - 0.5), 0.1 * (draw[2] - 0.5)], 1)
        origin = self._node[node] + jitter
        ranges = (self._sway.roll, self._sway.pitch, self._sway.sink)
        roll, pitch, sink = (
            low + (high - low) * random.uniform(self._seed, index, 6 + k) for k, (low, high) in enumerate(ranges)
        )
        origin[:, 2] += self._height - sink
        return Pose(self._tile[node], origin, 2 * math.pi * draw[3], torch.stack([roll, pitch], dim=1))


def _near_connector(grids: Grids) -> np.ndarray:
    if not grids.connector.any():
        return grids.connector
    distance, _ = cKDTree(grids.position[grids.connector]).query(grids.position, distance_upper_bound=NEAR)
    return distance <= NEAR


def divergence(mean: Tensor, log_variance: Tensor) -> Tensor:
    """KL divergence from the standard normal of each latent dimension, averaged over the batch, nat."""
    return 0.5 * (mean.square() + log_variance.exp() - 1.0 - log_variance).mean(0)


def loss_terms(
    model: Autoencoder,
    spec: PretrainSpec,
    seen: Tensor,
    clean: Tensor,
    labels: Tensor,
    generator: torch.Generator,
) -> dict[str, Tensor]:
    """Terms of the loss per image, nat (`TERMS`): the negative evidence lower bound, but for the spec's weights.

    Squared errors of range and points where there is a return, cross-entropies of the validity everywhere and
    of each class where there is a return, weighted by the true class; all of the clean image, given the corrupted
    one that was ``seen`` (both (B, rows, columns)). ``labels`` (B, rows, columns) are `Label`, -1 without a return.
    """
    scale = spec.encoder.scale
    with reduced_precision(clean.device, spec.encoder.bfloat16):
        mean, log_variance = (x.float() for x in model.encoder.posterior(seen))
        noise = torch.randn(mean.shape, generator=generator, device=mean.device)
        out = model.decoder(mean + (0.5 * log_variance).exp() * noise)
    valid = (clean > 0).float()
    count, precision = len(clean), 0.5 * (scale / spec.sigma) ** 2
    target = clean / scale
    points = model.encoder.directions.permute(2, 0, 1) * target[:, None]
    one_hot = functional.one_hot(labels.long().clamp(min=0), len(Label)).permute(0, 3, 1, 2).float()
    classes = functional.binary_cross_entropy_with_logits(out.classes.float(), one_hot, reduction="none")
    weight = valid * clean.new_tensor(spec.class_weights)[labels.long().clamp(min=0)]
    xyz = (out.xyz - points[:, : out.xyz.shape[1]]).square().sum(1)
    return {
        "range": precision * (valid * (out.range - target).square()).sum() / count,
        "xyz": precision * (valid * xyz).sum() / count,
        "valid": functional.binary_cross_entropy_with_logits(out.valid.float(), valid, reduction="sum") / count,
        "classes": (weight * classes.sum(1)).sum() / count,
        "divergence": spec.kl_weight * divergence(mean, log_variance).clamp(min=spec.free_bits).sum(),
    }


def pretrain(
    spec: PretrainSpec,
    tiles: Sequence[tuple[Tile, Grids]],
    sensor: Sensor,
    height: float,
    out: Path,
    *,
    device: str = "cpu",
    progress: Progress = lambda done, total, metric: None,
    resume: bool = True,
) -> Path:
    """Train an encoder on images of ``tiles`` and write ``encoder.pt`` and ``curve.csv`` into ``out``, the latter as
    TensorBoard's events, too.

    Images are rendered as they are needed: each is a function of the seed and its index. A run that was killed
    goes on from ``state.pt`` and ends with the same weights as one that was not; a finished one does nothing.

    Args:
        spec: Network, corruption and optimisation.
        tiles: The tiles of ``sensor``, in its order.
        sensor: What makes the images.
        height: Sensor above the walking surface, m.
        out: Folder of the results.
        device: Torch device of the training and of the sensor.
        progress: Told (images done, images in all, loss).
        resume: Whether to go on from an earlier run of the same spec.

    Returns:
        Path of the checkpoint.

    Raises:
        RomnavError: What an earlier run left is damaged; a term of the loss is not finite; ``out`` cannot be written.
    """
    path, state_path = out / "encoder.pt", out / "state.pt"
    poses = Poses([grids for _, grids in tiles], height, spec.seed, device, spec.sway)
    key = _key(spec, sensor, poses)
    if resume and path.exists() and checkpoints.read(path).get("key") == key:
        return path
    state = _Training(spec, sensor, poses, key, device)
    if resume and state_path.exists():
        state.restore(state_path)
    journal = Journal(out, state.step)
    # batches are small: a second thread gains nothing, and another number of threads gives other bits
    with torch_threads(1), stopping.deferred() as stop:
        while state.step < state.steps:
            text = state.advance()
            if row := state.row():
                journal.add(state.step, row)
            done = min(state.step * spec.batch, spec.images * spec.epochs)
            progress(done, spec.images * spec.epochs, text)
            if stop or (state.step % CHECKPOINT_INTERVAL == 0 and state.step < state.steps):
                journal.flush()
                state.save(state_path)
            stop.obey()
    journal.close()
    files.write(out / "curve.csv", state.curve())
    state.check()
    checkpoints.save(path, state.model, {"key": key})
    return path


class _Training:
    """A training run: everything that changes from one gradient step to the next."""

    def __init__(self, spec: PretrainSpec, sensor: Sensor, poses: Poses, key: str, device: str) -> None:
        self._spec, self._sensor, self._poses, self._key, self._device = spec, sensor, poses, key, device
        self.model = checkpoints.untrained(spec.encoder, sensor.directions, spec.seed).to(device)
        self._parameters = list(self.model.parameters())
        self._optimizer = torch.optim.AdamW(
            self._parameters, spec.learning_rate, weight_decay=spec.weight_decay, foreach=True
        )
        self._corrupt = corrupter(spec.corruption, spec.seed, device)
        self._per_epoch = max(spec.images // spec.batch, 1)
        self.steps = self._per_epoch * spec.epochs
        self.step = 0
        self._rows: list[list[float]] = []
        self._recent = torch.zeros(len(TERMS), dtype=torch.float64)

    def advance(self) -> str:
        """One gradient step; returns what to show of it."""
        spec = self._spec
        rate = spec.learning_rate * min(1.0, (self.step + 1) / WARM_UP, 4.0 * (1.0 - self.step / self.steps))
        for group in self._optimizer.param_groups:
            group["lr"] = rate
        terms = self._terms()
        wrong = [name for name, value in zip(TERMS, terms.tolist(), strict=True) if not math.isfinite(value)]
        if wrong:
            raise RomnavError(
                f"pretraining: step {self.step + 1}: {', '.join(wrong)} of the loss is not finite; what is saved is "
                "of a step before. Lower learning_rate"
            )
        self._optimizer.zero_grad()
        terms.sum().backward()
        torch.nn.utils.clip_grad_norm_(self._parameters, spec.max_grad_norm)
        self._optimizer.step()
        terms = terms.detach().double().cpu()
        self._recent += terms
        self.step += 1
        if self.step % LOG_INTERVAL == 0 or self.step == self.steps:
            mean = self._recent / ((self.step - 1) % LOG_INTERVAL + 1)
            self._rows.append([self.step, rate, float(mean.sum()), *mean.tolist()])
            self._recent.zero_()
        return f"loss {terms.sum():.1f} nat"

    def row(self) -> dict[str, float] | None:
        """The row of the curve that the last step ended, if it did."""
        if not self._rows or self._rows[-1][0] != self.step:
            return None
        _, rate, loss, *terms = self._rows[-1]
        named = {f"loss_{name}": value for name, value in zip(TERMS, terms, strict=True)}
        return {"learning_rate": rate, "loss_total": loss, **named}

    def _terms(self) -> Tensor:
        """(terms,) of the loss of the next batch, in the order of `TERMS`."""
        spec = self._spec
        epoch, position = divmod(self.step, self._per_epoch)
        index = torch.arange(position * spec.batch, (position + 1) * spec.batch, device=self._device)
        clean, labels = self._poses(index).scan(self._sensor, labels=True)
        seen = self._corrupt(clean, index, torch.full_like(index, epoch))
        generator = torch.Generator(self._device).manual_seed(int(random.bits(spec.seed, self.step)))
        terms = loss_terms(self.model, spec, seen, clean, labels, generator)
        return torch.stack([terms[name] for name in TERMS])

    def check(self) -> None:
        """Stop before weights that are not finite are saved."""
        if wrong := not_finite(self.model.state_dict()):
            raise RomnavError(
                f"pretraining: step {self.step}: {', '.join(wrong[:3])} not finite; what is saved is of a step before. "
                "Lower learning_rate"
            )

    def save(self, path: Path) -> None:
        self.check()
        extra = {
            "key": self._key,
            "step": self.step,
            "rows": self._rows,
            "recent": self._recent,
            "optimizer": self._optimizer.state_dict(),
        }
        checkpoints.save(path, self.model, extra)

    def restore(self, path: Path) -> None:
        """Go on from a state of the same spec; one of another spec will be replaced."""
        content = checkpoints.read(path)
        if content.get("key") != self._key:
            return
        self.model.load_state_dict(content["weights"])
        self._optimizer.load_state_dict(content["optimizer"])
        self.step, self._rows, self._recent = content["step"], content["rows"], content["recent"]

    def curve(self) -> str:
        names = ("step", "learning_rate", "loss", *TERMS)
        return files.csv_text([dict(zip(names, row, strict=True)) for row in self._rows])


def _key(spec: PretrainSpec, sensor: Sensor, poses: Poses) -> str:
    """Fingerprint of everything that decides the weights."""
    digest = hashlib.sha256(spec.model_dump_json().encode())
    probe = torch.arange(256, device=sensor.directions.device)
    for tensor in (sensor.directions, poses(probe).scan(sensor)):
        digest.update(tensor.cpu().numpy().tobytes())
    return digest.hexdigest()[:16]


@torch.no_grad()
def quality(
    model: Autoencoder,
    tiles: Sequence[tuple[Tile, Grids]],
    sensor: Sensor,
    height: float,
    corruption: CorruptionSpec,
    *,
    sway: SwaySpec = UPRIGHT,
    images: int = 4096,
    seed: int = 0,
    device: str = "cpu",
) -> dict[str, Any]:
    """Errors of every head on ``tiles`` that the model was not trained on.

    Poses are sampled as in training. ``corruption`` applies without pixel dropout, and again with half of the
    pixels lost (``dropout_50``).

    Returns:
        ``images``, ``iou`` by class, ``depth_mae_m``, ``depth_rmse_m``, ``xyz_error_m`` (mean distance),
        ``valid_iou``, ``dead_dims``, ``latent_dims``, ``divergence_nat``; the errors by tile class in ``tiles``,
        and all of it in ``dropout_50``. An error is None where nothing was there to be seen.
    """
    poses = Poses([grids for _, grids in tiles], height, seed, device, sway)
    kinds = np.array([tile.kind for tile, _ in tiles])
    result: dict[str, Any] = {"images": images}
    for share in (0.0, 0.5):
        corrupt = corrupter(corruption.model_copy(update={"dropout": (share, share)}), seed, device)
        sums, means, nats = {str(kind): _Errors(model.encoder.spec.cartesian) for kind in sorted(set(kinds))}, [], []
        for index in torch.arange(images, device=device).split(256):
            pose = poses(index)
            clean, labels = pose.scan(sensor, labels=True)
            mean, log_variance = model.encoder.posterior(corrupt(clean, index, torch.zeros_like(index)))
            out = model.decoder(mean)
            means.append(mean.flatten(1))
            nats.append(divergence(mean, log_variance).sum())
            of_tile = kinds[pose.tile.cpu().numpy()]
            for kind, errors in sums.items():
                which = torch.tensor(of_tile == kind, device=device)
                errors.add(model, clean[which], labels[which], checkpoints.Reconstruction(*(x[which] for x in out)))
        spread = torch.cat(means).var(0)
        part = {
            **functools.reduce(operator.add, sums.values()).summary(),
            "dead_dims": int((spread < DEAD_VARIANCE).sum()),
            "latent_dims": len(spread),
            "divergence_nat": round(float(torch.stack(nats).mean()), 2),
            "tiles": {kind: errors.summary() for kind, errors in sums.items()},
        }
        result.update(part if share == 0.0 else {"dropout_50": part})
    return result


class _Errors:
    """Sums from which the errors of a set of images follow."""

    def __init__(self, cartesian: bool) -> None:
        self.cartesian = cartesian
        self.geometry = torch.zeros(4, dtype=torch.float64)
        self.overlap = torch.zeros(2, len(Label) + 1, dtype=torch.int64)

    def __add__(self, other: _Errors) -> _Errors:
        both = _Errors(self.cartesian)
        both.geometry = self.geometry + other.geometry
        both.overlap = self.overlap + other.overlap
        return both

    def add(self, model: Autoencoder, clean: Tensor, labels: Tensor, out: checkpoints.Reconstruction) -> None:
        scale, valid = model.encoder.spec.scale, clean > 0
        error = (out.range * scale - clean)[valid].double()
        points = model.encoder.directions.permute(2, 0, 1) * clean[:, None]
        xyz = (out.xyz * scale - points[:, : out.xyz.shape[1]]).norm(dim=1)[valid].double()
        sums = [error.abs().sum(), error.square().sum(), xyz.sum(), valid.sum()]
        self.geometry += torch.stack([s.double() for s in sums]).cpu()
        guess, truth = out.classes.argmax(1)[valid], labels[valid].long()
        masks = [(guess == k, truth == k) for k in range(len(Label))] + [(out.valid > 0, valid)]
        for k, (a, b) in enumerate(masks):
            self.overlap[0, k] += int((a & b).sum())
            self.overlap[1, k] += int((a | b).sum())

    def summary(self) -> dict[str, Any]:
        absolute, squared, xyz, count = (float(x) for x in self.geometry)
        iou = [round(float(i / u), 4) if u else None for i, u in self.overlap.T]
        return {
            "iou": {label.name.lower(): value for label, value in zip(Label, iou, strict=False)},
            "valid_iou": iou[-1],
            "depth_mae_m": round(absolute / count, 4) if count else None,
            "depth_rmse_m": round(math.sqrt(squared / count), 4) if count else None,
            "xyz_error_m": round(xyz / count, 4) if self.cartesian and count else None,
        }
