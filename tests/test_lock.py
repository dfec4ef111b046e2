"""The locked environment: complete, within the ranges, and one in which romnav works."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
sys.path.append(str(ROOT / "tools"))
import lock  # noqa: E402


def test_every_requirement_is_locked_at_a_version_in_its_range() -> None:
    pins = lock.pinned()
    for requirement in lock.wanted():
        name = canonicalize_name(requirement.name)
        assert name in pins, f"{name} is not in requirements.lock: run `make lock`"
        assert requirement.specifier.contains(pins[name]), f"{requirement}, but {pins[name]} is locked: run `make lock`"


def test_what_the_locked_packages_require_is_locked() -> None:
    missing = lock.closure(lock.wanted()).keys() - lock.pinned().keys()
    assert not missing, f"{', '.join(sorted(missing))} not in requirements.lock: run `make lock`"


@pytest.mark.slow
def test_the_locked_versions_can_be_installed_together(tmp_path: Path) -> None:
    """A fresh environment of the lock alone has all that the tests import."""
    subprocess.run(["make", "setup", f"VENV={tmp_path / 'fresh'}", f"PYTHON={sys.executable}"], cwd=ROOT, check=True)
    python = tmp_path / "fresh" / "bin" / "python"
    subprocess.run([python, "-m", "pip", "check"], check=True)
    subprocess.run([python, "-m", "pytest", "-p", "no:cacheprovider", "--collect-only", "-q"], cwd=ROOT, check=True)
