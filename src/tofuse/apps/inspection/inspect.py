"""Inspection of a recording: facts, as text, and faults."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from tofuse.apps.inspection import channels, geometry, motion_checks, pose_convention, times, values
from tofuse.apps.inspection.finding import SEVERITIES, Finding
from tofuse.apps.inspection.sample import Sample
from tofuse.apps.inspection.values import depths_of, valid_fraction
from tofuse.engine import quantities
from tofuse.engine.arrays import Float32
from tofuse.engine.cameras import Pinhole, RayTable
from tofuse.engine.errors import InputError, shown, signals_as_themselves
from tofuse.engine.frames import Frame, RangeFrame, Recording
from tofuse.engine.noise import family_of
from tofuse.engine.quantities import count, percent
from tofuse.formats.recordings import open_recording
from tofuse.formats.rigs import check_one_camera

# Number of sampled pairs of neighbours, for `inspect` and at the start of a run.
PAIRS, QUICK_PAIRS = 8, 4
_MAX_DURATION_S = 1e6  # longer ones are implausible, and perhaps astronomical

Check = Callable[[Sample], Iterable[Finding]]

# In the order in which findings of equal severity are reported.
CHECKS: tuple[Check, ...] = (
    values.check_unit,
    values.check_valid,
    geometry.check_intrinsics,
    geometry.check_kind,
    geometry.check_lens,
    channels.check_mirrored,
    channels.check_color,
    channels.check_delay,
    times.check_times,
    times.check_repeats,
    values.check_wrap,
    values.check_saturation,
    values.check_flying,
    motion_checks.check_motion,
    motion_checks.check_still,
    motion_checks.check_walls,
    motion_checks.check_gravity,
    pose_convention.check_poses,
)


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

    def __repr__(self) -> str:
        found = ", ".join(f"{finding.severity} {finding.code}" for finding in self.findings)
        return f"Inspection of {self.recording.path}: {found or 'no problems found'}"

    @cached_property
    def facts(self) -> dict[str, str]:
        """Facts by name, as text."""
        return _facts(self.recording, self.frames)

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


@signals_as_themselves()
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
        Whether to read fewer frames, as at the start of a run.

    Raises
    ------
    InputError
        If it can't be opened, or no frame of it can be read.
    """
    if not isinstance(recording, Recording):
        recording = open_recording(recording)
    check_one_camera(recording)
    sample = Sample.of(recording, QUICK_PAIRS if quick else PAIRS, turning=turning)
    notes = [*recording.warnings, *_unreadable(sample)]
    if not sample.frames:
        raise InputError("no frame can be read", where=recording.path, remedy=notes[-1])
    # BLAS results depend on its number of threads.
    with threadpool_limits(1):
        findings = [f for check in CHECKS for f in check(sample)]
    findings.sort(key=lambda f: SEVERITIES.index(f.severity))
    return Inspection(recording, tuple(findings), tuple(notes), sample.frames)


def _unreadable(sample: Sample) -> list[str]:
    """The errors of unreadable frames, each once."""
    alike: dict[tuple[str, str | None], list[str]] = {}
    for error in sample.unreadable:
        alike.setdefault((error.problem, error.remedy), []).append(str(error))
    return [
        lines[0] + (f" ({len(lines) - 1} more sampled frames are alike)" if lines[1:] else "")
        for lines in alike.values()
    ]


def _facts(recording: Recording, frames: Sequence[Frame]) -> dict[str, str]:
    """Facts about a recording by name, as text, from a sample of its frames."""
    facts = {
        "recording": recording.path,
        "format": recording.format,
        "frames": str(len(recording)),
        "duration": _time(recording),
        **_view_facts(recording, frames[0]),
        **_depth_facts(frames),
    }
    stored = {"reference poses": recording.reference, "odometry": recording.odometry}
    for name, poses in stored.items():
        known = 0 if poses is None else int(np.isfinite(poses[:, 0, 0]).sum())
        facts[name] = "none" if poses is None else f"for {count(known, 'frame')}"
    return facts | {
        name: shown(str(value))
        for name, value in recording.metadata.items()
        if isinstance(value, str | int | float) and value is not False and name != "depth_kind"
    }


def _time(recording: Recording) -> str:
    times = recording.timestamps
    if len(times) < 2:
        return "a single frame"
    if not recording.has_timestamps:
        return "unknown, as there are no timestamps"
    step, duration = float(np.median(np.diff(times))), float(times[-1] - times[0])
    rate = f", {1 / step:.1f} frames per second" if step > 0 else ""
    return f"{duration:.2f} s{rate}" if abs(duration) < _MAX_DURATION_S else f"{duration:.3g} s"


def _view_facts(recording: Recording, frame: Frame) -> dict[str, str]:
    if not isinstance(frame, RangeFrame):
        return {"views": f"clouds of about {quantities.count(len(frame), 'point')}"}
    camera = frame.camera
    lens = camera.fit if isinstance(camera, RayTable) else camera
    rays = camera.rays()
    width = _angle(rays[rays.shape[0] // 2, :, 0])
    height = _angle(rays[:, rays.shape[1] // 2, 1])
    family = family_of(recording, frame)
    channels = {
        "amplitude": frame.amplitude_image,
        "confidence": frame.confidence_image,
        "colour" if frame.color_registered else "colour (not registered)": frame.color_image,
        "noise": frame.sigma_image,
    }
    facts = {
        "images": f"{camera.width} x {camera.height}, {width:.0f} x {height:.0f} degrees, "
        f"{getattr(camera, 'model', type(camera).__name__)} camera",
        "noise model": family if family != "unknown" else "unknown camera",
    }
    if isinstance(lens, Pinhole):
        focal, centre = f"{lens.fx:.1f}, {lens.fy:.1f}", f"{lens.cx:.1f}, {lens.cy:.1f}"
        facts["intrinsics"] = f"f {focal} pixels, centre {centre}"
    present = [name for name, image in channels.items() if image is not None]
    return facts | {
        "kind of depth": "z" if frame.depth_kind == "z" else "radial range",
        "other images": ", ".join(present) or "none",
    }


def _angle(tangents: Float32) -> float:
    """Angle between the outer edges of a line of pixels with the given centres, degrees."""
    valid = tangents[np.isfinite(tangents)].astype(float)
    if len(valid) < 2:
        return 0.0
    first, last = 1.5 * valid[[0, -1]] - 0.5 * valid[[1, -2]]
    return float(np.degrees(abs(np.arctan(last) - np.arctan(first))))


def _depth_facts(frames: Sequence[Frame]) -> dict[str, str]:
    depths = np.concatenate([depths_of(f) for f in frames])
    if len(depths) == 0:
        return {"depth": "no valid point in the sampled frames"}
    low, median, high = np.percentile(depths, [1, 50, 99])
    boxes = [np.percentile(f.points, [1, 99], axis=0) for f in frames if len(f)]
    extent = np.median(np.ptp(boxes, axis=1), axis=0)
    return {
        "depth": f"{low:.2f} to {high:.2f} m, median {median:.2f} m",
        "extent of a view": " x ".join(f"{size:.2f}" for size in extent) + " m",
        "valid points": percent(valid_fraction(frames)),
    }
