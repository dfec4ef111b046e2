"""Tables of paired episodes, made from episode rows as an experiment declares them, published rows beside ours."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

from romnav.errors import NothingRecorded
from romnav.evaluation.paired.metrics import LEVELS, METRICS, Direction, Metric, find, split
from romnav.evaluation.paired.statistics import Bootstrap
from romnav.evaluation.spec import HORIZONS
from romnav.report.formats import Block, Cell, Row, Table, number
from romnav.report.provenance import distinct, source, sources, training
from romnav.report.spec import Column, Entry, Published, TableKind, TableSpec


@dataclass(frozen=True)
class Cost:
    """A cost of an arm's own training."""

    label: str
    definition: str
    scale: float
    """By which its number in the rows' provenance is multiplied."""
    unit: str = ""
    better: Direction | None = None
    decimals: int = 1


COSTS = {
    "steps": Cost("Steps", "environment steps of an arm's own training", 1e-6, "M"),
    "hours": Cost("Hours", "hours of an arm's own training", 1.0),
}
"""Costs of training by name."""

_BY_LEVEL = tuple((f"sr_{horizon}_{level}", f"{horizon} s", level) for horizon in HORIZONS for level in LEVELS[1:])
USUAL: dict[TableKind, tuple[Column, ...]] = {
    "performance": tuple(Column(metric=metric) for metric in ("sr_45", "sr_120", "t2g", "spl")),
    "success": tuple(Column(metric=metric, header=f"{within}, {level}") for metric, within, level in _BY_LEVEL),
    "failures": tuple(Column(metric=f"{m}_{level}") for m in ("falls", "timeouts") for level in LEVELS[1:]),
    "contrasts": tuple(Column(metric=metric, header=level) for metric, _, level in _BY_LEVEL),
}
"""Columns of a table that names none."""
_SPANS = tuple((within, len([*group])) for within, group in groupby(within for _, within, _ in _BY_LEVEL))
_Blocks = list[tuple[Row, ...]]


def known_metrics(kind: TableKind) -> list[str]:
    """Names that a column of a kind of table may have; costs of training have no interval to contrast."""
    metrics = [m if level == "all" else f"{m}_{level}" for m in METRICS for level in LEVELS]
    return metrics if kind == "contrasts" else [*metrics, *COSTS]


def meaning(metric: str) -> Metric | Cost:
    """What the name of a column stands for, at whichever level."""
    name = split(metric)[0]
    return COSTS.get(name) or find(name)


def build(name: str, spec: TableSpec, title: str, bootstrap: Bootstrap, published: Published | None = None) -> Table:
    """Makes a table of the arms of a bootstrap; trained arms that were not evaluated are shown as dashes.

    Args:
        name: Of the table and its files.
        spec: As declared, its rows and reference completed.
        title: What a table without a caption of its own is about.
        bootstrap: Of the evaluated arms.
        published: Results to print below ours.

    Raises:
        NothingRecorded: No arm of the table but bounds was evaluated.
    """
    columns = spec.columns or USUAL[spec.kind]
    provenance, note = _provenance(name, spec, bootstrap, published)
    spans: tuple[tuple[str, int], ...] = ()
    headers = tuple(column.header or _header(column.metric) for column in columns)
    if spec.kind == "contrasts":
        ours, theirs = _contrasts(spec, columns, bootstrap, published)
        rates = all(meaning(column.metric).unit == "%" for column in columns)
        headers = ("Contrast (%)" if rates else "Contrast", *headers)
        spans = () if spec.columns else _SPANS
    else:
        ours, theirs = _performance(spec, columns, bootstrap, published)
        headers = ("Arm", *headers)
    groups = [("ours", f"This work, {provenance['scale']} scale", ours)]
    if published:
        groups.append(("paper", published.title, theirs))
    blocks = tuple(
        Block(source, title if k == 0 else "", rows)
        for source, title, parts in groups
        for k, rows in enumerate(filter(None, parts))
    )
    caption = f"{spec.caption or _caption(spec, title, columns)} {note}"
    return Table(name, caption, spans, headers, tuple(column.metric for column in columns), blocks, provenance)


def evaluated(spec: TableSpec, bootstrap: Bootstrap) -> list[str]:
    """The arms of a table that were evaluated."""
    arms = dict.fromkeys(entry.arm for entry in (*_compared(spec), *spec.bounds))
    return [arm for arm in arms if arm in bootstrap.arms]


def _compared(spec: TableSpec) -> list[Entry]:
    """All but the bounds."""
    rows = [entry for block in spec.rows for entry in block]
    return [spec.reference, *rows] if spec.kind == "contrasts" else rows


def _header(metric: str) -> str:
    level, meant = split(metric)[1], meaning(metric)
    label = meant.label if level == "all" else f"{meant.label}, {level}"
    return f"{label} ({meant.unit})" if meant.unit else label


def _caption(spec: TableSpec, title: str, columns: Sequence[Column]) -> str:
    """What a table without a caption of its own says of itself."""
    if spec.kind == "contrasts":
        reference = spec.reference.label
        return (
            f"{title}: paired differences of {reference} to each other arm. Positive: more of it with {reference}; "
            "† marks a 95% confidence interval excluding zero."
        )
    metrics = dict.fromkeys(meaning(column.metric) for column in columns)
    definitions = "; ".join(f"{metric.label}: {metric.definition}" for metric in metrics)
    return f"{title}. {definitions}. Bold marks the best arm per column."


