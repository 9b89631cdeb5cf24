"""What a recording is: the facts that decide whether a reconstruction can work."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofuse.errors import InputError, UnreadableFrameError
from tofuse.recordings.frames import Frame, RangeFrame
from tofuse.recordings.recording import Recording

_SAMPLE = 9

# Depths of indoor ToF recordings; outside them the unit is probably wrong.
_NEAR_M, _FAR_M = 0.1, 20.0
_FEW_VALID = 0.1


@dataclass(frozen=True)
class Inspection:
    """Facts by name, for people, and warnings, one line each."""

    facts: dict[str, str]
    warnings: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return plain data."""
        return {"facts": self.facts, "warnings": list(self.warnings)}


def inspect_recording(recording: Recording) -> Inspection:
    """Look at up to nine evenly spaced frames of a recording.

    Raises
    ------
    InputError
        If none of them can be read.
    """
    sample = recording.sample(_SAMPLE)
    frames = [item for item in sample if not isinstance(item, UnreadableFrameError)]
    warnings = list(recording.warnings)
    warnings += [str(item) for item in sample if isinstance(item, UnreadableFrameError)]
    if not frames:
        raise InputError("no frame can be read", where=recording.path, remedy=warnings[-1])
    facts = {
        "recording": recording.path,
        "format": recording.format,
        "frames": str(len(recording)),
        "time": _time(recording.timestamps),
        **_view_facts(frames[0]),
        **_depth_facts(frames),
        "reference poses": _share(recording.reference),
        "odometry": _share(recording.odometry),
    }
    facts |= {
        name: str(value)
        for name, value in recording.metadata.items()
        if isinstance(value, str | int | float)
    }
    return Inspection(facts, tuple(warnings + _depth_warnings(frames)))


def _time(times: NDArray[np.float64]) -> str:
    if len(times) < 2:
        return "a single moment"
    step = float(np.median(np.diff(times)))
    rate = f", {1 / step:.1f} frames a second" if step > 0 else ""
    return f"{times[-1] - times[0]:.2f} s{rate}"


def _view_facts(frame: Frame) -> dict[str, str]:
    if not isinstance(frame, RangeFrame):
        return {"views": f"clouds of about {len(frame)} points"}
    rays = frame.camera.rays()
    x, y = (
        np.degrees(np.arctan(rays[rays.shape[0] // 2, :, 0])),
        np.degrees(np.arctan(rays[:, rays.shape[1] // 2, 1])),
    )
    wide, high = np.nanmax(x) - np.nanmin(x), np.nanmax(y) - np.nanmin(y)
    model = getattr(frame.camera, "model", type(frame.camera).__name__)
    also = [
        name
        for name, image in (
            ("amplitude", frame.amplitude_image),
            ("confidence", frame.confidence_image),
            ("colour", frame.color_image),
        )
        if image is not None
    ]
    return {
        "images": f"{frame.camera.width} x {frame.camera.height}, {wide:.0f} x {high:.0f} degrees, "
        f"{model} camera",
        "depth is": "z" if frame.depth_kind == "z" else "radial range",
        "with": ", ".join(also) or "nothing but depth",
    }


def _depths(frame: Frame) -> NDArray[np.float32]:
    if isinstance(frame, RangeFrame):
        return frame.depth[frame.valid]
    return np.linalg.norm(frame.points - frame.origin.astype(np.float32), axis=1)


def _depth_facts(frames: list[Frame]) -> dict[str, str]:
    depths = np.concatenate([_depths(f) for f in frames])
    valid = np.mean([len(f) / max(f.valid.size, 1) for f in frames])
    if len(depths) == 0:
        return {"depth": "no valid point in the frames looked at"}
    low, middle, high = np.percentile(depths, [1, 50, 99])
    return {
        "depth": f"{low:.2f} to {high:.2f} m, median {middle:.2f} m",
        "valid points": f"{valid:.0%}",
    }


def _depth_warnings(frames: list[Frame]) -> list[str]:
    depths = np.concatenate([_depths(f) for f in frames])
    if len(depths) == 0:
        return ["no valid point in the frames looked at: is the depth unit right?"]
    out = []
    middle = float(np.median(depths))
    if not _NEAR_M <= middle <= _FAR_M:
        out.append(
            f"the median depth is {middle:.3g} m, which a ToF camera hardly measures: "
            "check depth_unit_m"
        )
    valid = float(np.mean([len(f) / max(f.valid.size, 1) for f in frames]))
    if valid < _FEW_VALID:
        out.append(f"only {valid:.1%} of the pixels are valid")
    return out


def _share(poses: NDArray[np.float64] | None) -> str:
    if poses is None:
        return "none"
    return f"for {int(np.isfinite(poses[:, 0, 0]).sum())} frames"
