"""Whatever the settings say: refused by its key, or the first iteration runs."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pydantic import BaseModel

from romnav.errors import RomnavError
from romnav.experiment.spec import parse
from romnav.navigation.spec import NavigationSpec
from romnav.navigation.train import train
from romnav.world.world import World

from .conftest import FakePerception

TINY = {
    "env": {"envs": 4, "duration": 4.0},
    "policy": {"attention": 8, "heads": 4, "queries": 2, "recurrent": 8, "hidden": 8, "critic": [8]},
    "ppo": {"steps": 3, "epochs": 1, "minibatches": 2},
}
DEAR = ("corruption.", "encoder.pretrained")
"""Settings of what stands in for the sensors."""
WITHIN = 5.0
"""For an answer, s of processor time."""


class Begun(Exception):
    """The first iteration is done."""


def leaves(config: BaseModel, prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name in type(config).model_fields:
        value = getattr(config, name)
        if isinstance(value, BaseModel):
            yield from leaves(value, f"{prefix}{name}.")
        elif not f"{prefix}{name}".startswith(DEAR):
            yield prefix + name, value


SETTINGS = dict(leaves(parse(NavigationSpec, TINY, Path("tiny.toml"))))


def values(default: Any) -> st.SearchStrategy[Any]:
    if isinstance(default, tuple):
        return st.lists(values(default[0]), max_size=3)
    if isinstance(default, bool):
        return st.booleans()
    if isinstance(default, int) or default is None:
        return st.sampled_from([-1, 0, 1, 2, 3, 5, 2**40])
    if isinstance(default, float):
        return st.sampled_from([-1.0, 0.0, 1e-6, 0.1, 0.5, 1.0, 2.0, 100.0, 1e5, 1e7, float("nan")])
    return st.just(default)


@pytest.mark.filterwarnings("ignore")
@settings(deadline=None, max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_any_settings_are_refused_by_a_key_or_their_first_iteration_runs(
    world: World, tmp_path: Path, data: st.DataObject
) -> None:
    changed: dict[str, Any] = {section: dict(content) for section, content in TINY.items()}
    keys = data.draw(st.lists(st.sampled_from(sorted(SETTINGS)), min_size=1, max_size=3, unique=True))
    for key in keys:
        *sections, name = key.split(".")
        below = changed
        for section in sections:
            below = below.setdefault(section, {})
        below[name] = data.draw(values(SETTINGS[key]), label=key)

    def stop(*told: Any) -> None:
        raise Begun

    begun = time.process_time()
    message = "mine.toml: "
    try:
        spec = parse(NavigationSpec, changed, Path("mine.toml"))
        train(spec, world, FakePerception(), tmp_path, 0, resume=False, progress=stop)
    except RomnavError as refused:
        message = str(refused)
    except Begun:
        pass
    assert message.startswith(("mine.toml: ", str(tmp_path)))
    assert "\n" not in message
    assert time.process_time() - begun < WITHIN
