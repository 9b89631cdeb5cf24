"""The values that parts may be configured with; ValueError for others.

They are declared with the fields::

    class Median(Bounded):
        radius: Annotated[int, Bounds(1, 10)] = 1
        border: Literal["keep", "remove"] = "keep"
        channels: Annotated[tuple[str, ...], NotEmpty()] = ("depth",)
"""

from __future__ import annotations

import dataclasses
import functools
import math
import typing
from collections.abc import Sized


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
        return self.low <= value <= self.high and abs(value) < math.inf

    def __str__(self) -> str:
        if self.low == -math.inf and self.high == math.inf:
            return "a finite number"
        if self.high == math.inf:
            return f"above {self.low:.10g}" if self.exclusive else f"{self.low:.10g} or more"
        if self.exclusive:
            return f"between {self.low:.10g} and {self.high:.10g}"
        return f"{self.low:.10g} to {self.high:.10g}"


class NotEmpty:
    """At least one item, or character."""

    def __contains__(self, value: Sized) -> bool:
        return len(value) > 0

    def __str__(self) -> str:
        return "non-empty"


class _Choices(tuple[object, ...]):
    """The values of a `Literal`."""

    def __str__(self) -> str:
        return f"one of {', '.join(map(str, self))}"


class Bounded:
    """A dataclass that rejects values outside those that its annotations declare.

    A number is declared as ``Annotated[float, Bounds(0, 1)]``, where None is within any bounds, a
    choice as ``Literal``, a tuple or text with content as ``Annotated[str, NotEmpty()]``.

    Raises
    ------
    ValueError
        With the name of the field, its value and what is allowed.
    """

    def __post_init__(self) -> None:
        cls: type = type(self)
        for name, is_integer, allowed in _declared(cls):
            value = getattr(self, name)
            if isinstance(allowed, Bounds) and value is None:
                continue
            if is_integer and not isinstance(value, int):
                raise ValueError(f"{name} must be a whole number, not {value!r}")
            if value not in allowed:
                raise ValueError(f"{name} must be {allowed}, not {value!r}")


@functools.cache
def _declared(cls: type) -> list[tuple[str, bool, Bounds | NotEmpty | _Choices]]:
    """Names of the restricted fields, whether they are whole numbers, and what is allowed."""
    restrictions: list[tuple[str, bool, Bounds | NotEmpty | _Choices]] = []
    for name, hint in typing.get_type_hints(cls, include_extras=True).items():
        if typing.get_origin(hint) is typing.Literal:
            restrictions.append((name, False, _Choices(typing.get_args(hint))))
        restrictions += [
            (name, hint.__origin__ in (int, int | None), extra)
            for extra in getattr(hint, "__metadata__", ())
            if isinstance(extra, Bounds | NotEmpty)
        ]
    return restrictions
