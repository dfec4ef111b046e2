"""Nightly regression: today's metrics against the bands that earlier runs are known to stay in."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from statistics import fmean
from typing import Any

from romnav.config import LARGEST
from romnav.errors import RomnavError
from romnav.experiment.project import Project
from romnav.experiment.spec import suggest
from romnav.report.paired.results import METRICS

Bands = dict[str, dict[str, tuple[float, float]]]
"""Lowest and highest value by arm and metric."""

FORM = 'write {"rom": {"sr_45": [31, 100]}}: arms, their metrics, of each the lowest and the highest value'


def read(file: Path, project: Project) -> Bands:
    """Reads ``{"<arm>": {"<metric>": [lowest, highest]}}`` in JSON.

    Raises:
        RomnavError: The file cannot be read, checks nothing, or names an arm, a metric or a band that is none.
    """
    try:
        told = json.loads(file.read_text("utf-8"))
    except OSError as error:
        raise RomnavError(f"{file}: cannot be read ({(error.strerror or str(error)).lower()}); {FORM}") from error
    except (ValueError, RecursionError) as error:
        raise RomnavError(f"{file}: not valid JSON ({error}); {FORM}") from error
    bands: Bands = {}
    for arm, metrics in _table(told, f"{file}:").items():
        if arm not in project.arms:
            _refuse_arm(arm, file, project)
        bands[arm] = {}
        for metric, band in _table(metrics, f"{file}: key {arm}:").items():
            key = f"{file}: key {arm}.{metric}:"
            if metric not in METRICS:
                raise RomnavError(f"{key} unknown metric{suggest(metric, METRICS)}")
            bands[arm][metric] = _band(band, key)
    return bands


def check(collected: Mapping[str, Any], bands: Bands, file: Path) -> list[str]:
    """Compares the mean over training seeds of each metric with its band.

    Args:
        collected: As ``report.results.collect`` returns it.
        bands: As `read` returns them.
        file: Where they are from.

    Returns:
        One line per metric.

    Raises:
        RomnavError: A metric is missing or outside of its band.
    """
    lines, failed = [], []
    for arm, metrics in bands.items():
        runs = [run for run in collected["arms"] if run["arm"] == arm]
        for metric, (low, high) in metrics.items():
            values = [run[metric] for run in runs if run[metric] is not None]
            value = fmean(values) if values else None
            shown = "missing" if value is None else f"{value:.4g}"
            line = f"{arm} {metric} {shown}, band {low:g} to {high:g}"
            lines.append(line)
            if value is None or not low <= value <= high:
                failed.append(line)
    if failed:
        raise RomnavError(f"{len(failed)} of {len(lines)} metrics outside of {file}: {'; '.join(failed)}")
    return lines


def _table(value: Any, key: str) -> dict[str, Any]:
    if not isinstance(value, dict) or not value:
        raise RomnavError(f"{key} {_shown(value)} holds no bands; {FORM}")
    return value


def _refuse_arm(arm: str, file: Path, project: Project) -> None:
    try:
        project.having(arm)  # tells of a file that the arm may be in, if one is invalid
    except RomnavError as error:
        raise RomnavError(f"{file}: key {arm}: {error}") from error


def _band(value: Any, key: str) -> tuple[float, float]:
    numbers = value if isinstance(value, list) and all(type(v) in (int, float) for v in value) else []
    if len(numbers) != 2 or not -LARGEST <= numbers[0] <= numbers[1] <= LARGEST:  # as NaN would not be
        raise RomnavError(
            f"{key} {_shown(value)} is no band; write [lowest, highest], two numbers of which the second is no less"
        )
    return numbers[0], numbers[1]


def _shown(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 40 else f"{text[:40]}..."
