"""Settings drawn at random: near their defaults, at the edges of what makes sense, and beyond."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

from hypothesis import strategies as st
from pydantic import BaseModel

from romnav.config import Config
from romnav.errors import RomnavError
from romnav.experiment.spec import parse

FILE = Path("mine.toml")
C = TypeVar("C", bound=Config)


class Begun(Exception):
    """The first iteration is done."""


def stop(*told: Any) -> None:
    """A progress that ends the run."""
    raise Begun


def leaves(config: BaseModel, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Every setting by its dotted name, with its value."""
    for name in type(config).model_fields:
        value = getattr(config, name)
        if isinstance(value, BaseModel):
            yield from leaves(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value


def nested(key: str, value: Any, within: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """The sections ``within`` with one setting of another value."""
    whole: dict[str, Any] = copy.deepcopy(dict(within or {}))
    *sections, name = key.split(".")
    below = whole
    for section in sections:
        below = below.setdefault(section, {})
    below[name] = value
    return whole


def small(default: Any) -> st.SearchStrategy[Any]:
    """Values that a first iteration takes no time for, and some that make no sense."""
    if isinstance(default, tuple):
        return st.lists(small(default[0]), max_size=len(default) + 1)
    if isinstance(default, bool):
        return st.booleans()
    if isinstance(default, int) or default is None:
        return st.sampled_from([-1, 0, 1, 2, 3, 5, 2**40])
    if isinstance(default, float):
        return st.sampled_from([-1.0, 0.0, 1e-6, 0.1, 0.5, 1.0, 2.0, 100.0, 1e5, 1e7, float("nan")])
    return st.just(default)


def try_settings(model: type[C], tiny: Mapping[str, Any], begin: Callable[[C], Any], draw: Callable[..., Any]) -> str:
    """Changes some of the ``tiny`` settings of a ``model`` and begins a run: what it is refused for, or nothing.

    Args:
        model: Of the settings.
        tiny: Those with which a run takes no time.
        begin: Runs the first iteration and then calls `stop`.
        draw: Hypothesis' draw of a value.
    """
    settings = dict(leaves(parse(model, tiny, FILE)))
    changed = dict(tiny)
    for key in draw(st.lists(st.sampled_from(sorted(settings)), min_size=1, max_size=3, unique=True)):
        changed = nested(key, draw(small(settings[key]), label=key), changed)
    try:
        begin(parse(model, changed, FILE))
    except RomnavError as refused:
        return str(refused)
    except Begun:
        return ""
    raise AssertionError("neither begun nor refused")
