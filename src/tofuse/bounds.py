"""Checks of the numbers that parts are configured with; each raises ValueError."""

from __future__ import annotations

import math


def finite(name: str, value: float) -> None:
    """Refuse anything but a finite number."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f"{name} must be a finite number, not {value!r}")


def at_least(name: str, value: float, least: float) -> None:
    """Refuse anything but a finite number of at least `least`."""
    finite(name, value)
    if value < least:
        raise ValueError(f"{name} must be at least {least:g}, not {value!r}")


def above(name: str, value: float, limit: float) -> None:
    """Refuse anything but a finite number above `limit`."""
    finite(name, value)
    if value <= limit:
        raise ValueError(f"{name} must be above {limit:g}, not {value!r}")


def within(name: str, value: float, least: float, most: float) -> None:
    """Refuse anything but a number from `least` to `most`."""
    finite(name, value)
    if not least <= value <= most:
        raise ValueError(f"{name} must be from {least:g} to {most:g}, not {value!r}")


def whole(name: str, value: int, least: int, most: int | None = None) -> None:
    """Refuse anything but a whole number from `least` to `most`."""
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        raise ValueError(f"{name} must be a whole number of at least {least}, not {value!r}")
    if most is not None and value > most:
        raise ValueError(f"{name} must be at most {most}, not {value!r}")
