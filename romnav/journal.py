"""A learning curve while it grows, for TensorBoard; and for Weights & Biases where its project is named."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from romnav.errors import RomnavError

PROJECT = "WANDB_PROJECT"
"""Variable of the environment by which W&B is asked for; its other ones hold, too."""
GROUPS = ("reward", "loss")
SUCCESS = {"success": "success/all", "same": "success/same", "cross": "success/cross"}
EVENTS = "events.out.tfevents.*"


class Journal:
    """Writes rows of ``curve.csv`` as TensorBoard's events beside it, by steps: of environments, or of the gradient.

    Args:
        folder: Of the run.
        steps: Steps that are done: what an interrupted session wrote beyond them is passed over.

    Raises:
        RomnavError: W&B is asked for, but not installed.
    """

    def __init__(self, folder: Path, steps: int) -> None:
        if steps == 0:
            for events in folder.glob(EVENTS):
                events.unlink()
        self._writer: Any
        if project := os.environ.get(PROJECT):
            self._writer = _weights_and_biases(folder, project)
        else:
            from torch.utils.tensorboard import SummaryWriter

            self._writer = SummaryWriter(str(folder), purge_step=steps + 1)

    def add(self, steps: int, row: Mapping[str, float]) -> None:
        """A row; what is not a number in it, as success before an episode ended, is left out."""
        for name, value in row.items():
            if name != "steps" and math.isfinite(value):
                self._writer.add_scalar(_tag(name), value, steps)

    def flush(self) -> None:
        """Bring all rows so far to the disk."""
        self._writer.flush()

    def close(self) -> None:
        """Nothing follows."""
        self._writer.close()
        if hasattr(self._writer, "stop"):
            self._writer.stop()


def _tag(name: str) -> str:
    group, _, rest = name.partition("_")
    if group in GROUPS and rest:
        return f"{group}/{rest}"
    if "/" in name:
        return name
    return SUCCESS.get(name) or f"run/{name}"


def _weights_and_biases(folder: Path, project: str) -> Any:
    from rsl_rl.utils import wandb_log_writer

    if wandb_log_writer.wandb is None:
        raise RomnavError(f"{PROJECT} is set, but wandb is not installed; `pip install 'romnav[wandb]'`, or unset it")
    writer = wandb_log_writer.WandbLogWriter(str(folder), project)
    wandb_log_writer.wandb.run.name = "/".join(folder.parts[-3:])  # scale, arm and seed
    return writer
