"""Parts from outside: how they are named, what is checked, and what of them is saved."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Annotated, Protocol

import pytest
from pydantic import Field, ValidationError

from romnav import parts
from romnav.config import Config


class Lamp(Protocol):
    """What the lamps of these tests have to be."""

    watts: float

    def light(self, room: str, hours: float) -> str:
        """Lights."""
        ...


class Base:
    """What the others have to extend."""


LAMPS = parts.Kind("lamp", "romnav.lamps", f"{__name__}:Lamp", builtin=("bulb",))
BASES = parts.Kind("base", "romnav.bases", f"{__name__}:Base", called=False)
NUMBER = itertools.count()

GOOD = """
class Lamp:
    watts = 5.0
    def light(self, room, hours):
        return room
"""


class House(Config):
    """Settings that name parts."""

    lamp: Annotated[str, LAMPS] = "bulb"
    base: Annotated[str, BASES] | None = None
    weights: dict[Annotated[str, LAMPS], float] = Field(default={})


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], str]:
    """Writes a module of a name of its own, which it gives."""
    monkeypatch.syspath_prepend(tmp_path)

    def write(source: str) -> str:
        name = f"part_{next(NUMBER)}"
        (tmp_path / f"{name}.py").write_text(source)
        return name

    return write


def test_a_part_is_saved_with_its_source(module: Callable[[str], str]) -> None:
    one, other = f"{module(GOOD)}:Lamp", f"{module(GOOD + ' # changed')}:Lamp"
    house = House(lamp=one, weights={one: 2.0})
    saved = house.model_dump(mode="json")
    assert saved["lamp"].startswith(f"{one}@")
    assert saved["weights"] == {saved["lamp"]: 2.0}
    assert saved["lamp"].split("@")[1] != LAMPS.stamped(other).split("@")[1]
    assert House.model_validate_json(house.model_dump_json()) == house
    assert LAMPS.load(one).light("kitchen", 1.0) == "kitchen"


def test_what_is_built_in_is_saved_by_its_name_alone() -> None:
    assert House().model_dump(mode="json") == {"lamp": "bulb", "base": None, "weights": {}}


def test_a_package_is_saved_as_a_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    name = f"package_{next(NUMBER)}"
    package = tmp_path / name
    package.mkdir()
    for file, source in {"__init__": "", "lamp": f"from {name}.help import *\n{GOOD}", "help": "x = 1"}.items():
        (package / f"{file}.py").write_text(source)
    before = LAMPS.stamped(f"{name}.lamp:Lamp")
    (package / "help.py").write_text("x = 2")
    parts.digest.cache_clear()
    assert LAMPS.stamped(f"{name}.lamp:Lamp") != before


def test_a_saved_part_whose_code_has_changed_is_refused(module: Callable[[str], str]) -> None:
    name = f"{module(GOOD)}:Lamp"
    with pytest.raises(ValidationError, match=f"lamp {name}: its code is no longer that of 0123456789ab"):
        House(lamp=f"{name}@0123456789ab")


def test_a_file_from_anywhere_imports_nothing(module: Callable[[str], str]) -> None:
    name = f"{module(GOOD)}:Lamp"
    with pytest.raises(ValidationError, match="a file names it, but no experiment"):
        House.model_validate_json(f'{{"lamp": "{name}"}}', context=parts.SAVED)
    house = House(lamp=name)  # an experiment does
    assert House.model_validate_json(house.model_dump_json(), context=parts.SAVED) == house


def test_entry_points_give_short_names(module: Callable[[str], str], monkeypatch: pytest.MonkeyPatch) -> None:
    point = metadata.EntryPoint("torch", f"{module(GOOD)}:Lamp", LAMPS.group)
    monkeypatch.setattr(metadata, "entry_points", lambda group: [point] if group == LAMPS.group else [])
    assert House(lamp="torch").model_dump()["lamp"].startswith("torch@")
    with pytest.raises(ValidationError, match=r"no lamp 'torhc'; there are bulb, torch; one of yours is named as"):
        House(lamp="torhc")


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("x = 1", "has no Lamp"),
        ("class Lamp:\n    def light(self, room, hours): ...", "lacks watts"),
        ("class Lamp:\n    watts = 1.0", r"lacks light\(room, hours\)"),
        ("class Lamp:\n    watts = 1.0\n    def light(self): ...", r"lacks the parameters of light\(room, hours\)"),
        ("class Lamp:\n    def __init__(self, x): ...", "cannot be made without arguments"),
        ("import nowhere_at_all", "No module named 'nowhere_at_all'; install its package"),
    ],
)
def test_what_a_part_lacks_is_named(module: Callable[[str], str], source: str, message: str) -> None:
    name = f"{module(source)}:Lamp"
    with pytest.raises(ValidationError, match=f"lamp {name}: .*{message}"):
        House(lamp=name)


def test_a_class_has_to_extend_its_base(module: Callable[[str], str]) -> None:
    name = f"{module(f'from {__name__} import Base' + chr(10) + 'class Good(Base): ...' + chr(10) + GOOD)}"
    assert House(base=f"{name}:Good").base == f"{name}:Good"
    with pytest.raises(ValidationError, match=f"base {name}:Lamp: lacks the base class Base, see"):
        House(base=f"{name}:Lamp")
