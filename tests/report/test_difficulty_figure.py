from __future__ import annotations

from pathlib import Path

import matplotlib.image
import numpy as np

from romnav.evaluation.difficulty import Goals
from romnav.report.difficulty_figure import draw_difficulty


def _goals(length: float, cross: bool, n: int = 200) -> Goals:
    each = np.linspace(0.5, 1.0, n)
    return Goals(length * each, 4.0 * each * cross, np.full(n, cross), np.zeros(n, bool))


def test_other_goals_give_another_picture_and_none_at_all_give_one(tmp_path: Path) -> None:
    shown = []
    for name, goals in (
        ("near", {"a": _goals(10.0, True)}),
        ("far", {"a": _goals(60.0, True)}),
        ("level", {"a": _goals(10.0, False), "b": _goals(20.0, False)}),
    ):
        draw_difficulty(goals, tmp_path / "new" / f"{name}.png")
        shown.append(matplotlib.image.imread(tmp_path / "new" / f"{name}.png"))
    assert all(0.001 < (image[..., :3].min(axis=2) < 0.9).mean() < 0.5 for image in shown)
    assert not np.array_equal(shown[0], shown[1])
    assert not np.array_equal(shown[0], shown[2])
