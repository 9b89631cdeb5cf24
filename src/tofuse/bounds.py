"""Bounds of the numbers that parts are configured with; ValueError for others.

Bounds are declared with the fields::

    class Median(Bounded):
        radius: Annotated[int, Bounds(1, 10)] = 1
"""

from __future__ import annotations

import dataclasses
import functools
import math
import typing


@dataclasses.dataclass(frozen=True)
class Bounds:
    """Bounds of a number: from `low` to `high`, both included unless `exclusive`."""

    low: float = -math.inf
    high: float = math.inf
    exclusive: bool = False

    def __contains__(self, value: float) -> bool:
        if self.exclusive:
            return self.low < value < self.high
        return self.low <= value <= self.high

    def __str__(self) -> str:
        if self.high == math.inf:
            return f"above {self.low:g}" if self.exclusive else f"{self.low:g} or more"
        if self.exclusive:
            return f"between {self.low:g} and {self.high:g}"
        return f"{self.low:g} to {self.high:g}"


class Bounded:
    """A dataclass that refuses numbers outside of the bounds that its annotations declare.

    A field is declared as ``Annotated[float, Bounds(0, 1)]``; None is within any bounds.

    Raises
    ------
    ValueError
        With the name of the field, its value and the bounds.
    """

    def __post_init__(self) -> None:
        kind: type = type(self)
        for name, bounds in _declared_bounds(kind):
            value = getattr(self, name)
            if value is not None and value not in bounds:
                raise ValueError(f"{name} is {value}, not {bounds}")


@functools.cache
def _declared_bounds(cls: type) -> list[tuple[str, Bounds]]:
    hints = typing.get_type_hints(cls, include_extras=True)
    return [
        (name, extra)
        for name, hint in hints.items()
        for extra in getattr(hint, "__metadata__", ())
        if isinstance(extra, Bounds)
    ]


def finite(name: str, value: float) -> None:
    """Require a finite number."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f"{name} must be a finite number, not {value!r}")


def at_least(name: str, value: float, minimum: float) -> None:
    """Require a finite number of at least `minimum`."""
    finite(name, value)
    if value < minimum:
        raise ValueError(f"{name} must be at least {minimum:g}, not {value!r}")


def above(name: str, value: float, limit: float) -> None:
    """Require a finite number above `limit`."""
    finite(name, value)
    if value <= limit:
        raise ValueError(f"{name} must be above {limit:g}, not {value!r}")


def within(name: str, value: float, minimum: float, maximum: float) -> None:
    """Require a finite number from `minimum` to `maximum`."""
    finite(name, value)
    if not minimum <= value <= maximum:
        raise ValueError(f"{name} must be from {minimum:g} to {maximum:g}, not {value!r}")


def whole(name: str, value: int, minimum: int, maximum: int | None = None) -> None:
    """Require an integer from `minimum` to `maximum`."""
    if isinstance(value, bool) or not isinstance(value, int) or value < minimum:
        raise ValueError(f"{name} must be a whole number of at least {minimum}, not {value!r}")
    if maximum is not None and value > maximum:
        raise ValueError(f"{name} must be at most {maximum}, not {value!r}")
