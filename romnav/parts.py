"""Parts from outside: whatever a setting names as ``pkg.mod:Name``, or by an entry point of an installed package.

A setting that names one is saved with a digest of the part's source (``pkg.mod:Name@digest``). So it enters the keys of
stages, the identity of runs and the names of caches: a part that was changed is another part.
"""

from __future__ import annotations

import hashlib
import inspect
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from importlib import import_module, metadata
from pathlib import Path
from typing import Any

from pydantic import GetCoreSchemaHandler, ValidationInfo
from pydantic_core import CoreSchema, core_schema

SAVED = {"saved": True}
"""Context in which settings are validated that a file from anywhere may have brought: they cause no import."""


@dataclass(frozen=True)
class Kind:
    """A kind of part that may come from outside; the annotation of the settings that name one."""

    noun: str
    """What messages call it."""
    group: str
    """Group of entry points, by which packages give their parts short names."""
    interface: str
    """``pkg.mod:Name`` of the protocol that it has to fulfil, or of the class that it has to extend."""
    builtin: tuple[str, ...] = ()
    """Names of those that are not from outside."""
    called: bool = True
    """Whether a class of this kind makes the part when it is called without arguments; else the class is the part."""

    def load(self, name: str) -> Any:
        """The part that a setting names.

        Raises:
            ValueError: There is none of this name; it lacks something of the interface; its code has changed.
        """
        name, _, saved = name.partition("@")
        target = self._target(name)
        part = _import(f"{self.noun} {name}", target)
        interface = _import("interface", self.interface)
        if saved and saved != digest(target):
            raise ValueError(f"{self.noun} {name}: its code is no longer that of {saved}; restore it, or make it anew")
        if self.called and isinstance(part, type):
            try:
                part = part()
            except TypeError as error:
                raise ValueError(f"{self.noun} {name}: cannot be made without arguments ({error})") from error
        if lacking := _lacking(part, interface):
            raise ValueError(f"{self.noun} {name}: lacks {lacking}, see {self.interface.replace(':', '.')}")
        return part

    def stamped(self, name: str) -> str:
        """The name with the digest of the part's source; one that is not from outside has none."""
        if name in self.builtin:
            return name
        name = name.partition("@")[0]
        return f"{name}@{digest(self._target(name))}"

    def outside(self, name: str) -> bool:
        """Whether a name is that of a part from outside, be it there or not."""
        return ":" in name or name in self._points()

    def _points(self) -> dict[str, str]:
        return {point.name: point.value for point in metadata.entry_points(group=self.group)}

    def _target(self, name: str) -> str:
        if ":" in name:
            return name
        points = self._points()
        if name not in points:
            known = ", ".join([*self.builtin, *sorted(points)])
            there = f"there are {known}; " if known else ""
            raise ValueError(f"no {self.noun} {name!r}; {there}one of yours is named as 'pkg.mod:Name'")
        return points[name]

    def _check(self, name: str, info: ValidationInfo) -> str:
        if name in self.builtin:
            return name
        bare = name.partition("@")[0]
        if info.context is SAVED and self._target(bare).partition(":")[0] not in sys.modules:
            raise ValueError(f"{self.noun} {bare}: a file names it, but no experiment; only experiments bring in code")
        self.load(name)
        return bare

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.with_info_after_validator_function(
            self._check,
            handler(source),
            serialization=core_schema.plain_serializer_function_ser_schema(self.stamped),
        )


def search(folder: Path) -> None:
    """Let settings name modules in ``folder``, too, after all that are installed."""
    if str(folder) not in sys.path:
        sys.path.append(str(folder))


@cache
def digest(target: str) -> str:
    """Digest of the source of ``pkg.mod:Name``: of its whole package, or of the module alone where it is in none."""
    module = import_module(target.partition(":")[0])
    package = sys.modules[module.__name__.partition(".")[0]].__file__
    in_package = package is not None and Path(package).name == "__init__.py"
    files = sorted(Path(str(package)).parent.rglob("*.py")) if in_package else [Path(str(module.__file__))]
    total = hashlib.sha256()
    for file in files:
        total.update(file.read_bytes())
    return total.hexdigest()[:12]


def _import(what: str, target: str) -> Any:
    module, _, name = target.partition(":")
    try:
        return getattr(import_module(module), name)
    except ImportError as error:
        raise ValueError(f"{what}: {error}; install its package, or put the module beside experiments/") from error
    except AttributeError as error:
        raise ValueError(f"{what}: module {module} has no {name or 'name after the colon'}") from error


def _lacking(part: Any, interface: type) -> str | None:
    """What ``part`` has not of what ``interface`` asks for; of a class, what only its instances have is not asked."""
    if not getattr(interface, "_is_protocol", False):
        extends = isinstance(part, type) and issubclass(part, interface)
        return None if extends else f"the base class {interface.__name__}"
    for name, member in _members(interface):
        if not hasattr(part, name) and not (member is None and isinstance(part, type)):
            return f"{name}{_parameters(member)}"
        if inspect.isfunction(member) and not _takes(part, name, member):
            return f"the parameters of {name}{_parameters(member)}"
    return None


def _members(protocol: type) -> Iterator[tuple[str, Any]]:
    """Names that a protocol asks for, with their function or property, or None."""
    for base in protocol.__mro__:
        if getattr(base, "_is_protocol", False) and base.__module__ != "typing":
            yield from ((name, None) for name in inspect.get_annotations(base))
            named = ((name, member) for name, member in vars(base).items())
            yield from ((n, m) for n, m in named if n == "__call__" or (not n.startswith("_") and m is not None))


def _parameters(member: Any) -> str:
    if not inspect.isfunction(member):
        return ""
    return f"({', '.join(list(inspect.signature(member).parameters)[1:])})"


def _takes(part: Any, name: str, member: Any) -> bool:
    function = part if name == "__call__" else getattr(part, name)
    count = len(inspect.signature(member).parameters) - (not isinstance(part, type))
    try:
        inspect.signature(function).bind(*range(count))
    except TypeError:
        return False
    return True
