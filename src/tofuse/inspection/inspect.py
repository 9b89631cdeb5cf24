"""Inspection of a recording: facts and faults."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from tofuse.errors import InputError
from tofuse.inspection import channels, facts, focal, geometry, motion_checks, times, values
from tofuse.inspection.finding import SEVERITIES, Finding
from tofuse.inspection.sample import Sample
from tofuse.recordings.frames import Frame
from tofuse.recordings.open import open_recording
from tofuse.recordings.recording import Recording

# Number of sampled pairs of neighbours, for `inspect` and at the start of a run.
PAIRS, QUICK_PAIRS = 8, 4

Check = Callable[[Sample], Iterable[Finding]]

# In the order in which findings of equal severity are reported.
QUICK: tuple[Check, ...] = (
    values.check_unit,
    values.check_valid,
    geometry.check_intrinsics,
    geometry.check_kind,
    geometry.check_lens,
    channels.check_mirrored,
    channels.check_color,
    times.check_times,
    times.check_repeats,
    values.check_wrap,
    values.check_saturation,
    values.check_flying,
    motion_checks.check_motion,
    motion_checks.check_moving_objects,
    motion_checks.check_still,
    motion_checks.check_walls,
)
CHECKS: tuple[Check, ...] = (*QUICK, focal.check_focal)


@dataclass(frozen=True, eq=False)
class Inspection:
    """The facts and faults of a recording.

    Attributes
    ----------
    recording
        The recording.
    findings
        The most severe first.
    notes
        Warnings of the reader, one line each.
    frames
        The frames that were checked.
    """

    recording: Recording
    findings: tuple[Finding, ...]
    notes: tuple[str, ...]
    frames: tuple[Frame, ...]

    @cached_property
    def facts(self) -> dict[str, str]:
        """Facts by name, as text."""
        return facts.facts_of(self.recording, self.frames)

    @property
    def severe(self) -> bool:
        """Whether a finding is severe: a model would be wrong."""
        return any(f.severity == "severe" for f in self.findings)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Notes and findings, one line each."""
        return (*self.notes, *(str(f) for f in self.findings))

    def to_dict(self) -> dict[str, Any]:
        """Return plain data."""
        return {
            "facts": self.facts,
            "findings": [f.to_dict() for f in self.findings],
            "warnings": list(self.warnings),
        }

    def save_sheet(self, path: str | Path) -> Path:
        """Write a contact sheet of some of the frames as a PNG.

        Raises
        ------
        OutputError
            If it can't be written.
        """
        from tofuse.inspection.sheet import write_sheet

        return write_sheet(self, Path(path))


def inspect_recording(
    recording: Recording | str | Path, *, turning: bool = False, quick: bool = False
) -> Inspection:
    """Collect the facts of a recording, and check it for faults.

    Parameters
    ----------
    recording
        As returned by `tofuse.open`, or its path.
    turning
        Whether an object turns in front of a stationary camera: then motion is not checked.
    quick
        Whether to read fewer frames and skip slow checks, as at the start of a run.

    Raises
    ------
    InputError
        If it can't be opened, or no frame of it can be read.
    """
    if not isinstance(recording, Recording):
        recording = open_recording(recording)
    sample = Sample.of(recording, QUICK_PAIRS if quick else PAIRS, turning=turning)
    notes = [*recording.warnings, *(str(error) for error in sample.unreadable)]
    if not sample.frames:
        raise InputError("no frame can be read", where=recording.path, remedy=notes[-1])
    # BLAS results depend on its number of threads.
    with threadpool_limits(1):
        findings = [f for check in (QUICK if quick else CHECKS) for f in check(sample)]
    findings.sort(key=lambda f: SEVERITIES.index(f.severity))
    return Inspection(recording, tuple(findings), tuple(notes), sample.frames)
