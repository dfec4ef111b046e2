"""Where the numbers of a table come from, for its caption and its CSV."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from romnav.evaluation.rowfile import Provenance


def sources(files: Sequence[Provenance]) -> dict[str, str]:
    """Scale, commit and episode set of the files that a table is made of; several where they differ."""
    return {
        "scale": distinct(file.scale for file in files),
        "commit": distinct(short(file.commit) for file in files),
        "episode_set": distinct(file.episode_set for file in files),
    }


def short(commit: str) -> str:
    """The first twelve digits of a commit, with "-dirty" where it was."""
    return re.sub(r"(?<=^\w{12})\w+", "", commit)


def training(files: Sequence[Provenance]) -> str:
    """Environment steps of the trained ones; empty where there are none."""
    return distinct(f"{file.steps / 1e6:.3g} M" for file in files if file.steps)


def distinct(texts: Iterable[str]) -> str:
    """The texts that there are, each once."""
    return ", ".join(sorted(set(texts)))


def source(file: str | Path, provenance: Provenance) -> dict[str, Any]:
    """A file of rows, by its place under ``results/``, and where it comes from."""
    return {"file": "/".join(Path(file).parts[-4:]), **provenance.model_dump(exclude_unset=True)}
