"""Faults that checks of a recording report."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from tofuse.engine.arrays import Float64

Severity = Literal["severe", "warning", "note"]

SEVERITIES: tuple[Severity, ...] = ("severe", "warning", "note")

# The closed list of codes; docs/inspect.md has their meanings.
CODES: dict[str, Severity] = {
    **dict.fromkeys(
        ("depth_unit", "range_taken_for_z", "z_taken_for_range", "focal_length", "mirrored",
         "other_intrinsics", "lens_distortion", "color_unregistered", "delayed",
         "time_unsorted", "phase_wrap"), "severe"),
    # The effect of the last two is measured by tracking, and decides the verdict.
    **dict.fromkeys(
        ("time_unit", "time_repeated", "frames_missing", "frames_repeated", "saturated",
         "few_valid", "flying_pixels", "some_phase_wrap", "poses_misread", "depth_scale",
         "little_overlap", "fast_motion"),
        "warning"),
    **dict.fromkeys(("static", "wall_only", "upside_down"), "note"),
}  # fmt: skip


@dataclass(frozen=True)
class Finding:
    """One fault, with numeric evidence.

    Attributes
    ----------
    code
        One of `CODES`.
    evidence
        Numbers by name, in SI units, fractions from 0 to 1; other units are in the names.
    text
        The fault, in one sentence.
    remedy
        What to do, in one sentence.
    """

    code: str
    text: str
    remedy: str
    evidence: dict[str, float] = field(default_factory=dict)

    @property
    def severity(self) -> Severity:
        """ "severe" makes a model wrong; "note" states what to expect."""
        return CODES[self.code]

    def __str__(self) -> str:
        return f"{self.text} {self.remedy}"

    def to_dict(self) -> dict[str, Any]:
        """Return plain data."""
        return {"code": self.code, "severity": self.severity} | vars(self)


def is_significant(lead: Float64, minimum: float, sigmas: float) -> bool:
    """Whether the mean of leads (N,) exceeds a minimum, and a number of its standard errors."""
    error = float(lead.std(ddof=1)) / np.sqrt(len(lead))
    return float(lead.mean()) > max(minimum, sigmas * error)
