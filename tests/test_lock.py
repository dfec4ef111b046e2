"""The locked environment: complete, within the ranges, and one in which romnav works."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from packaging.utils import canonicalize_name
from packaging.version import Version

ROOT = Path(__file__).parents[1]
sys.path.append(str(ROOT / "tools"))
import lock  # noqa: E402

LOWEST = [
    "rsl-rl-lib==5.5.0", "tensordict==0.12.0", "mujoco==4.0.0", "warp-lang==1.15.0", "typer==0.20.0",
    "pydantic==2.12.0", "pydantic-core==2.41.1", "rich==14.0.0", "numpy==2.2.0", "pandas==2.3.0", "pyarrow==21.0.0",
    "scipy==1.15.0", "matplotlib==3.10.0", "osqp==1.0.1", "pytz==2025.2",
]  # fmt: skip
"""Of all but PyTorch, whose older builds take gigabytes; with what pydantic and pandas need at these."""
SLOWER = "tests/evaluation/paired/test_rows.py::test_reading_does_not_import_pandas"
"""Old pyarrow does."""


def test_every_requirement_is_locked_at_a_version_in_its_range() -> None:
    pins = lock.pinned()
    for requirement in lock.wanted():
        name = canonicalize_name(requirement.name)
        assert name in pins, f"{name} is not in requirements.lock: run `make lock`"
        assert requirement.specifier.contains(pins[name]), f"{requirement}, but {pins[name]} is locked: run `make lock`"


def test_what_the_locked_packages_require_is_locked() -> None:
    missing = lock.closure(lock.wanted()).keys() - lock.pinned().keys()
    assert not missing, f"{', '.join(sorted(missing))} not in requirements.lock: run `make lock`"


def test_the_lowest_versions_are_those_of_the_ranges() -> None:
    lowest = dict(pin.split("==") for pin in LOWEST)
    for requirement in lock.wanted():
        name = canonicalize_name(requirement.name)
        if name in lowest:
            (bound,) = (s.version for s in requirement.specifier if s.operator == ">=")
            assert Version(lowest[name]).release[: len(Version(bound).release)] == Version(bound).release


@pytest.mark.slow
def test_romnav_works_with_the_lowest_versions(tmp_path: Path) -> None:
    """They come before this environment's packages, which bring PyTorch and the rest."""
    subprocess.run([sys.executable, "-m", "venv", tmp_path], check=True)
    python = tmp_path / "bin" / "python"
    site = next(tmp_path.glob("lib/python*/site-packages"))
    here = next(path for path in sys.path if path.endswith("site-packages"))
    (site / "beside.pth").write_text(here)
    subprocess.run([python, "-m", "pip", "install", "--quiet", "--no-deps", *LOWEST], check=True)
    tests = [f"tests/{name}" for name in ("cli", "evaluation", "experiment", "report", "sensing", "safety", "world")]
    subprocess.run(
        [
            python,
            "-m",
            "pytest",
            "-p",
            "no:cacheprovider",
            "-m",
            "not slow",
            "--deselect",
            SLOWER,
            *tests,
            "tests/navigation/test_policy.py",
        ],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        check=True,
    )


@pytest.mark.slow
def test_the_locked_versions_can_be_installed_together(tmp_path: Path) -> None:
    """A fresh environment of the lock alone has all that the tests import."""
    subprocess.run(["make", "setup", f"VENV={tmp_path / 'fresh'}", f"PYTHON={sys.executable}"], cwd=ROOT, check=True)
    python = tmp_path / "fresh" / "bin" / "python"
    subprocess.run([python, "-m", "pip", "check"], check=True)
    subprocess.run([python, "-m", "pytest", "-p", "no:cacheprovider", "--collect-only", "-q"], cwd=ROOT, check=True)
