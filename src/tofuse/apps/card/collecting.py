"""The camera of each result: who it is, and what the result states about it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from tofuse.apps.results import folders, reopening, run_json
from tofuse.engine.arrays import Float64
from tofuse.engine.cameras import Pinhole
from tofuse.engine.errors import InputError
from tofuse.engine.frames import RangeFrame, Recording
from tofuse.engine.normal import robust_sigma
from tofuse.engine.refinement import calibration_check
from tofuse.formats.cameras import pinhole_of

# Times in s since 1970 are dates from 2001 on.
_FIRST_DATE = 1e9
# Estimates with a larger sigma, as a fraction of the tolerance, are not determined.
_MAX_SIGMA = 0.8


@dataclass(frozen=True)
class Identity:
    """Which camera it is.

    Attributes
    ----------
    name, serial
        As its recordings state them; empty where they don't.
    size
        (width, height) of its images, pixels.
    """

    name: str
    serial: str
    size: tuple[int, int]

    def __str__(self) -> str:
        name = self.name or "unnamed camera"
        serial = f", serial number {self.serial}" if self.serial else ""
        return f"{name}{serial}, {self.size[0]} x {self.size[1]} pixels"


@dataclass(frozen=True)
class Session:
    """A result of the camera.

    Attributes
    ----------
    name
        Folder of the result.
    time
        Start of its recording, s since 1970.
    by_file
        Whether the time is that of the recording's files, as the frames have no dates.
    values
        Value and sigma of the quantities that it states, by name.
    noise
        The noise law that it assumed: name, and a and b of sigma = a + b r^2; None if it is that of
        the camera or of another channel.
    fault
        Code of a severe fault of its recording, which spoils what it states: it has no values then.
    """

    name: str
    time: float
    by_file: bool
    values: dict[str, tuple[float, float]]
    noise: tuple[str, float, float] | None
    fault: str = ""


def collected(results: Sequence[Path]) -> tuple[Identity, list[Session]]:
    """Read what results of one camera say about it, in the order of their dates.

    Raises
    ------
    InputError
        If a folder is no result of one recording of images, its recording is missing or has
        changed, two are of the same frames, or they are of different cameras.
    """
    identities, sessions = zip(*(_read(folder) for folder in results), strict=True)
    reopening.check_different(results)
    first = identities[0]
    for identity, folder in zip(identities, results, strict=True):
        if identity != first:
            raise InputError(
                f"is of {identity}, and {results[0]} of {first}",
                where=folder,
                remedy="pass the results of one camera, all with the same image size",
            )
    return first, sorted(sessions, key=lambda session: session.time)


def _read(folder: Path) -> tuple[Identity, Session]:
    folders.check_result(folder)
    with run_json.opened(folder) as run:
        parts = list(reopening.stored_recordings(folder, run))
        check = (run.get("refinement") or {}).get("suspicion") or {}
        rms = np.array([frame["rms_m"] for frame in run["frames"] if frame.get("rms_m")])
        estimates = {name: tuple(pair) for name, pair in check.get("estimates", {}).items()}
        severe = [f["code"] for f in run.get("findings", ()) if f["severity"] == "severe"]
    if len(parts) > 1 or run.get("rig"):
        raise InputError(
            "is of several recordings", where=folder, remedy="pass the result of each recording"
        )
    (part,) = parts
    recording = reopening.reopen(part, folder)
    frame = recording.first_readable()
    if not isinstance(frame, RangeFrame):
        raise InputError("is of clouds, which have no camera", where=folder, remedy="leave it out")
    about = recording.metadata
    identity = Identity(
        str(about.get("sensor", "")),
        str(about.get("serial", "")),
        (frame.camera.width, frame.camera.height),
    )
    corrections = {each["part"]: each for each in part.config.get("corrections", [])}
    lens = frame.camera if isinstance(frame.camera, Pinhole) else pinhole_of(frame.camera)
    values = {} if severe else values_of(estimates, corrections, lens, rms)
    time, by_file = _time_of(recording, reopening.locate_recording(part.opening, folder).paths[0])
    return identity, Session(
        str(folder), time, by_file, values, _noise(corrections), "".join(severe[:1])
    )


def values_of(
    estimates: Mapping[str, tuple[float, float]],
    corrections: Mapping[str, Any],
    camera: Pinhole,
    rms_m: Float64,
) -> dict[str, tuple[float, float]]:
    """Return value and sigma of the camera's properties that a result states.

    Parameters
    ----------
    estimates
        Of what was left after its corrections: estimate and sigma by name.
    corrections
        Its corrections by the name of the part, as in `run.json`.
    camera
        As its recording states it.
    rms_m
        (N,) of the alignment of each frame. It counts if other quantities do; another place differs
        as the frames of this one do from each other.
    """
    corrected = corrections.get("camera-errors", {})
    # Value without an error, and its change by a unit of it.
    laws = {
        "focal": (camera.fx, -camera.fx),
        "offset": (0.0, -1.0),  # the correction is added to all ranges
        "center_x": (camera.cx, -camera.fx),
        "center_y": (camera.cy, -camera.fy),
        "distortion": (0.0, 1.0),
    }
    values = {}
    for name, (nominal, factor) in laws.items():
        estimate, sigma = estimates.get(name, (0.0, 0.0))
        error = estimate + float(corrected.get("offset_m" if name == "offset" else name) or 0.0)
        if name == "focal":
            error /= 1 + error  # the true focal length is 1 / (1 + error) of the stated one
        if 0 < sigma < _MAX_SIGMA * calibration_check.TOLERANCES[name]:
            values[name] = nominal + factor * error, abs(factor) * sigma
    strength = corrections.get("multipath", {}).get("strength")
    if strength is not None and strength[1] > 0:
        values["multipath"] = float(strength[0]), float(strength[1])
    spread = robust_sigma(rms_m - np.median(rms_m)) if values and len(rms_m) else 0.0
    if spread > 0:
        values["rms"] = float(np.median(rms_m)), spread
    return values


def _noise(corrections: Mapping[str, Any]) -> tuple[str, float, float] | None:
    model = corrections.get("noise", {}).get("model")
    if model is None:
        return None
    return str(model["name"]), float(model["range"]["a"]), float(model["range"]["b"])


def _time_of(recording: Recording, path: Path) -> tuple[float, bool]:
    start = float(recording.timestamps[0])
    return (start, False) if start > _FIRST_DATE else (path.stat().st_mtime, True)


def date(time: float) -> str:
    """Return a time as a date."""
    return datetime.fromtimestamp(time, UTC).strftime("%Y-%m-%d")
