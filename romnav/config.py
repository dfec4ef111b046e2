"""Base of every configuration type, and the kinds of numbers in them."""

from __future__ import annotations

import re
from typing import Annotated, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

LARGEST = 1e6
"""Beyond any length, time, weight or factor that means something; its square still fits into float32."""

LONGEST_LABEL = 80

T = TypeVar("T")


class Config(BaseModel):
    """Typed, immutable configuration: unknown keys are errors, numbers are finite and not coerced from strings."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=True, allow_inf_nan=False, use_attribute_docstrings=True
    )


def _ordered(values: tuple[T, T]) -> tuple[T, T]:
    low, high = values
    if low > high:  # type: ignore[operator]
        raise ValueError(f"its least value {low} is above its largest {high}; exchange them")
    return values


def name(value: str) -> str:
    """A name of a file or folder that leads nowhere else.

    Raises:
        ValueError: It is none.
    """
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.+-]{0,63}", value):
        shown = value if len(value) <= 40 else f"{value[:40]}..."
        raise ValueError(f"{shown!r} names no file; use up to 64 letters, digits and . _ + -, a letter or digit first")
    return value


def _label(value: str) -> str:
    if not value.isprintable() or not value.strip() or len(value) > LONGEST_LABEL:
        raise ValueError(f"{value[:40]!r} is no label; use one line of 1 to {LONGEST_LABEL} characters")
    return value


Range = Annotated[tuple[T, T], AfterValidator(_ordered)]
"""Least and largest value."""
Number = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
"""Any sign."""
Positive = Annotated[float, Field(gt=0.0, le=LARGEST)]
"""Above zero."""
NonNegative = Annotated[float, Field(ge=0.0, le=LARGEST)]
"""Zero or above."""
NonPositive = Annotated[float, Field(ge=-LARGEST, le=0.0)]
"""Zero or below: the weight of a penalty."""
Share = Annotated[float, Field(ge=0.0, le=1.0)]
"""Part of a whole, or a probability."""
Rate = Annotated[float, Field(gt=0.0, le=1.0)]
"""Learning rate."""
Count = Annotated[int, Field(ge=1, le=2**31 - 1)]
"""At least one."""
Threads = Annotated[int, Field(ge=1, le=1024)]
"""PyTorch threads."""
Width = Annotated[int, Field(ge=1, le=8192)]
"""Neurons or channels of a layer."""
Pixels = Annotated[int, Field(ge=1, le=4096)]
"""Of an image along one side."""
Seed = Annotated[int, Field(ge=0, lt=2**32)]
"""Of random numbers."""
Name = Annotated[str, AfterValidator(name)]
"""Of a file or folder: nothing in it leads elsewhere."""
Label = Annotated[str, AfterValidator(_label)]
"""In a list, table or figure: one line that can be seen."""
