"""Checks of options of parts; each raises ValueError with the name of the option."""

from __future__ import annotations

import math


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
