"""Writes requirements.lock: what the default and dev requirements need, at the versions that this environment has."""

from __future__ import annotations

import re
import tomllib
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

ROOT = Path(__file__).parents[1]
LOCK = ROOT / "requirements.lock"
CUDA = ("cuda-", "nvidia-", "triton")
"""What PyTorch brings where it is built for GPUs."""
HEAD = "# The environment that every recorded number is of. Written by `make lock`; installed by `make setup`."


def wanted() -> list[Requirement]:
    """The requirements of pyproject.toml that `make setup` installs."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    return [Requirement(line) for line in (*project["dependencies"], *project["optional-dependencies"]["dev"])]


def closure(requirements: list[Requirement]) -> dict[str, str]:
    """Installed versions, without a build's local suffix, of the requirements and of all that these require.

    Raises:
        SystemExit: One of them is not installed.
    """
    pins: dict[str, str] = {}
    seen: set[tuple[str, str]] = set()
    waiting = [(requirement, "") for requirement in requirements]
    while waiting:
        requirement, extra = waiting.pop()
        if requirement.marker and not requirement.marker.evaluate({"extra": extra}):
            continue
        name = canonicalize_name(requirement.name)
        if name.startswith(CUDA):
            continue
        try:
            found = distribution(requirement.name)
        except PackageNotFoundError:
            raise SystemExit(f"error: {name} is not installed; run `pip install -e '.[dev]'`, then again") from None
        pins[name] = Version(found.version).public
        for extra in ("", *sorted(requirement.extras)):
            if (name, extra) not in seen:
                seen.add((name, extra))
                waiting += [(Requirement(line), extra) for line in found.requires or ()]
    return pins


def pinned() -> dict[str, str]:
    """Versions in requirements.lock by canonical name."""
    return dict(re.findall(r"^(\S+)==(\S+)$", LOCK.read_text("utf-8"), re.MULTILINE))


if __name__ == "__main__":
    pins = closure(wanted())
    LOCK.write_text("\n".join([HEAD, *(f"{name}=={pins[name]}" for name in sorted(pins)), ""]), "utf-8")
    print(f"{LOCK}: {len(pins)} packages")
