"""A metric: how much longer than the shortest path successful robots walk."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np
from numpy.typing import NDArray


class Detour:
    """Metres walked for every metre of the shortest path, over successes; above 1, or robots cut corners."""

    label = "Detour"
    definition = "metres walked by successful robots for every metre of their shortest paths"
    scale = 1.0
    unit = ""
    better: Literal["lower"] = "lower"
    decimals = 2

    def numerator(self, columns: Mapping[str, NDArray]) -> NDArray:
        """Metres walked."""
        return np.where(columns["outcome"] == "success", columns["path_length"], 0.0)

    def denominator(self, columns: Mapping[str, NDArray]) -> NDArray:
        """Metres of the shortest path."""
        return np.where(columns["outcome"] == "success", columns["geodesic"], 0.0)
