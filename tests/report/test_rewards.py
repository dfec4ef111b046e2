"""The table of weights is that of the paper where nothing is changed."""

from __future__ import annotations

from romnav.navigation.spec import RewardSpec
from romnav.report import formats
from romnav.report.rewards import tabulate

PAPER = {
    "position": (0.2, 0.2),
    "heading": (0.2, 0.2),
    "height": (0.2, 0.2),
    "stand": (0.2, 0.2),
    "geodesic progress": (0.1, 0.1),
    "height progress": (0.1, 0.1),
    "collision": (-1.0, -1.0),
    "action rate": (-0.01, -0.1),
}


def test_weights_stand_beside_the_papers() -> None:
    table = tabulate("nav-rewards", "cpu", RewardSpec(collision=-0.1, collision_late=-0.5))
    (block,) = table.blocks
    shown = {row.label.rstrip("‡"): tuple(cell.value for cell in row.cells) for row in block.rows}
    assert {term: values[2:] for term, values in shown.items()} == PAPER
    assert shown["collision"][:2] == (-0.1, -0.5)
    assert shown["action rate"][:2] == (-0.01, -0.1)
    assert [row.label for row in block.rows if row.label.endswith("‡")] == ["position‡", "heading‡", "stand‡"]
    text = formats.latex(table)
    assert r"collision & $-0.1$ & $-0.5$ & $-1$ & $-1$ \\" in text
    assert r"stand$\ddagger$" in text
