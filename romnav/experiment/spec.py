"""What is compared: one TOML file per experiment, typed, with errors that a user can act on."""

from __future__ import annotations

import difflib
import json
import tomllib
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args

from pydantic import BaseModel, Field, ValidationError, field_validator, model_validator

from romnav.config import Config, Label, Name, Seed
from romnav.errors import RomnavError
from romnav.parts import Kind
from romnav.report.spec import PAIRED, Entry, TableKind, TableSpec

SCRIPTED = {"oracle": "Oracle", "straight": "Straight"}
"""Arms that need no training, and their labels; every ablation is evaluated beside them."""
DRIVERS = Kind("scripted driver", "romnav.drivers", "romnav.evaluation.rollout:Driver")
RESERVED = {*SCRIPTED, "figures", *(file.stem for file in Path(__file__).with_name("kinds").glob("[!_]*.py"))}
"""Names of other folders beside those of the arms: figures, and one for a kind of stage."""

BODY = {"dynamics", "stair_limits"}
"""What an arm may change of the navigation section that drives the policy of another arm."""

C = TypeVar("C", bound=Config)


class Arm(Config, extra="allow"):
    """One arm: its label, and the scale's settings that it changes, e.g. ``navigation.ppo.gamma = 0.99``."""

    label: Label
    """Name in lists."""
    policy: str | None = None
    """Arm whose policy, trained or scripted, it drives in place of one of its own: on another body, say."""
    driver: Annotated[str, DRIVERS] | None = Field(default=None, exclude_if=lambda driver: driver is None)
    """Scripted driver from outside that it has in place of a policy, e.g. "pkg.mod:Name"."""
    filter: bool = Field(default=False, exclude_if=lambda filter_: not filter_)
    """Whether the safety filter stands between what drives it and its robots, in evaluation; the arm has no policy of
    its own then."""

    @property
    def changes(self) -> dict[str, Any]:
        """Settings that differ from the scale's, nested by section."""
        return self.model_extra or {}

    @property
    def trained(self) -> bool:
        """Whether it has a policy of its own."""
        return not (self.policy or self.driver)


TrialKind = Literal["safety", "deploy"]
"""Experiments that drive arms through scenes, with the safety filter off and on."""


class Declared(Config):
    """Tables of an experiment, complete, with what they need of it."""

    title: str
    labels: dict[str, str]
    tables: dict[str, TableSpec]


_SECTIONS: dict[str, Collection[str]] = {"arms": Arm.model_fields, "tables": TableSpec.model_fields, "scales": ()}
"""Tables of tables in an experiment's file, and what keys these have; those of arms and scales are settings, too."""
_WITHIN = tuple(f"{section}." for section in _SECTIONS)


