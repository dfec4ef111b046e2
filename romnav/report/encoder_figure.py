"""What an encoder sees: input, reconstruction and segmentation of held-out images."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from romnav.report.pictures import COLOURS
from romnav.sensing.encoder import Autoencoder
from romnav.sensing.pretrain import Poses, Sensor, corrupter
from romnav.sensing.spec import UPRIGHT, CorruptionSpec, SwaySpec
from romnav.world.grids import Grids
from romnav.world.solids import Label
from romnav.world.tile import Tile

TITLES = ("input", "range", "reconstruction", "classes", "segmentation")
NO_RETURN = "#1b1b1b"
CANDIDATES = 512
"""Images among which each row's one is the richest in classes."""


@torch.no_grad()
def draw_encoder(
    model: Autoencoder,
    tiles: Sequence[tuple[Tile, Grids]],
    sensor: Sensor,
    height: float,
    corruption: CorruptionSpec,
    path: Path,
    *,
    sway: SwaySpec = UPRIGHT,
    device: str = "cpu",
) -> None:
    """Draw one image of every tile class with a fifth and with half of its pixels lost; save to ``path``.

    Arguments are those of `romnav.sensing.pretrain.quality`.
    """
    index = torch.arange(CANDIDATES, device=device)
    pose = Poses([grids for _, grids in tiles], height, 1, device, sway)(index)
    clean, labels = pose.scan(sensor, labels=True)
    kinds = np.array([t.kind for t, _ in tiles])[pose.tile.cpu().numpy()]
    rows = [
        (share, _richest(labels, torch.tensor(kinds == kind, device=device)), kind)
        for kind in sorted(set(kinds))
        for share in (0.2, 0.5)
    ]
    ratio = clean.shape[2] / clean.shape[1]
    figure = Figure(figsize=(13.0, 0.5 + len(rows) * (2.6 / ratio + 0.25)), layout="constrained")
    axes = figure.subplots(len(rows), len(TITLES), squeeze=False)
    for (share, k, kind), line in zip(rows, axes, strict=True):
        corrupt = corrupter(corruption.model_copy(update={"dropout": (share, share)}), 1, device)
        seen = corrupt(clean[k : k + 1], index[k : k + 1], index[k : k + 1])
        out = model.decoder(model.encoder.posterior(seen)[0])
        valid = (out.valid > 0).squeeze(0)
        far = float(clean[k].max())
        _draw_range(line[0], seen[0], far)
        _draw_range(line[1], clean[k], far)
        image = _draw_range(line[2], out.range[0] * model.encoder.spec.scale * valid, far)
        _draw_classes(line[3], labels[k])
        _draw_classes(line[4], torch.where(valid, out.classes.argmax(1).squeeze(0), -1))
        figure.colorbar(image, ax=line[2], label="m", shrink=0.9)
        line[0].set_ylabel(f"{kind}\n{share:.0%} lost", fontsize=8)
    for ax, title in zip(axes[0], TITLES, strict=True):
        ax.set_title(title, fontsize=10)
    handles = [Patch(color=COLOURS[label], label=label.name.lower()) for label in Label]
    handles.append(Patch(color=NO_RETURN, label="no return"))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)
    figure.savefig(path, dpi=130)


def _richest(labels: torch.Tensor, of_kind: torch.Tensor) -> int:
    """The image of a kind in which most classes have many pixels, so that there is something to judge."""
    shares = torch.stack([(labels == label).flatten(1).sum(1) for label in Label], 1).float()
    score = torch.minimum(shares, shares.new_full((), 60.0)).sum(1) - 1e6 * ~of_kind
    return int(score.argmax())


def _draw_range(ax: Axes, ranges: torch.Tensor, far: float):  # type: ignore[no-untyped-def]
    masked = np.ma.masked_less_equal(ranges.cpu().numpy(), 0.0)
    ax.set_facecolor(NO_RETURN)
    _bare(ax)
    return ax.imshow(masked, cmap="viridis_r", vmin=0.0, vmax=far, interpolation="nearest")


def _draw_classes(ax: Axes, classes: torch.Tensor) -> None:
    colours = ListedColormap([NO_RETURN, *(COLOURS[label] for label in Label)])
    image: NDArray = classes.cpu().numpy() + 1
    ax.imshow(image, cmap=colours, vmin=-0.5, vmax=len(Label) + 0.5, interpolation="nearest")
    _bare(ax)


def _bare(ax: Axes) -> None:
    ax.set_xticks([])
    ax.set_yticks([])
