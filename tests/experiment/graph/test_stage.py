"""What makes a stage out of date."""

from __future__ import annotations

from pathlib import Path

import pytest

from romnav.config import Config
from romnav.experiment.graph.stage import Stage


def stage(*reads: Path) -> Stage:
    return Stage(
        kind="figure", name="figure", folder=Path("out"), outputs=(), record=Path("out/figure.json"),
        settings=Config(), uses=(), make=lambda *_: {}, reads=reads,
    )  # fmt: skip


@pytest.mark.parametrize("changed", [0, 1, 2])
def test_every_file_counts_where_several_are_called_alike(tmp_path: Path, changed: int) -> None:
    files = [tmp_path / arm / "seed-0" / "kept.csv" for arm in ("rom", "uniform", "nocap")]
    for file in files:
        file.parent.mkdir(parents=True)
        file.write_text("before")
    before = stage(*files).key
    files[changed].write_text("after")
    assert stage(*files).key != before


def test_a_file_that_is_moved_keeps_the_key(tmp_path: Path) -> None:
    for place in ("a", "b"):
        for arm in ("rom", "uniform"):
            (tmp_path / place / arm).mkdir(parents=True)
            (tmp_path / place / arm / "kept.csv").write_text(arm)
    keys = {stage(*(tmp_path / place / arm / "kept.csv" for arm in ("rom", "uniform"))).key for place in ("a", "b")}
    assert len(keys) == 1