class Experiment(Config):
    """Arms that are trained alike except for their changes, and evaluated on the same episodes or trials."""

    kind: Literal["ablation", "safety", "deploy"]
    """What is done with the arms."""
    title: Label
    """One line for lists."""
    tables: dict[Name, TableSpec] = Field(default={})
    """Tables to write, by the name of their files; without any, the usual ones. What none of them needs is not run:
    where all are of learning curves, the arms are not evaluated."""
    reference: str = ""
    """Arm that the others are compared with; empty is the first."""
    published: Name | None = None
    """Results to print beside ours: a file under experiments/published/."""
    seeds: tuple[Seed, ...] = Field(default=(0,), min_length=1)
    """Training seeds of every arm."""
    arms: dict[Name, Arm] = Field(min_length=1)
    """Arms by the name of their results folder."""
    scales: dict[str, dict[str, Any]] = Field(default={})
    """Settings that all arms change at a scale, e.g. ``scales.paper.navigation.env.envs = 3072``."""

    @property
    def labels(self) -> dict[str, str]:
        """Label of every arm."""
        return {name: arm.label for name, arm in self.arms.items()}

    @property
    def compared_with(self) -> str:
        """The reference arm."""
        return self.reference or next(iter(self.arms))

    def declared(self, name: str, kinds: Collection[TableKind]) -> Declared:
        """The tables of some kinds, completed; ``name`` is the experiment's."""
        if self.kind != "ablation":
            usual = {name: TableSpec(kind="trials")}
        else:
            usual = {name: TableSpec(bounds=_entries(SCRIPTED))}
            if len(self.arms) > 1:
                usual[f"{name}-contrasts"] = TableSpec(kind="contrasts", bounds=_entries(SCRIPTED))
        tables = {n: self._complete(t) for n, t in (self.tables or usual).items() if t.kind in kinds}
        return Declared(title=self.title, labels=self.labels, tables=tables)

    def _complete(self, table: TableSpec) -> TableSpec:
        if table.kind not in PAIRED:
            return table
        labels = SCRIPTED | self.labels
        reference = table.reference.arm or self.compared_with
        others = [arm for arm in self.arms if table.kind != "contrasts" or arm != reference]

        def labelled(entries: Iterable[Entry], **update: Any) -> tuple[Entry, ...]:
            return tuple(e.model_copy(update={"label": e.label or labels[e.arm], **update}) for e in entries)

        update = {
            "reference": labelled([table.reference.model_copy(update={"arm": reference})])[0],
            "rows": tuple(map(labelled, table.rows or (_entries(others),))),
            "bounds": labelled(table.bounds, competes=False),
        }
        return table.model_copy(update=update)

    def driver(self, arm: str) -> str:
        """The arm whose policy drives ``arm``."""
        return self.arms[arm].policy or arm

    @field_validator("arms")
    @classmethod
    def _free_names(cls, arms: dict[str, Arm]) -> dict[str, Arm]:
        if taken := {*arms} & RESERVED:
            raise ValueError(f"{', '.join(sorted(taken))} cannot be the name of a trained arm")
        for name, arm in arms.items():
            changed = arm.changes.get("navigation", {})
            beside = arm.changes.keys() - {"navigation"}
            if not arm.trained and (beside or not isinstance(changed, dict) or changed.keys() - BODY):
                what = f"drives the policy of {arm.policy}" if arm.policy else f"is driven by {arm.driver}"
                raise ValueError(
                    f"{name} {what}, so it can only change navigation.{' and navigation.'.join(sorted(BODY))}"
                )
            if arm.trained and arm.filter:
                raise ValueError(f'{name}.filter: policies are trained without it; give another arm policy = "{name}"')
            if arm.policy and arm.driver:
                raise ValueError(f"{name} has both a policy and a driver; leave one of them out")
        return arms

    @field_validator("seeds")
    @classmethod
    def _each_once(cls, values: tuple[Any, ...]) -> tuple[Any, ...]:
        if twice := [value for k, value in enumerate(values) if value in values[:k]]:
            raise ValueError(f"{twice[0]} is there twice; name it once")
        return values

    @model_validator(mode="after")
    def _tables_of_its_arms(self) -> Experiment:
        known = {*self.arms, *SCRIPTED}
        if self.reference and self.reference not in known:
            raise ValueError(f"reference: no arm {self.reference}{suggest(self.reference, known)}")
        for name, table in self.tables.items():
            if (table.kind == "trials") != (self.kind != "ablation"):
                raise ValueError(f"tables.{name}.kind: {table.kind} is no table of an experiment of kind {self.kind}")
            for arm in (table.reference.arm, *(entry.arm for entry in table.entries)):
                if arm and arm not in known:
                    raise ValueError(f"tables.{name}: no arm {arm}{suggest(arm, known)}")
            if table.kind == "contrasts" and not table.rows and len(self.arms) < 2:
                raise ValueError(f"tables.{name}: there is one arm; contrasts are of several")
        return self


def _entries(arms: Iterable[str]) -> tuple[Entry, ...]:
    return tuple(Entry(arm=arm) for arm in arms)


def load_experiments(folder: Path) -> tuple[dict[str, Experiment], dict[str, RomnavError]]:
    """Reads every ``<folder>/<name>.toml``.

    Returns:
        Experiments by name, and by name what is wrong with those that are none: the file is invalid, names no scale or
        no arm, or gives an arm or table a name that another one has in another file, which is refused, too, since it
        is not known which of them is meant. They do not take the others down.
    """
    known = {file.stem for file in folder.glob("scales/*.toml")}
    read: dict[str, Experiment] = {}
    wrong: dict[str, RomnavError] = {}
    for file in sorted(folder.glob("*.toml")):
        try:
            data = read_toml(file)
            _refuse_misplaced(data, file)
            read[file.stem] = parse(Experiment, data, file)
        except RomnavError as error:
            wrong[file.stem] = error
    drivers = {*SCRIPTED, *(a for e in read.values() for a, arm in e.arms.items() if not arm.policy)}
    whole = not wrong  # an arm that is missed may be in what could not be read
    experiments: dict[str, Experiment] = {}
    for name, experiment in read.items():
        if fault := _fault(experiment, known, drivers if whole else None) or _clash(name, read):
            wrong[name] = RomnavError(f"{folder / name}.toml: {fault}")
        else:
            experiments[name] = experiment
    return experiments, wrong


