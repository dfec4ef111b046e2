"""The weights of the reward (paper, Table I) beside the paper's."""

from __future__ import annotations

from romnav.navigation.rewards import TERMS
from romnav.navigation.spec import RewardSpec
from romnav.report.formats import Block, Cell, Row, Table

GATED = ("position", "heading", "stand")
"""Terms that pay near the goal alone."""
CAPTION = (
    "Weights of the reward terms; ‡ marks those that are gated by the geodesic. What a term is worth in a step is in "
    "the paper's Table I and in romnav/navigation/rewards.py. Later: from {switch:.0%} of a run on. This work: {scale} "
    "scale, times {factor:g}."
)


def tabulate(name: str, scale: str, reward: RewardSpec) -> Table:
    """A row for each term: our weight at first and later, and the paper's."""
    paper = RewardSpec()
    rows = []
    for term in TERMS:
        cells = [_cell(weight) for spec in (reward, paper) for weight in _weights(spec, term)]
        rows.append(Row(term.replace("_", " ") + "‡" * (term in GATED), tuple(cells)))
    return Table(
        name=name,
        caption=CAPTION.format(switch=reward.action_rate_switch, scale=scale, factor=reward.scale),
        spans=((f"{scale} scale", 2), ("Paper", 2)),
        header=("Term", "first", "later", "first", "later"),
        columns=("first", "later", "paper_first", "paper_later"),
        blocks=(Block("ours", "", tuple(rows)),),
        provenance={"scale": scale},
    )


def _weights(spec: RewardSpec, term: str) -> tuple[float, float]:
    """At first, and from the switch on."""
    if term == "action_rate":
        return spec.action_rate
    first = getattr(spec, term)
    late = spec.collision_late if term == "collision" else None
    return first, first if late is None else late


def _cell(weight: float) -> Cell:
    return Cell(weight, f"{weight:g}")
