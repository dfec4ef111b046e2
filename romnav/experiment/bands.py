"""Nightly regression: today's metrics against the bands that earlier runs are known to stay in."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from statistics import fmean
from typing import Any

from romnav.errors import RomnavError


def check(collected: Mapping[str, Any], file: Path) -> list[str]:
    """Compares the mean over training seeds of each metric with its band.

    Args:
        collected: As ``report.results.collect`` returns it.
        file: ``{"<arm>": {"<metric>": [lowest, highest]}}`` in JSON.

    Returns:
        One line per metric.

    Raises:
        RomnavError: A metric is missing or outside of its band, or the file cannot be read.
    """
    try:
        told = json.loads(file.read_text("utf-8"))
        bands = {
            arm: {metric: (float(low), float(high)) for metric, (low, high) in metrics.items()}
            for arm, metrics in told.items()
        }
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise RomnavError(f"{file}: no readable file of bands ({error})") from error
    lines, failed = [], []
    for arm, metrics in bands.items():
        runs = [run for run in collected["arms"] if run["arm"] == arm]
        for metric, (low, high) in metrics.items():
            values = [run[metric] for run in runs if run.get(metric) is not None]
            value = fmean(values) if values else None
            shown = "missing" if value is None else f"{value:.4g}"
            line = f"{arm} {metric} {shown}, band {low:g} to {high:g}"
            lines.append(line)
            if value is None or not low <= value <= high:
                failed.append(line)
    if failed:
        raise RomnavError(f"{len(failed)} of {len(lines)} metrics outside of {file}: {'; '.join(failed)}")
    return lines
