"""Tables as an experiment's file declares them, and published results to print beside ours."""

from __future__ import annotations

import re
from typing import Any, Literal

from pydantic import Field, field_serializer, field_validator, model_validator

from romnav.config import Config
from romnav.evaluation.spec import METRICS

TableKind = Literal["performance", "success", "failures", "contrasts", "curves", "trials", "rewards"]
_CHOICES: dict[TableKind, set[str]] = {"curves": {"kind", "caption"}, "trials": {"kind"}, "rewards": {"kind"}}
"""What can be chosen of tables that are no lists of metrics."""
PAIRED: frozenset[TableKind] = frozenset({"performance", "success", "failures", "contrasts"})
"""Kinds that are made of paired episodes."""


class Entry(Config):
    """An arm in a table; a name alone stands for the arm with its own label."""

    arm: str
    """Name of the arm."""
    label: str = ""
    """What the table calls it; empty is the arm's own label."""
    competes: bool = True
    """Whether it can be the best of a column."""

    @model_validator(mode="before")
    @classmethod
    def _named(cls, data: Any) -> Any:
        return {"arm": data} if isinstance(data, str) else data


class Column(Config):
    """A column of a table; the name of a metric alone stands for it as it is usually shown."""

    metric: str
    """A metric of `romnav list metrics`, or one from outside as "pkg.mod:Name", over all episodes or those of a level:
    "sr_120", "sr_120_cross"."""
    header: str = ""
    """Text above it; empty is the metric's label with level and unit."""
    bold: bool = True
    """Whether its best value is marked."""

    @model_validator(mode="before")
    @classmethod
    def _named(cls, data: Any) -> Any:
        return {"metric": data} if isinstance(data, str) else data

    @property
    def outside(self) -> str | None:
        """Name of the metric if it is from outside, without the level."""
        name = re.sub("_(same|cross)$", "", self.metric)
        return name if METRICS.outside(name) else None

    @field_validator("metric")
    @classmethod
    def _there(cls, metric: str) -> str:
        if name := cls.model_construct(metric=metric).outside:
            METRICS.load(name)
        return metric

    @field_serializer("metric")
    def _with_its_source(self, metric: str) -> str:
        return f"{metric} {METRICS.stamped(self.outside)}" if self.outside else metric


class TableSpec(Config):
    """A table of an experiment. Everything can be left out but what is not to be as usual."""

    kind: TableKind = "performance"
    """What it shows: metrics per arm (performance; success or failures by level), differences of each arm to the
    reference (contrasts), where training ends (curves), trials in scenes with the safety filter off and on, or the
    weights of the reward."""
    caption: str = ""
    """What stands above it, before what it is made of; empty is the experiment's title with the metrics' meaning."""
    reference: Entry = Entry(arm="")
    """Arm from which contrasts subtract the others; empty is the experiment's."""
    rows: tuple[tuple[Entry, ...], ...] = ()
    """Arms from top to bottom, in blocks if there are several; none is every arm. Not evaluated ones are dashes."""
    bounds: tuple[Entry, ...] = ()
    """Arms below them that do not compete, shown where they are evaluated."""
    columns: tuple[Column, ...] = ()
    """Metrics from left to right; none is those of the kind."""

    @field_validator("rows", mode="before")
    @classmethod
    def _blocks(cls, rows: Any) -> Any:
        if not isinstance(rows, list):
            return rows
        blocks = rows if any(isinstance(row, list) for row in rows) else [rows]
        return tuple(tuple(block) if isinstance(block, list) else block for block in blocks if block)

    @model_validator(mode="after")
    def _of_its_kind(self) -> TableSpec:
        if self.kind in _CHOICES and (fixed := self.model_fields_set - _CHOICES[self.kind]):
            raise ValueError(f"a table of kind {self.kind} has no {min(fixed)} to choose")
        return self

    @property
    def entries(self) -> tuple[Entry, ...]:
        """Every arm of the table."""
        return (*(entry for block in self.rows for entry in block), *self.bounds)


class Difference(Config):
    """A published difference; "15.2†" stands for one whose interval excludes zero."""

    diff: float
    """Percentage points, or the metric's unit."""
    significant: bool = False
    """Whether its 95 % interval excludes zero."""

    @model_validator(mode="before")
    @classmethod
    def _short(cls, data: Any) -> Any:
        if isinstance(data, int | float):
            return {"diff": data}
        if isinstance(data, str) and data.endswith("†"):
            return {"diff": float(data.removesuffix("†")), "significant": True}
        return data


class Outcome(Config):
    """Published trials of a scene, the safety filter off or on."""

    successes: int
    """Of ten trials."""
    collisions: int
    """Of ten trials."""
    time: float
    """Mean time to goal, s."""
    time_std: float
    """Its standard deviation, s."""


class Published(Config):
    """Results of a publication, by the names that arms and metrics have here."""

    title: str
    """What tables call it."""
    arms: dict[str, dict[str, float]] = Field(default={})
    """Arm to metric to value."""
    contrasts: dict[str, dict[str, dict[str, Difference]]] = Field(default={})
    """Reference arm to the arm that is subtracted to metric to difference."""
    safety: dict[str, dict[Literal["off", "on"], Outcome]] = Field(default={})
    """Set of obstacles to filter to trials."""
    deploy: dict[str, float] = Field(default={})
    """Deployment to length of its path, m."""
