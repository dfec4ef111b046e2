"""A module for each kind of stage: what it needs and what it does, side by side."""

from __future__ import annotations

import pkgutil
from collections.abc import Sequence
from importlib import import_module

from romnav.experiment.graph.stage import Stage
from romnav.experiment.workspace import Workspace


def reports(work: Workspace, experiment: str, seeds: Sequence[int]) -> list[Stage]:
    """All that is written of an experiment in the end: by each kind of stage that has a function ``reports``.

    Raises:
        RomnavError: There is no such experiment, or its arms or tables are invalid.
    """
    modules = [import_module(f"{__name__}.{module.name}") for module in pkgutil.iter_modules(__path__)]
    writers = [module.reports for module in modules if hasattr(module, "reports")]
    return [stage for write in writers for stage in write(work, experiment, seeds)]
