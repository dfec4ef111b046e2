"""The paper's tables of paired episodes, made from episode rows, the paper's rows beside ours."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from romnav.errors import NothingRecorded, RomnavError
from romnav.evaluation.paired.metrics import Level
from romnav.evaluation.paired.rows import HORIZONS, Arm
from romnav.evaluation.paired.statistics import Bootstrap
from romnav.report import paper
from romnav.report.formats import Block, Cell, Row, Table, number
from romnav.report.provenance import distinct, source, sources, training


@dataclass(frozen=True)
class Entry:
    """An arm in a table: its name in ``results/``, its label, and whether it competes for bold."""

    arm: str
    label: str
    competes: bool = True


@dataclass(frozen=True)
class Column:
    """A metric of the episodes of a level, or a cost of training, in a performance table; ``best`` picks the value in
    bold."""

    metric: str
    header: str
    decimals: int
    best: Callable[[list[float]], float] | None
    level: Level = "all"

    @property
    def key(self) -> str:
        """Its name in files, and among the paper's numbers."""
        return self.metric if self.level == "all" else f"{self.metric}_{self.level}"


@dataclass(frozen=True)
class PerformanceSpec:
    """Metrics per arm. Blocks of arms are set apart; bounds are scripted arms, shown if evaluated."""

    name: str
    caption: str
    reference: Entry
    blocks: tuple[tuple[Entry, ...], ...]
    columns: tuple[Column, ...]
    bounds: tuple[Entry, ...] = ()

    @property
    def entries(self) -> tuple[Entry, ...]:
        """Every arm of the table."""
        return (*(entry for block in self.blocks for entry in block), *self.bounds)


@dataclass(frozen=True)
class LevelsSpec:
    """Success rate of a reference arm minus that of each other arm, by horizon and level."""

    name: str
    caption: str
    reference: Entry
    others: tuple[Entry, ...]
    bounds: tuple[Entry, ...] = ()

    @property
    def entries(self) -> tuple[Entry, ...]:
        """Every arm of the table."""
        return (self.reference, *self.others, *self.bounds)


_ROM = Entry("rom", "RoM")
_ABLATIONS = (Entry("uniform", "Uniform"), Entry("nocap", "NoCap"), Entry("uniform-nocap", "UniformNoCap"))
_ROM_CYL = Entry("rom", "RoM (cyl)*", competes=False)
_SINGLE, _ROM_HUM = Entry("single-stage", "Single-Stage"), Entry("rom-hum", "RoM (hum)")
_ROM_NAV = Entry("rom-nav", "RoM-Nav")
_BOUNDS = (Entry("oracle", "Oracle", competes=False), Entry("straight", "Straight", competes=False))
_RATES = (Column("sr_45", "SR@45 (%)", 1, max), Column("sr_120", "SR@120 (%)", 1, max))
_TIME, _SPL = Column("t2g", "T2G (s)", 1, min), Column("spl", "SPL", 3, max)
_COSTS = {"steps": 1e-6, "hours": 1.0}
"""Costs of training, by what they are multiplied with."""
_COST_COLUMNS = (Column("steps", "Steps (M)", 1, None), Column("hours", "Hours", 1, None))
_FAILURES = tuple(
    Column(metric, f"{name}, {level} (%)", 1, min, level)
    for metric, name in (("falls", "Falls"), ("timeouts", "Timeouts"))
    for level in ("same", "cross")
)
_SUCCESSES = tuple(
    Column(f"sr_{horizon}", f"{horizon} s, {level}", 1, max, level)
    for horizon in HORIZONS
    for level in ("same", "cross")
)
_ORACLE_HUM = Entry("oracle-hum", "Oracle (hum)", competes=False)
_METRICS = (
    "SR@45 and SR@120 are success within 45 s (the training budget) and 120 s; T2G is the mean time to goal "
    "over successful episodes; SPL is success weighted by path length against the geodesic route."
)
_DAGGER = "† marks a 95% confidence interval excluding zero."

