"""The card of a camera: what its results state about it, over time, in words."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from tofuse._version import __version__
from tofuse.apps.card.collecting import Identity, Session, collected, date
from tofuse.apps.card.drift import Drift, drift_of, holm
from tofuse.apps.results import run_json
from tofuse.engine.arrays import Float64
from tofuse.engine.errors import InputError

# Probability that a camera without drift gets a warning.
SIGNIFICANCE = 0.05
# Fewer results can't show a scatter beyond their sigmas, so a trend among them is not tested alone.
_MIN_TREND = 4
# A change of the range that matters to most, and multiples of the results that are thought of.
_WANTED_M, _MANY = 0.005, 200


@dataclass(frozen=True)
class Quantity:
    """A property of a camera: its label, unit, factor into that unit, and decimals."""

    label: str
    unit: str
    factor: float
    digits: int

    def text(self, *values: float | None) -> str:
        """Return a value in SI units as text, or a value and its sigma; a dash for None."""
        if None in values:
            return "–"
        numbers = [f"{self.factor * (v or 0.0):.{self.digits}f}" for v in values]
        return f"{' ± '.join(numbers)} {self.unit}".strip().replace("-", "−")


QUANTITIES = {
    "focal": Quantity("Focal length", "px", 1.0, 2),
    "offset": Quantity("Range offset", "mm", 1e3, 1),
    "center_x": Quantity("Principal point x", "px", 1.0, 2),
    "center_y": Quantity("Principal point y", "px", 1.0, 2),
    "distortion": Quantity("Unstated distortion", "", 1.0, 4),
    "multipath": Quantity("Multipath strength", "", 1.0, 3),
    "rms": Quantity("Noise of alignments", "mm", 1e3, 1),
}


@dataclass(frozen=True)
class Card:
    """What results of one camera say about it.

    Attributes
    ----------
    camera
        Which one it is.
    sessions
        The results, in the order of their dates.
    drifts
        The quantities by name, tested.
    warnings
        What was found, and what limits it, in sentences.
    """

    camera: Identity
    sessions: tuple[Session, ...]
    drifts: dict[str, Drift]
    warnings: tuple[str, ...]

    @property
    def changed(self) -> list[str]:
        """Names of the quantities that drift."""
        return [name for name, drift in self.drifts.items() if drift.p < SIGNIFICANCE]

    @property
    def sentence(self) -> str:
        """The outcome in a sentence."""
        if not self.drifts:
            return "Nothing can be tested: no quantity is stated by two results."
        if self.changed:
            labels = " and ".join(QUANTITIES[name].label.lower() for name in self.changed)
            s = "s" if len(self.changed) == 1 else ""
            if any(self.drifts[name].change is not None for name in self.changed):
                return f"Drift: the {labels} of this camera change{s} with time."
            return f"Drift, or unlike places: the {labels} differ{s} between the results."
        if all(drift.change is None for drift in self.drifts.values()):
            return "No quantity differs between the results by more than its uncertainty."
        return "No drift: no quantity changes with time by more than its uncertainty."

    @property
    def rows(self) -> list[tuple[str, ...]]:
        """The quantities as text: label, mean, scatter, change over the time, p, "changes"."""
        rows: list[tuple[str, ...]] = []
        for name, drift in self.drifts.items():
            quantity = QUANTITIES[name]
            mean = quantity.text(drift.mean, drift.sigma)
            change = quantity.text(drift.change, drift.change_sigma)
            scatter, p = f"{drift.scatter:.1f}", f"{drift.p:.3f}"
            changes = "differs" if drift.change is None else "changes"
            changes = changes if name in self.changed else "–"
            rows.append((quantity.label, mean, scatter, change, p, changes))
        return rows

    def to_dict(self) -> dict[str, Any]:
        """Return the content of `card.json`: SI units, pixels, null where unknown."""
        return run_json.plain(
            {
                "schema": 1,
                "version": __version__,
                "camera": vars(self.camera),
                "significance": SIGNIFICANCE,
                "sessions": [vars(session) for session in self.sessions],
                "quantities": {name: vars(drift) for name, drift in self.drifts.items()},
                "changed": self.changed,
                "warnings": self.warnings,
            }
        )


def make_card(results: Sequence[Path]) -> Card:
    """Collect what results of one camera say about it, and test whether it changes.

    Raises
    ------
    InputError
        If they are of different cameras, or state nothing; see `collected`.
    """
    camera, sessions = collected(results)
    if all(session.fault for session in sessions):
        fault = f"is of a recording with a severe fault ({sessions[0].fault})"
        raise InputError(fault, where=sessions[0].name, remedy="pass results without one")
    if not any(session.values for session in sessions):
        raise InputError(
            "states no estimates of its camera: it is of an older version, or has too few "
            "overlapping views",
            where=results[0],
            remedy="run `tofuse run` again, with more views of the same place",
        )
    return card_of(camera, sessions)


def card_of(camera: Identity, sessions: Sequence[Session]) -> Card:
    """Test whether the quantities of a camera change between sessions, in the order of dates."""
    drifts = {}
    for name in QUANTITIES:
        times, values, sigmas = series(sessions, name)
        if len(values) > 1:
            drifts[name] = drift_of(times, values, sigmas, trend=len(values) >= _MIN_TREND)
    adjusted = holm([drift.p_alone for drift in drifts.values()])
    drifts = {
        name: replace(drift, p=p) for (name, drift), p in zip(drifts.items(), adjusted, strict=True)
    }
    card = Card(camera, tuple(sessions), drifts, ())
    return replace(card, warnings=tuple(_warnings(card)))


def series(sessions: Sequence[Session], name: str) -> tuple[Float64, Float64, Float64]:
    """Return times, values and sigmas (N,) of the results that state a quantity."""
    rows = [(s.time, *s.values[name]) for s in sessions if name in s.values]
    times, values, sigmas = np.array(rows, float).reshape(-1, 3).T
    return times, values, sigmas


def _warnings(card: Card) -> Iterator[str]:
    for name in card.changed:
        yield _words(name, card.drifts[name])
    if {"focal", "offset"} & set(card.changed):
        yield "Focal length and range offset have similar effects: either may be what changes"
    scattered = [
        QUANTITIES[name].label.lower()
        for name, drift in card.drifts.items()
        if name not in card.changed and drift.p_change < SIGNIFICANCE / len(card.drifts)
    ]
    if scattered:
        yield (
            f"Results scatter by more than their sigmas: {', '.join(scattered)}. Scenes differ in "
            "multipath and mixed pixels, so repeat one scene to learn more"
        )
    offset = card.drifts.get("offset")
    if offset is not None and offset.change is not None and "offset" not in card.changed:
        yield _not_found(offset, len(card.drifts))
    if len(card.sessions) < _MIN_TREND:
        yield f"Fewer than {_MIN_TREND} results: their scatter is taken to be twice their sigmas"
    if any(session.by_file for session in card.sessions):
        yield "Some frames have no dates: those of the recordings' files are used"
    if not card.camera.serial:
        yield "The recordings state no serial number: another camera of this name would pass"
    for session in card.sessions:
        if session.fault:
            yield f"{session.name} is left out: its recording has a severe fault ({session.fault})"
    silent = sum(not session.values and not session.fault for session in card.sessions)
    if silent:
        yield f"{silent} of {len(card.sessions)} results state no estimates of the camera"


def _not_found(offset: Drift, tests: int) -> str:
    """Say which change of the ranges would be found, and what would find a smaller one."""
    text = QUANTITIES["offset"].text
    more = next((k for k in range(1, _MANY) if offset.detectable(tests, k) <= _WANTED_M), _MANY)
    found = f"A change of the range offset is found from {text(offset.detectable(tests))} on"
    if more == 1:
        return found
    return (
        f"{found}; {text(_WANTED_M)} would take {'over ' * (more == _MANY)}"
        f"{more * offset.results} results, or a wall at a measured distance"
    )


def _words(name: str, drift: Drift) -> str:
    quantity = QUANTITIES[name]
    change = "the results differ by more than their sigmas"
    if drift.change is not None:
        change = f"{quantity.text(drift.change, drift.change_sigma)} over the time"
    chance = f"{1 / max(drift.p, 1e-6):,.0f}"
    return f"{quantity.label}: {change} (by chance once in {chance} cameras)"


def dates(card: Card) -> str:
    """Return the first and the last date."""
    first, last = (date(session.time) for session in (card.sessions[0], card.sessions[-1]))
    return first if first == last else f"{first} to {last}"
