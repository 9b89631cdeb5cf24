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
    """Bounds of a finite number: from `low` to `high`, both included unless `exclusive`."""

    low: float = -math.inf
    high: float = math.inf
    exclusive: bool = False

    def __contains__(self, value: float) -> bool:
        if isinstance(value, bool) or not isinstance(value, int | float):
            return False
        if self.exclusive:
            return self.low < value < self.high
        return self.low <= value <= self.high and math.isfinite(value)

    def __str__(self) -> str:
        if self.low == -math.inf and self.high == math.inf:
            return "a finite number"
        if self.high == math.inf:
            return f"above {self.low:.10g}" if self.exclusive else f"{self.low:.10g} or more"
        if self.exclusive:
            return f"between {self.low:.10g} and {self.high:.10g}"
        return f"{self.low:.10g} to {self.high:.10g}"


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
        for name, whole, bounds in _declared_bounds(kind):
            value = getattr(self, name)
            if value is None:
                continue
            if whole and not isinstance(value, int):
                raise ValueError(f"{name} must be a whole number, not {value!r}")
            if value not in bounds:
                raise ValueError(f"{name} must be {bounds}, not {value!r}")


@functools.cache
def _declared_bounds(cls: type) -> list[tuple[str, bool, Bounds]]:
    """Names of the fields with bounds, whether they are whole numbers, and the bounds."""
    hints = typing.get_type_hints(cls, include_extras=True)
    return [
        (name, hint.__origin__ in (int, int | None), extra)
        for name, hint in hints.items()
        for extra in getattr(hint, "__metadata__", ())
        if isinstance(extra, Bounds)
    ]
