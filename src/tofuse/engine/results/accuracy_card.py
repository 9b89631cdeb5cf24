"""The accuracy card: the accuracy of a result in one line."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tofuse.engine.frames import frame_ranges
from tofuse.engine.quality import pose_accuracy
from tofuse.engine.quantities import count, length
from tofuse.engine.results.checks import TOLERANCE_RAD
from tofuse.engine.results.types import Diagnostics, Reconstruction
from tofuse.engine.results.verdicts import ranked

SEPARATOR = " · "


def card(result: Reconstruction) -> list[str]:
    """Return the parts of the line: accuracy, coverage, the weakest frame, how to improve it."""
    d = result.diagnostics
    parts = [bound(d.accuracy, result.cloud.diagonal_m)]
    readable = sum(f.status != "skipped" for f in d.frames)
    loops = count(sum(p.accepted for p in d.loops), "loop")
    parts.append(f"{int(result.has_pose.sum())} of {readable} frames, {loops}")
    if weakest := weakest_frame(d.accuracy):
        parts.append(f"weakest: {weakest}")
    text, ranges = advice(d)
    if text:
        where = f" ({frame_ranges.in_words(ranges)})" if ranges else ""
        parts.append(f"to improve: {text[0].lower()}{text[1:].rstrip('.')}{where}")
    return parts


def advice(d: Diagnostics) -> tuple[str, Sequence[frame_ranges.Range]]:
    """Return advice unless the result is good, and the frames that it is about, if not all.

    It is for the most severe reason, or for one that may cause all others.
    """
    by_code = {r.code: r for r in ranked(d.reasons) if r.remedy}
    if d.verdict == "good":
        return "", ()
    if any(r.code == "faulty_recording" for r in d.reasons):
        return "Correct the input as the inspection proposes.", ()
    reason = by_code.get("calibration_alarm") or next(iter(by_code.values()), None)
    if reason is None:
        return "", ()
    concerns_all = frame_ranges.size(reason.ranges) >= len(d.frames)
    return reason.remedy, () if concerns_all else reason.ranges


def bound(accuracy: pose_accuracy.Accuracy, diagonal_m: float) -> str:
    """Return the accuracy of the poses as text: "±24 mm (95 %) over 6.2 m, 0.4 %".

    With the bound of the orientations where that exceeds its tolerance: "±24 mm and 3.1° (95 %)".

    Parameters
    ----------
    accuracy
        The accuracy.
    diagonal_m
        Diagonal of the model, m.
    """
    if not accuracy.assessed:
        return "accuracy not assessed"
    if not np.isfinite(accuracy.position_m):
        return f"accuracy not bounded over {_extent(diagonal_m)}"
    turned = ""
    if TOLERANCE_RAD < accuracy.rotation_rad < np.inf:
        turned = f" and {np.degrees(accuracy.rotation_rad):.2g}\N{DEGREE SIGN}"
    return (
        f"±{length(accuracy.position_m)}{turned} (95 %) over {_extent(diagonal_m)}, "
        f"{100 * accuracy.relative:.2g} %"
    )


def _extent(metres: float) -> str:
    """Return the size of a model as text: three digits, and no exponent."""
    return f"{metres:.0f} m" if metres >= 100 else f"{metres:.3g} m"


def weakest_frame(accuracy: pose_accuracy.Accuracy) -> str:
    """Return the frames with the largest pose error, and that error; empty if not assessed."""
    if accuracy.unbounded:
        ranges = frame_ranges.runs_of(
            range(accuracy.unbounded[0], accuracy.unbounded[-1] + 1), accuracy.unbounded
        )
        return f"{frame_ranges.in_words(ranges)}, not bounded"
    if accuracy.worst is None:
        return ""
    return f"frame {accuracy.worst.frame}, {length(accuracy.worst.position_m)}"