SPECS: tuple[PerformanceSpec | LevelsSpec, ...] = (
    PerformanceSpec(
        "spawngoal-perf-rom",
        f"Spawn/goal-distribution ablation on the RoM. {_METRICS} Bold marks the best arm per column (not of "
        "T2G, which favours arms that complete only short episodes). Oracle follows the true geodesic, "
        "Straight walks towards the goal: scripted bounds.",
        _ROM,
        ((_ROM, *_ABLATIONS),),
        (*_RATES, dataclasses.replace(_TIME, best=None), _SPL),
        _BOUNDS,
    ),
    LevelsSpec(
        "spawngoal-levels-rom",
        "Spawn/goal ablation: paired contrasts of success rate by same-level and cross-level goals. "
        f"Positive favours RoM; {_DAGGER}",
        _ROM,
        _ABLATIONS,
        _BOUNDS,
    ),
    PerformanceSpec(
        "nav-perf",
        f"Navigation performance across training methods. {_METRICS} Bold marks the best humanoid arm per "
        "column. Steps and hours are of an arm's own training: RoM-Nav needs those of RoM as well. *RoM (cyl) is "
        "evaluated on RoM dynamics.",
        _ROM_NAV,
        ((_ROM_CYL,), (_SINGLE, _ROM_HUM, _ROM_NAV)),
        (*_RATES, _TIME, _SPL, *_COST_COLUMNS),
        (_ORACLE_HUM,),
    ),
    LevelsSpec(
        "nav-levels",
        f"Paired contrasts of success rate by same-level and cross-level goals. Positive favours RoM-Nav; {_DAGGER}",
        _ROM_NAV,
        (_ROM_HUM, _SINGLE),
    ),
    PerformanceSpec(
        "nav-failures",
        "How episodes of 120 s fail, by same-level and cross-level goals: the robot fell, or its time ran out. Bold "
        "marks the best humanoid arm per column. *RoM (cyl), evaluated on RoM dynamics, cannot fall.",
        _ROM_NAV,
        ((_ROM_CYL,), (_SINGLE, _ROM_HUM, _ROM_NAV)),
        _FAILURES,
        (_ORACLE_HUM,),
    ),
    PerformanceSpec(
        "nav-success",
        "Success rates (%) within 45 s and 120 s, by same-level and cross-level goals. Bold marks the best humanoid "
        "arm per column. The paper's follow from its totals, falls, timeouts and contrasts. *RoM (cyl) is evaluated on "
        "RoM dynamics.",
        _ROM_NAV,
        ((_ROM_CYL,), (_SINGLE, _ROM_HUM, _ROM_NAV)),
        _SUCCESSES,
        (_ORACLE_HUM,),
    ),
    PerformanceSpec(
        "spawngoal-success-rom",
        "Spawn/goal ablation: success rates (%) within 45 s and 120 s, by same-level and cross-level goals. Bold marks "
        "the best arm per column. The paper gives their contrasts alone.",
        _ROM,
        ((_ROM, *_ABLATIONS),),
        _SUCCESSES,
        _BOUNDS,
    ),
)
"""The tables of the paper's Sec. IV that are made of paired episodes."""

_BY_LEVEL: tuple[tuple[int, Level], ...] = tuple((h, level) for h in HORIZONS for level in ("same", "cross"))
_Blocks = list[tuple[Row, ...]]


def build_all(arms: Sequence[Arm]) -> list[Table]:
    """Every table of ``SPECS`` whose reference arm and at least one other arm were evaluated.

    Raises:
        RomnavError: No table can be made of these arms.
    """
    bootstrap = Bootstrap(arms)
    possible = [
        spec
        for spec in SPECS
        if spec.reference.arm in bootstrap.arms and len({e.arm for e in spec.entries} & set(bootstrap.arms)) > 1
    ]
    if not possible:
        needed = " or ".join(sorted({spec.reference.arm for spec in SPECS}))
        raise RomnavError(
            f"{', '.join(bootstrap.arms)}: no table can be made of these; evaluate {needed} and another arm"
        )
    return [build(spec, bootstrap) for spec in possible]


def build(spec: PerformanceSpec | LevelsSpec, bootstrap: Bootstrap) -> Table:
    """Makes a table of the arms of a bootstrap; trained arms that were not evaluated are shown as dashes.

    Raises:
        RomnavError: No arm of the table was evaluated.
    """
    provenance, note = _provenance(spec, bootstrap)
    if isinstance(spec, PerformanceSpec):
        spans: tuple[tuple[str, int], ...] = ()
        header = ("Arm", *(column.header for column in spec.columns))
        keys = tuple(column.key for column in spec.columns)
        ours, published = _performance(spec, bootstrap)
    else:
        spans = tuple((f"{horizon} s", 2) for horizon in HORIZONS)
        header = ("Contrast (%)", *(level for _, level in _BY_LEVEL))
        keys = tuple(f"sr_{horizon}_{level}" for horizon, level in _BY_LEVEL)
        ours, published = _levels(spec, bootstrap)
    groups = (("ours", f"This work, {provenance['scale']} scale", ours), ("paper", "Paper", published))
    blocks = tuple(
        Block(source, title if k == 0 else "", rows)
        for source, title, parts in groups
        for k, rows in enumerate(filter(None, parts))
    )
    return Table(spec.name, f"{spec.caption} {note}", spans, header, keys, blocks, provenance)