def _fault(experiment: Experiment, scales: set[str], drivers: set[str] | None) -> str | None:
    """What of an experiment does not fit scales, and drivers if they are known."""
    for scale in experiment.scales.keys() - scales:
        return f"scales: unknown scale {scale}{suggest(scale, scales)}"
    for name, arm in experiment.arms.items():
        if arm.policy and drivers is not None and arm.policy not in drivers:
            return f"arms.{name}.policy: no arm {arm.policy} that is trained{suggest(arm.policy, drivers)}"
    return None


def _clash(name: str, experiments: Mapping[str, Experiment]) -> str | None:
    """A name that one of the ``experiments`` shares with another, for tables or arms that are not the same."""
    experiment, every = experiments[name], get_args(TableKind)
    tables = experiment.declared(name, every).tables.keys()
    fix = "rename it in the newer of the two files"
    for other_name, other in experiments.items():
        if other_name == name:
            continue
        for arm in experiment.arms:
            if arm in other.arms and _settings(experiment, arm) != _settings(other, arm):
                return f"arms.{arm}: {other_name}.toml has an arm of this name with other settings; {fix}"
        for table in sorted(tables & other.declared(other_name, every).tables.keys()):
            return f"tables.{table}: {other_name}.toml has a table of this name, too; {fix}"
    return None


def _settings(experiment: Experiment, arm: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """What makes an arm what it is."""
    return experiment.arms[arm].model_dump(exclude={"label"}), experiment.scales


def read_toml(file: Path) -> dict[str, Any]:
    """Reads a TOML file.

    Raises:
        RomnavError: It is missing or no TOML.
    """
    try:
        return tomllib.loads(file.read_text("utf-8-sig"))
    except OSError as error:
        raise RomnavError(f"{file}: cannot be read ({(error.strerror or str(error)).lower()})") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise RomnavError(f"{file}: not valid TOML: {error}") from error


def parse(model: type[C], data: Mapping[str, Any], file: Path, prefix: str = "") -> C:
    """Validates ``data`` from ``file``, where it stands under the dotted ``prefix``.

    Raises:
        RomnavError: One line with file, key, what is wrong and the nearest valid name.
    """
    try:
        # JSON, since strict validation of Python objects would refuse TOML's arrays for tuples.
        return model.model_validate_json(json.dumps(data, default=str))
    except ValidationError as invalid:
        error = invalid.errors()[0]
        key = (prefix + ".".join(str(part) for part in error["loc"] if part != "[key]")).rstrip(".")
        raise RomnavError(f"{file}: {_explain(model, key, error)}") from invalid


def _explain(model: type[BaseModel], key: str, error: Any) -> str:
    match error["type"]:
        case "extra_forbidden" if key.startswith(_WITHIN) and error["loc"][-1] in Experiment.model_fields:
            return _misplaced(key, error["loc"][-1])
        case "extra_forbidden":
            return f"unknown key {key}{suggest(error['loc'][-1], _fields(model, error['loc'][:-1]))}"
        case "missing":
            return f"key {key} is missing"
        case "value_error":
            return f"{key}: {error['ctx']['error']}".removeprefix(": ")
        case _:
            return f"key {key}: {error['msg'][0].lower()}{error['msg'][1:]}, not {error['input']!r}"


def _refuse_misplaced(data: Mapping[str, Any], file: Path) -> None:
    for section, own in _SECTIONS.items():
        tables = data.get(section)
        for name, table in tables.items() if isinstance(tables, dict) else ():
            for key in table if isinstance(table, dict) else ():
                if key in Experiment.model_fields and key not in own:
                    raise RomnavError(f"{file}: {_misplaced(f'{section}.{name}.{key}', key)}")


def _misplaced(key: str, name: str) -> str:
    """An error about a key of an experiment that was appended to its file, where TOML takes it for the last table's."""
    return f"unknown key {key}; {name} belongs at the top of the file, above every [arms...] and [tables...]"


def _fields(model: type[BaseModel], path: Iterable[Any]) -> list[str]:
    """Keys of the model that stands at ``path`` in ``model``."""
    for part in path:
        if part in model.model_fields:
            model = _model_in(model.model_fields[part].annotation) or model
    return list(model.model_fields)


def _model_in(annotation: Any) -> type[BaseModel] | None:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next(filter(None, map(_model_in, get_args(annotation))), None)


def suggest(name: str, names: Iterable[str]) -> str:
    """Ends an error about an unknown name: the nearest valid one, otherwise all of them."""
    names = sorted(names)
    near = difflib.get_close_matches(name, names, n=1)
    return f"; did you mean {near[0]}?" if near else f"; there are {', '.join(names) or 'none'}"
