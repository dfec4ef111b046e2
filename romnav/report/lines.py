"""How the lines of arms look in figures: colours tell them apart, and dashes where the colours repeat."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import cycle, product

COLOURS = (
    *("#1f4e79", "#c55a11", "#7f7f7f", "#2a9d78", "#b2182b"),
    *("#7b5aa6", "#c99700", "#4bacc6", "#e377c2", "#111111"),
)
DASHES = ("-", "--", "-.")


def styles() -> Iterator[tuple[str, str]]:
    """Colour and line style of one arm after the other, without end."""
    return ((colour, dashes) for dashes, colour in cycle(product(DASHES, COLOURS)))