def _performance(spec: PerformanceSpec, bootstrap: Bootstrap) -> tuple[_Blocks, _Blocks]:
    def measured(arm: str, column: Column) -> Cell:
        if arm not in bootstrap.arms:
            return number(math.nan, column.decimals)
        if (unit := _COSTS.get(column.metric)) is not None:
            runs = [getattr(run.provenance, column.metric) for run in bootstrap.arms[arm].runs]
            return number(unit * sum(runs) / len(runs), column.decimals)
        estimate = bootstrap.metric(arm, column.metric, column.level)
        return number(estimate.value, column.decimals, lo=estimate.lo, hi=estimate.hi, n=estimate.n)

    def published(arm: str, column: Column) -> Cell:
        return number(paper.PERFORMANCE.get(arm, {}).get(column.key, math.nan), column.decimals)

    bounds = tuple(entry for entry in spec.bounds if entry.arm in bootstrap.arms)
    known = {key for entry in spec.entries for key in paper.PERFORMANCE.get(entry.arm, ())}
    blocks = spec.blocks if known & {column.key for column in spec.columns} else ()
    ours = _with_best(spec, (*spec.blocks, bounds), measured, bootstrap)
    return ours, _with_best(spec, blocks, published)


def _with_best(
    spec: PerformanceSpec,
    blocks: Sequence[tuple[Entry, ...]],
    cell: Callable[[str, Column], Cell],
    measured: Bootstrap | None = None,
) -> _Blocks:
    """Rows of every block; bold marks a column's best shown value (and ties) among competing arms."""
    competing = [entry.arm for block in blocks for entry in block if entry.competes]

    def column_cells(column: Column) -> dict[str, Cell]:
        cells = {entry.arm: cell(entry.arm, column) for block in blocks for entry in block}
        shown = {arm: float(cells[arm].text) for arm in competing if math.isfinite(cells[arm].value)}
        best = column.best(list(shown.values())) if column.best and shown else None
        return {arm: dataclasses.replace(c, bold=shown.get(arm, math.nan) == best) for arm, c in cells.items()}

    columns = [column_cells(column) for column in spec.columns]
    return [
        tuple(Row(e.label, tuple(cells[e.arm] for cells in columns), _sources(measured, e.arm)) for e in block)
        for block in blocks
    ]


def _sources(measured: Bootstrap | None, *arms: str) -> tuple[Mapping[str, Any], ...]:
    """The rows of those arms that were evaluated."""
    runs = [run for arm in arms if measured and arm in measured.arms for run in measured.arms[arm].runs]
    return tuple(source(run.source, run.provenance) for run in runs)


def _levels(spec: LevelsSpec, bootstrap: Bootstrap) -> tuple[_Blocks, _Blocks]:
    def measured(arm: str, horizon: int, level: Level) -> Cell:
        if not {spec.reference.arm, arm} <= set(bootstrap.arms):
            return number(math.nan, 1)
        c = bootstrap.contrast(spec.reference.arm, arm, horizon, level)
        facts = {"lo": c.lo, "hi": c.hi, "n": c.n, "a_only": c.a_only, "b_only": c.b_only, "mid_p": c.mid_p}
        return number(c.diff, 1, sign=True, dagger=c.significant, **facts)

    def published(arm: str, horizon: int, level: Level) -> Cell:
        diff, significant = paper.CONTRASTS.get((spec.reference.arm, arm), {}).get((horizon, level), (math.nan, False))
        return number(diff, 1, sign=True, dagger=significant)

    def rows(
        entries: Iterable[Entry], cell: Callable[[str, int, Level], Cell], measured: Bootstrap | None = None
    ) -> tuple[Row, ...]:
        return tuple(
            Row(
                f"{spec.reference.label} − {entry.label}",
                tuple(cell(entry.arm, *where) for where in _BY_LEVEL),
                _sources(measured, spec.reference.arm, entry.arm),
            )
            for entry in entries
        )

    bounds = [entry for entry in spec.bounds if entry.arm in bootstrap.arms]
    ours = [rows(entries, measured, bootstrap) for entries in (spec.others, bounds)]
    return ours, [rows(spec.others, published)]


def _provenance(spec: PerformanceSpec | LevelsSpec, bootstrap: Bootstrap) -> tuple[dict[str, str], str]:
    """Provenance of the evaluated arms of a table, and the end of its caption that states it."""
    shown = [bootstrap.arms[e.arm] for e in spec.entries if e.arm in bootstrap.arms]
    runs = [run for arm in shown for run in arm.runs]
    if not runs:
        raise NothingRecorded(f"table {spec.name}: no arm of it was evaluated; evaluate {spec.reference.arm} first")
    files = [run.provenance for run in runs]
    facts = sources(files)
    seeds = distinct(str(len(arm.runs)) for arm in shown if any(run.provenance.steps for run in arm.runs))
    note = (
        f"This work: {facts['scale']} scale, training of {training(files)} steps, training seeds per arm: {seeds}; "
        f"{len(runs[0])} paired episodes of set {facts['episode_set'][:12]}; commit {facts['commit']}. "
        "Paper: as published."
    )
    return facts, note
