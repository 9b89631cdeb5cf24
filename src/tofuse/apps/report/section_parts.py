"""What the recording consists of: sessions, components, and the cameras of a rig."""

from __future__ import annotations

from collections import Counter

from tofuse.apps.report.subject import ROWS, Subject, Values
from tofuse.apps.results import CHANGE_COLORS
from tofuse.engine.geometry import se3


def sessions(s: Subject) -> Values | None:
    """Return the sessions with their frames; None for one recording."""
    records, frames = s.result.sessions, s.result.diagnostics.frames
    if not records:
        return None
    return {
        "rows": [(r, [f.index for f in frames if r.has(f.index)]) for r in records[:ROWS]],
        "most": ROWS,
        "colors": CHANGE_COLORS,
        "met": any(pair.joined and pair.overlap > 0 for pair in s.result.session_pairs),
    }


def components(s: Subject) -> Values | None:
    """Return the numbers of frames of the components; None if there is only one."""
    if len(s.result.components) < 2:
        return None
    counts = Counter(record.component for record in s.result.diagnostics.frames)
    return {"counts": counts, "most": ROWS}


def rig(s: Subject) -> Values | None:
    """Return the rig's cameras with their standard deviations; None for a single camera."""
    calibration = s.extras.rig
    if calibration is None:
        return None
    return {
        "cameras": [
            (camera, *se3.largest_sigmas(camera.covariance).tolist())
            for camera in calibration.cameras
        ],
        "pairs": sorted(calibration.disagreement, key=lambda d: -d.median_m)[:ROWS],
        "unplaced": calibration.unplaced,
    }
