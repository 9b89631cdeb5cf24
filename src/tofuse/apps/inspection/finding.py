"""Faults that checks of a recording report."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from tofuse.engine.arrays import Float64

Severity = Literal["severe", "warning", "note"]

SEVERITIES: tuple[Severity, ...] = ("severe", "warning", "note")

# The closed list of codes, with severity and meaning.
CODES: dict[str, tuple[Severity, str]] = {
    "depth_unit": ("severe", "Depths are implausible for a ToF camera, or in another unit."),
    "range_taken_for_z": ("severe", "Radial ranges are declared as z: walls bulge."),
    "z_taken_for_range": ("severe", "z depths are declared as radial ranges: walls are concave."),
    "focal_length": ("severe", "The focal length does not match these images."),
    "other_intrinsics": ("severe", "The intrinsics are of another resolution or another camera."),
    "lens_distortion": ("severe", "Planes are distorted as by an uncorrected lens."),
    "mirrored": (
        "severe",
        "Depth and amplitude or colour are mirrored or rotated relative to each other.",
    ),
    "color_unregistered": ("severe", "Colour is declared as registered to depth, and is not."),
    "time_unsorted": ("severe", "Timestamps decrease."),
    "phase_wrap": ("severe", "Surfaces beyond the ambiguity range appear too close."),
    "time_unit": ("warning", "Intervals of frames are implausible, or in another unit."),
    "time_repeated": ("warning", "Timestamps are repeated."),
    "frames_missing": ("warning", "The timestamps have gaps."),
    "frames_repeated": ("warning", "Images are identical to the previous one."),
    "saturated": ("warning", "Many pixels are saturated."),
    "few_valid": ("warning", "Few pixels are valid."),
    "flying_pixels": ("warning", "Many pixels are between surfaces, at depth edges."),
    # The effect of these is measured by tracking, and decides the verdict.
    "little_overlap": ("warning", "Consecutive frames overlap too little."),
    "moving_objects": ("warning", "Something moves in front of the camera."),
    "fast_motion": ("warning", "The camera moves fast for the frame rate."),
    "static": ("note", "The camera does not move."),
    "wall_only": ("note", "Most frames show a single plane, which does not constrain the camera."),
}


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
        return CODES[self.code][0]

    def __str__(self) -> str:
        return f"{self.text} {self.remedy}"

    def to_dict(self) -> dict[str, Any]:
        """Return plain data."""
        return {"code": self.code, "severity": self.severity} | vars(self)


def is_significant(lead: Float64, minimum: float, sigmas: float) -> bool:
    """Whether the mean of leads (N,) exceeds a minimum, and a number of its standard errors."""
    error = float(lead.std(ddof=1)) / np.sqrt(len(lead))
    return float(lead.mean()) > max(minimum, sigmas * error)
