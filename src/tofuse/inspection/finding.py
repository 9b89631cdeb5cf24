"""What a check says of a recording."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

Severity = Literal["severe", "warning", "note"]

SEVERITIES: tuple[Severity, ...] = ("severe", "warning", "note")

# The closed list of codes: the severity that each has, and what it means.
CODES: dict[str, tuple[Severity, str]] = {
    "depth_unit": ("severe", "Depths are such as no ToF camera measures, or have another unit."),
    "range_taken_for_z": ("severe", "Radial ranges are said to be z: walls bulge."),
    "z_taken_for_range": ("severe", "z depths are said to be radial ranges: walls are hollow."),
    "focal_length": ("severe", "The focal length is not that of these images."),
    "other_intrinsics": ("severe", "The intrinsics are of another resolution or another camera."),
    "lens_distortion": ("severe", "Straight walls bend as under a lens that is not corrected."),
    "mirrored": ("severe", "Depth and amplitude or colour are mirrored or turned to each other."),
    "color_unregistered": ("severe", "Colour is said to be registered to depth, and is not."),
    "time_unsorted": ("severe", "Time stamps go back."),
    "phase_wrap": ("severe", "Surfaces beyond the ambiguity are measured as near ones."),
    "little_overlap": ("severe", "Consecutive frames see too little in common."),
    "time_repeated": ("warning", "Time stamps occur more than once."),
    "frames_missing": ("warning", "The time stamps have gaps."),
    "frames_repeated": ("warning", "Images are the same as the one before, to the last pixel."),
    "saturated": ("warning", "Many pixels are saturated."),
    "few_valid": ("warning", "Few pixels hold a measurement."),
    "flying_pixels": ("warning", "Many pixels lie between surfaces, where nothing is."),
    "moving_objects": ("warning", "Something moves in front of the camera."),
    "fast_motion": ("warning", "The camera moves fast for the frame rate."),
    "static": ("note", "The camera does not move."),
    "wall_only": ("note", "Most frames see a single plane, which does not hold the camera."),
}


@dataclass(frozen=True)
class Finding:
    """One fault, with the numbers that show it.

    Attributes
    ----------
    code
        One of `CODES`.
    evidence
        Numbers by name; SI units, shares from 0 to 1, in the names where they are others.
    text
        What is wrong, one sentence.
    remedy
        What to do, one sentence.
    """

    code: str
    text: str
    remedy: str
    evidence: dict[str, float] = field(default_factory=dict)

    @property
    def severity(self) -> Severity:
        """How bad it is: a severe one spoils a model, a note tells what to expect."""
        return CODES[self.code][0]

    def __str__(self) -> str:
        return f"{self.text} {self.remedy}"

    def to_dict(self) -> dict[str, Any]:
        """Return plain data."""
        return {
            "code": self.code,
            "severity": self.severity,
            "text": self.text,
            "remedy": self.remedy,
            "evidence": self.evidence,
        }
