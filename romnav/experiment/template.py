"""What a new project begins with: experiments, scales, episode sets, and what there is at the smoke scale."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import romnav
from romnav.errors import RomnavError
from romnav.files import unwritable

CARRIED = (
    "experiments/**/*",
    "results/smoke/bands.json",
    *(f"results/smoke/encoder/*/{name}" for name in ("encoder.*", "curve.csv")),
    *(f"results/smoke/*/seed-*/{name}" for name in ("policy.pt", "spec.json", "curve.csv", "episodes.*", "tracks.npz")),
)
"""Files of a new project; a wheel has them in ``romnav/template`` (pyproject.toml), a checkout where they are made."""
IGNORED = ".cache/\nresults/**/checkpoint.pt\nresults/**/kept/\n"
"""What git need not keep of a project."""


def init(folder: Path) -> None:
    """Makes a project folder.

    Raises:
        RomnavError: There is a project already, or the folder cannot be written.
    """
    if (folder / "experiments").exists():
        raise RomnavError(f"{folder / 'experiments'}: exists; name another folder")
    try:
        for path, source in _files():
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source, folder / path)
        (folder / ".gitignore").write_text(IGNORED)
    except OSError as error:
        raise unwritable(folder, error) from error


def _files() -> Iterator[tuple[Path, Path]]:
    """Files of a new project by their place in it."""
    package = Path(romnav.__path__[0])
    root = package / "template" if (package / "template").is_dir() else package.parent
    found = sorted({path for pattern in CARRIED for path in root.glob(pattern) if path.is_file()})
    yield from ((path.relative_to(root), path) for path in found)
