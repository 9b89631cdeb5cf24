"""`card.html`: each quantity over time with its uncertainty, on a page to share."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from tofuse.apps.card.collecting import date
from tofuse.apps.card.making import QUANTITIES, SIGNIFICANCE, Card, dates, series
from tofuse.apps.report import html
from tofuse.engine import quantities
from tofuse.engine.normal import OF_95_PERCENT

# Of the drawing of a quantity, in its units.
_WIDTH, _HEIGHT = 300.0, 110.0
_RANGES_M = (1.0, 2.0, 4.0)  # at which the noise is stated


def write_page(card: Card, path: Path) -> None:
    """Write the page to `path`.

    Raises
    ------
    OutputError
        If the file can't be written; an earlier one is unchanged then.
    """
    html.write_page(
        path,
        "card.html.j2",
        title=card.camera.name or "Camera",
        script="",
        card=card,
        level="failed" if card.changed else "good" if card.drifts else "note",
        date=date,
        name=lambda session: "/".join(Path(session.name).parts[-2:]),
        dates=dates(card),
        facts=[
            ("Results", str(len(card.sessions))),
            ("Dates", dates(card)),
            ("Serial number", card.camera.serial or "–"),
            ("Image size", "{} x {}".format(*card.camera.size)),
        ],
        plots=[_plot(card, name) for name in card.drifts],
        noise=_noise(card),
        ranges=[quantities.length(r) for r in _RANGES_M],
        significance=SIGNIFICANCE,
    )


def _plot(card: Card, name: str) -> dict[str, Any]:
    """The points of a drawing, with 95 % intervals, the mean and the axes."""
    times, values, sigmas = series(card.sessions, name)
    drift, quantity = card.drifts[name], QUANTITIES[name]
    half = OF_95_PERCENT * sigmas
    low, high = float((values - half).min()), float((values + half).max())
    span = float(np.ptp(times))
    x = (0.04 + 0.92 * ((times - times[0]) / span if span else 0.5 + 0 * times)) * _WIDTH

    def y(value: Any) -> Any:
        return np.round(_HEIGHT * (1 - (np.asarray(value) - low) / (high - low)), 1).tolist()

    mean_half = OF_95_PERCENT * drift.sigma
    return {
        "label": quantity.label,
        "unit": quantity.unit,
        "changed": name in card.changed,
        "points": list(zip(np.round(x, 1).tolist(), y(values), y(values - half), y(values + half),
                           strict=True)),
        "mean": y(drift.mean),
        "band": (y(min(drift.mean + mean_half, high)), y(max(drift.mean - mean_half, low))),
        "ends": [quantity.text(end).removesuffix(f" {quantity.unit}") for end in (high, low)],
        "size": (_WIDTH, _HEIGHT),
    }  # fmt: skip


def _noise(card: Card) -> list[tuple[str, ...]]:
    """The noise laws that the results assumed: name, dates, and sigma at some ranges."""
    rows: dict[tuple[str, float, float], list[float]] = {}
    for session in card.sessions:
        if session.noise is not None:
            rows.setdefault(session.noise, []).append(session.time)
    return [
        (
            law[0],
            " to ".join(dict.fromkeys((date(min(times)), date(max(times))))),
            *(quantities.length(law[1] + law[2] * r**2) for r in _RANGES_M),
        )
        for law, times in rows.items()
    ]