def _performance(
    spec: TableSpec, columns: Sequence[Column], bootstrap: Bootstrap, published: Published | None
) -> tuple[_Blocks, _Blocks]:
    def measured(arm: str, column: Column) -> Cell:
        name, level = split(column.metric)
        if name in COSTS:
            cost = COSTS[name]
            if arm not in bootstrap.arms:
                return number(math.nan, cost.decimals)
            runs = [getattr(run.provenance, name) for run in bootstrap.arms[arm].runs]
            return number(cost.scale * sum(runs) / len(runs), cost.decimals)
        decimals = find(name).decimals
        if arm not in bootstrap.arms:
            return number(math.nan, decimals)
        estimate = bootstrap.metric(arm, name, level)
        return number(estimate.value, decimals, lo=estimate.lo, hi=estimate.hi, n=estimate.n)

    known = published.arms if published else {}

    def theirs(arm: str, column: Column) -> Cell:
        return number(known.get(arm, {}).get(column.metric, math.nan), meaning(column.metric).decimals)

    bounds = tuple(entry for entry in spec.bounds if entry.arm in bootstrap.arms)
    stated = {metric for entry in spec.entries for metric in known.get(entry.arm, ())}
    blocks = spec.rows if stated & {column.metric for column in columns} else ()
    ours = _with_best((*spec.rows, bounds), columns, measured, bootstrap)
    return ours, _with_best(blocks, columns, theirs)


def _with_best(
    blocks: Sequence[tuple[Entry, ...]],
    columns: Sequence[Column],
    cell: Callable[[str, Column], Cell],
    measured: Bootstrap | None = None,
) -> _Blocks:
    """Rows of every block; bold marks a column's best shown value (and ties) among competing arms."""
    competing = [entry.arm for block in blocks for entry in block if entry.competes]

    def column_cells(column: Column) -> dict[str, Cell]:
        cells = {entry.arm: cell(entry.arm, column) for block in blocks for entry in block}
        shown = {arm: float(cells[arm].text) for arm in competing if math.isfinite(cells[arm].value)}
        better = meaning(column.metric).better
        best = {"higher": max, "lower": min}[better](shown.values()) if better and column.bold and shown else None
        return {arm: dataclasses.replace(c, bold=shown.get(arm, math.nan) == best) for arm, c in cells.items()}

    made = [column_cells(column) for column in columns]
    return [
        tuple(Row(e.label, tuple(cells[e.arm] for cells in made), _sources(measured, e.arm)) for e in block)
        for block in blocks
    ]


def _sources(measured: Bootstrap | None, *arms: str) -> tuple[Mapping[str, Any], ...]:
    """The rows of those arms that were evaluated."""
    runs = [run for arm in arms if measured and arm in measured.arms for run in measured.arms[arm].runs]
    return tuple(source(run.source, run.provenance) for run in runs)


def _contrasts(
    spec: TableSpec, columns: Sequence[Column], bootstrap: Bootstrap, published: Published | None
) -> tuple[_Blocks, _Blocks]:
    def measured(arm: str, column: Column) -> Cell:
        metric, level = split(column.metric)
        decimals = find(metric).decimals
        if not {spec.reference.arm, arm} <= set(bootstrap.arms):
            return number(math.nan, decimals)
        c = bootstrap.contrast(spec.reference.arm, arm, metric, level)
        facts = {"lo": c.lo, "hi": c.hi, "n": c.n, "a_only": c.a_only, "b_only": c.b_only, "mid_p": c.mid_p}
        return number(c.diff, decimals, sign=True, dagger=c.significant, **facts)

    known = published.contrasts.get(spec.reference.arm, {}) if published else {}

    def theirs(arm: str, column: Column) -> Cell:
        decimals, stated = meaning(column.metric).decimals, known.get(arm, {}).get(column.metric)
        if stated is None:
            return number(math.nan, decimals)
        return number(stated.diff, decimals, sign=True, dagger=stated.significant)

    def rows(
        entries: Iterable[Entry], cell: Callable[[str, Column], Cell], measured: Bootstrap | None = None
    ) -> tuple[Row, ...]:
        return tuple(
            Row(
                f"{spec.reference.label} − {entry.label}",
                tuple(cell(entry.arm, column) for column in columns),
                _sources(measured, spec.reference.arm, entry.arm),
            )
            for entry in entries
        )

    bounds = [entry for entry in spec.bounds if entry.arm in bootstrap.arms]
    stated = [rows(block, theirs) for block in spec.rows] if known else []
    return [rows(entries, measured, bootstrap) for entries in (*spec.rows, bounds)], stated


def _provenance(
    name: str, spec: TableSpec, bootstrap: Bootstrap, published: Published | None
) -> tuple[dict[str, str], str]:
    """Provenance of the evaluated arms of a table, and the end of its caption that states it."""
    compared = _compared(spec)
    if not any(entry.arm in bootstrap.arms for entry in compared):
        raise NothingRecorded(f"table {name}: no arm of it was evaluated; evaluate {compared[0].arm} first")
    shown = [bootstrap.arms[arm] for arm in evaluated(spec, bootstrap)]
    runs = [run for arm in shown for run in arm.runs]
    files = [run.provenance for run in runs]
    facts = sources(files)
    seeds = distinct(str(len(arm.runs)) for arm in shown if any(run.provenance.steps for run in arm.runs))
    trained = f"training of {training(files)} steps, training seeds per arm: {seeds}; " if seeds else ""
    note = (
        f"This work: {facts['scale']} scale, {trained}"
        f"{len(runs[0])} paired episodes of set {facts['episode_set'][:12]}; commit {facts['commit']}."
    )
    return facts, f"{note} {published.title}: as published." if published else note
