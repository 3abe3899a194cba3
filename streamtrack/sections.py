"""Frozen dataclasses whose values are checked against their annotations when they are made.

An annotation is a number, text, Literal, Enum or a tuple of them, may be ``| None``, and may hold
its range: ``Annotated[int, Range(least=1, most=100)]``. Numbers are finite.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from enum import Enum
from functools import cache
from types import NoneType, UnionType
from typing import Annotated, Any, ClassVar, Literal, get_args, get_origin, get_type_hints

from streamtrack.errors import UsageError, unknown_name


@dataclass(frozen=True, slots=True)
class Range:
    """What a number must be: ``least`` <= number <= ``most``, and more than ``above``."""

    least: float = -math.inf
    most: float = math.inf
    above: float = -math.inf

    def __contains__(self, number: float) -> bool:
        return self.least <= number <= self.most and (number > self.above)

    def __str__(self) -> str:
        bounds = (
            ("greater than", self.above),
            ("at least", self.least),
            ("at most", self.most),
        )
        return " and ".join(f"{word} {bound:g}" for word, bound in bounds if math.isfinite(bound))


@dataclass(frozen=True)
class Section:
    """Base of a section of the settings; ``section`` names it in messages.

    Raises UsageError at construction if a value does not fit its annotation.
    """

    section: ClassVar[str] = ""

    def __post_init__(self) -> None:
        for name, annotation in _annotations(type(self)):  # type: ignore[arg-type]  # classes are hashable
            value = getattr(self, name)
            place = f"{self.section}.{name}" if self.section else name
            checked = _checked(place, value, annotation)
            if checked is not value:
                object.__setattr__(self, name, checked)


@cache
def _annotations(section: type[Section]) -> tuple[tuple[str, Any], ...]:
    hints = get_type_hints(section, include_extras=True)
    return tuple((field.name, hints[field.name]) for field in fields(section))


def _checked(place: str, value: Any, annotation: Any) -> Any:
    """The value as the annotation has it: numbers as float where one is wanted, names as Enum."""
    origin, choices = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        number = _checked(place, value, choices[0])
        if number is not None and number not in choices[1]:
            raise _unfit(place, value, f"must be {choices[1]}")
        return number
    if origin is UnionType:
        inner = next(choice for choice in choices if choice is not NoneType)
        return None if value is None else _checked(place, value, inner)
    if origin is Literal:
        return _one_of(place, value, choices)
    if origin is tuple:
        return _checked_tuple(place, value, choices)
    if issubclass(annotation, Enum):
        return annotation(_one_of(place, value, tuple(item.value for item in annotation)))
    if annotation is float:
        return _finite(place, value)
    if not isinstance(value, annotation) or (annotation is int and isinstance(value, bool)):
        raise _unfit(place, value, f"must be {_KINDS.get(annotation, 'a table')}")
    return value


_KINDS = {int: "a whole number", str: "text", bool: "true or false"}


def _one_of(place: str, value: Any, names: tuple[str, ...]) -> str:
    if isinstance(value, str) and value in names:
        return value
    raise unknown_name(place.rpartition(".")[2], str(value), names)


def _finite(place: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise _unfit(place, value, "must be a finite number")
    return float(value)


def _checked_tuple(place: str, value: Any, kinds: tuple[Any, ...]) -> tuple[Any, ...]:
    if not isinstance(value, list | tuple):
        raise _unfit(place, value, "must be a list")
    if kinds[-1] is Ellipsis:
        kinds = (kinds[0],) * len(value)
    if len(value) != len(kinds):
        raise _unfit(place, value, f"must have {len(kinds)} numbers")
    return tuple(_checked(place, item, kind) for item, kind in zip(value, kinds, strict=True))


def _unfit(place: str, value: Any, reason: str) -> UsageError:
    return UsageError(f"setting {place} = {value!r}: {reason}")
