"""Quantities as text, by one rule in messages, tables and the report."""

from __future__ import annotations

import math

MAX_PROBABILITY = 0.999  # higher ones can't be justified by any model


def length(metres: float | None) -> str:
    """Return a length as text: "2.3 mm", "24 mm", "0.15 m"; a dash if it is unknown."""
    if metres is None or not math.isfinite(metres):
        return "–"
    if abs(metres) >= 0.0995:
        return f"{metres:.2f} m"
    return f"{metres * 1e3:.{int(abs(metres) < 0.00995)}f} mm"


def percent(fraction: float | None) -> str:
    """Return a fraction as text, with a decimal near 0 and 1; 100 % means all."""
    if fraction is None or not math.isfinite(fraction):
        return "–"
    percents = min(100 * fraction, 99.9) if fraction < 1 else 100 * fraction
    return f"{round(percents, int(percents < 10 or percents > 99)):g} %"


def probability(value: float | None) -> str:
    """Return a probability as text, no closer to 0 and 1 than can be justified: "over 99.9 %"."""
    limit = 1 - MAX_PROBABILITY
    if value is None or limit <= value < MAX_PROBABILITY:
        return percent(value)
    return f"below {percent(limit)}" if value < limit else f"over {percent(MAX_PROBABILITY)}"


def one(noun: str) -> str:
    """Return a noun with its indefinite article, by its sound: "an int", "a uint8"."""
    return f"{'an' if noun.lower().startswith(('a', 'e', 'i', 'o', 'nd')) else 'a'} {noun}"


def count(number: int, noun: str) -> str:
    """Return a number of things as text: "1 frame", "12,000 points"."""
    return f"{number:,} {noun}" + ("" if number == 1 else "s")
