"""Tensors and plain data in one file: PyTorch's format, read in a way that never runs what a file contains."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from romnav import files
from romnav.errors import RomnavError


@dataclass(frozen=True)
class Kind:
    """What a file is, and what its reader is told where it is not.

    Files hold tensors, numbers, text, and lists and dictionaries of those.
    """

    format: str
    """Written into the file and looked for in it."""
    noun: str
    """What such a file is called."""
    again: str
    """How to make another one, as the end of a sentence."""

    def save(self, path: Path, content: Mapping[str, Any]) -> None:
        """Writes a file in one step.

        Raises:
            RomnavError: It cannot be written.
        """
        buffer = io.BytesIO()
        torch.save({"format": self.format, **content}, buffer)
        files.write(path, buffer.getvalue())

    def load(self, path: Path, device: str = "cpu") -> dict[str, Any]:
        """Reads what `save` wrote, with the tensors on ``device``.

        Raises:
            RomnavError: The file is missing, damaged, of another kind, or holds more than tensors and plain data.
        """
        try:
            _check_sums(path)
            content = torch.load(path, map_location=device, weights_only=True)
        except FileNotFoundError:
            raise RomnavError(f"{path}: no such {self.noun}; {self.again}") from None
        except Exception as error:
            # a damaged file can make the reader fail in any way; the restricted one runs nothing on it
            raise RomnavError(f"{path}: damaged, or no {self.noun}; delete it and {self.again}") from error
        if not isinstance(content, dict) or content.get("format") != self.format:
            raise RomnavError(f"{path}: key 'format' is not {self.format!r}; delete it and {self.again}")
        return content


def not_finite(weights: Mapping[str, Tensor]) -> list[str]:
    """Names of the weights that hold NaN or infinity."""
    return [name for name, value in weights.items() if not bool(value.isfinite().all())]


def require_finite(path: Path, weights: Mapping[str, Tensor], again: str) -> None:
    """Checks weights that were read from a file.

    Raises:
        RomnavError: Some are not finite.
    """
    if wrong := not_finite(weights):
        raise RomnavError(f"{path}: {', '.join(wrong[:3])} not finite, of a run that went wrong; {again}")


def _check_sums(path: Path) -> None:
    """Compares the parts of the archive with their checksums, which PyTorch does not."""
    with zipfile.ZipFile(path) as archive:
        if archive.testzip():
            raise zipfile.BadZipFile
