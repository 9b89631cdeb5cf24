"""Lengths and fractions as text, by one rule in messages, tables and the report."""

from __future__ import annotations

import math


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
