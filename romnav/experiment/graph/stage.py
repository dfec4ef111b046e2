"""One step of an experiment: files in a folder, made from settings and the output of other steps."""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from operator import attrgetter
from pathlib import Path
from typing import Any

from romnav.config import Config
from romnav.errors import RomnavError
from romnav.files import digest
from romnav.progress import Progress


@dataclass(frozen=True)
class Session:
    """How stages are run.

    Raises:
        RomnavError: There is no such device.
    """

    device: str = "cpu"
    """Where numbers are computed: cpu, cuda or cuda:N."""
    resume: bool = True
    """Whether an interrupted stage is continued rather than started over."""

    def __post_init__(self) -> None:
        if self.device == "cpu":
            return
        if not re.fullmatch(r"cuda(:\d+)?", self.device):
            raise RomnavError(f"device {self.device}: there is none of this name; use cpu, cuda or cuda:N")
        import torch

        try:
            torch.empty(0, device=self.device)
        except (RuntimeError, AssertionError) as error:
            reason = str(error).splitlines()[0].rstrip(".")
            raise RomnavError(f"device {self.device}: {reason}; use cpu, cuda or cuda:N") from error


@dataclass(frozen=True)
class Stage:
    """A stage: what it depends on, what it leaves behind, and how it is made."""

    kind: str
    """What it makes, in one word."""
    name: str
    """Unique within a scale, as shown to the user."""
    folder: Path
    """Where its output lies."""
    outputs: tuple[str, ...]
    """Files that it writes into its folder."""
    record: Path
    """File that tells what made the output."""
    settings: Config
    """Settings, of which it uses some."""
    uses: tuple[str, ...]
    """Dotted names of the settings that its output depends on."""
    make: Callable[[Stage, Session, Progress], dict[str, Any]] = field(compare=False)
    """Makes the output and returns facts worth recording, e.g. its training steps."""
    code: tuple[str, ...] = ()
    """What makes its output beside its settings: the format, parts from outside with the digests of their source."""
    reads: tuple[Path, ...] = ()
    """Versioned files that its output depends on."""
    upstream: tuple[Stage, ...] = ()
    """Stages whose output it reads."""
    scratch: tuple[str, ...] = ()
    """Files from which an interrupted run continues; gone once it is finished."""
    beside: tuple[str, ...] = ()
    """Other files and folders of the same run, which go where its scratch goes."""
    command: tuple[str, ...] = ()
    """Words after ``romnav`` that make it alone, if there is such a command."""
    on_request: bool = False
    """Whether it is made only where it is asked for itself: nobody should begin it by accident."""
    cpu_only: bool = False
    """Whether it can be made on the CPU alone."""
    shared: bool = False
    """Whether several processes can make it together (`romnav.ranks`)."""
    arm: str | None = None
    """Arm that it trains or evaluates."""
    seed: int | None = None
    """Training seed of the arm."""

    @cached_property
    def spec(self) -> dict[str, Any]:
        """Everything that determines the output beside the upstream stages, as plain data."""
        plain = {name: _plain(self.settings, name) for name in self.uses}
        if self.code:
            plain["code"] = self.code
        read = {name: digest(path) if path.exists() else None for name, path in _named(self.reads).items()}
        # through JSON, as the record is: a tuple there is a list
        data: dict[str, Any] = json.loads(json.dumps({"arm": self.arm, "seed": self.seed, **plain, **read}))
        return data

    @cached_property
    def key(self) -> str:
        """Hash of the specification and of every upstream key."""
        text = json.dumps([self.kind, self.spec, [stage.key for stage in self.upstream]], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()


def _named(paths: Sequence[Path]) -> dict[str, Path]:
    """Files by their names, or from the folder that they share on where two are called alike."""
    named = {path.name: path for path in paths}
    if len(named) == len(paths):
        return named
    shared = os.path.commonpath(paths)
    return {path.relative_to(shared).as_posix(): path for path in paths}


def _plain(settings: Config, name: str) -> Any:
    """A setting as it is saved."""
    above, _, last = name.rpartition(".")
    section = attrgetter(above)(settings) if above else settings
    if last in type(section).model_fields:
        return section.model_dump(mode="json", include={last}).get(last)
    return getattr(section, last)
