"""The verdict: how far the result can be trusted, from checks that never saw the truth."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from tofuse.results.ranges import size, union
from tofuse.results.types import Reason, Verdict

# The closed list of reason codes. "failed" and "degraded" name the verdict each one forces;
# "note" adds information without changing the verdict.
REASONS: dict[str, tuple[str, str]] = {
    "few_poses": ("failed", "Fewer than half of the readable frames are in the main model."),
    "images_disagree": ("failed", "Most overlapping measurements contradict the poses."),
    "lost_frames": ("degraded", "Some readable frames have no pose."),
    "disconnected": ("degraded", "The recording falls into disconnected parts."),
    "bridged_gap": ("degraded", "Parts are connected by extrapolated motion only."),
    "single_link": ("degraded", "Parts are connected by a single registration."),
    "images_differ": ("degraded", "Overlapping frames agree less than consecutive ones do."),
    "jumped": ("degraded", "A frame's pose jumps away from the predicted motion."),
    "doubtful_poses": ("note", "Frames fit worse than this camera's views usually do."),
    "faulty_recording": ("degraded", "The recording has a fault (see inspection)."),
    "unobserved_motion": (
        "degraded",
        "Motion was not observable in some direction (degenerate geometry).",
    ),
    "repeated_images": ("degraded", "Images repeat the one before, to the last pixel."),
    "implausible_depth": ("degraded", "Depths are implausible for this camera."),
    "weak_registration": ("degraded", "Frames have too few correspondences."),
    "not_converged": ("degraded", "Registrations stopped before they converged."),
    "rig_changed": ("degraded", "A camera of the rig is not where its rig.json says."),
    "uncertain_poses": ("degraded", "Poses may be off by more than the tolerance."),
    "calibration_alarm": ("degraded", "Loop-closure errors are larger than noise explains."),
    "unchecked_drift": ("degraded", "No loop closure checks the accumulated drift."),
    "loop_gap": ("degraded", "Odometry drifted far before a loop was closed."),
    "optimiser_gave_up": ("degraded", "The optimiser stopped before it converged."),
    "unchecked_calibration": ("note", "The recording can't check the camera's calibration."),
    "self_calibrated": ("note", "The calibration of the camera was corrected by its own views."),
    "correction_left_out": (
        "note",
        "A correction was not applied, as views do not show its error.",
    ),
    "moving_objects": ("note", "Objects move in front of the camera; they are excluded."),
    "not_improved": ("note", "The optimiser did not improve on the initial poses."),
    "not_refined": ("note", "Global refinement did not improve consistency and was discarded."),
    "sensor_differs": ("note", "An external sensor is inconsistent with the tracked motion."),
    "unreadable_frames": ("note", "Some frames could not be read and were skipped."),
    "single_frame": ("degraded", "Single view: nothing to register, accuracy not assessed."),
    "stood_still": ("note", "The camera never moved: the model is what one view sees."),
    "no_surface": ("note", "No surface could be made, only a cloud."),
    "loop_rejected": ("note", "A loop given by hand could not be confirmed."),
}

# What a person can do about each reason, where there is something to do.
ADVICE: dict[str, str] = {
    "rig_changed": "Recalibrate the rig: tofuse rig calibrate.",
    "few_poses": "Record again with smaller steps between frames, or use every frame.",
    "images_disagree": "Look at the model from above: walls that appear twice show where it broke.",
    "lost_frames": "Move more slowly there, and keep corners and furniture in view.",
    "disconnected": "Record again with overlap between these parts, or keep them as models of "
    "their own.",
    "bridged_gap": "Distances across the gap are not measured; check one that you know.",
    "single_link": "Another place may look alike; record again with more overlap between these "
    "parts.",
    "images_differ": "Surfaces may be doubled there; measure distances elsewhere.",
    "doubtful_poses": "Check the model there, or record that part again.",
    "weak_registration": "Smaller steps between frames, or more structure in view, would help.",
    "not_converged": "More iterations or smaller steps between frames would help.",
    "uncertain_poses": "Come back to these places, or keep corners and texture in view there.",
    "calibration_alarm": "Check the camera's calibration: a known distance, a right angle.",
    "unchecked_calibration": "Turn the camera more, and come back to where you started.",
    "self_calibrated": "Put the corrected values into camera.json, and check a known distance.",
    "unobserved_motion": "Keep corners, furniture or texture in view there.",
    "unchecked_drift": "Come back to where you started, so that a loop can check the path.",
    "loop_gap": "Distances across the loop may be stretched; check one that you know.",
    "optimiser_gave_up": "Allow the optimiser more iterations.",
}

_GRAVITY = {"failed": 0, "degraded": 1, "note": 2}


def verdict_of(reasons: Iterable[Reason]) -> Verdict:
    """Return the verdict that the gravest of the reasons forces."""
    forced = {REASONS[reason.code][0] for reason in reasons}
    if "failed" in forced:
        return "failed"
    return "degraded" if "degraded" in forced else "good"


def ranked(reasons: Sequence[Reason]) -> tuple[Reason, ...]:
    """Return the reasons with each code once: the gravest first, then those of most frames.

    Reasons with the same code become one, with all their ranges and what each of them says.
    """
    by_code: dict[str, list[Reason]] = {}
    for reason in reasons:
        by_code.setdefault(reason.code, []).append(reason)
    merged = [_merged(group) for group in by_code.values()]
    return tuple(sorted(merged, key=lambda r: (_GRAVITY[REASONS[r.code][0]], -size(r.ranges))))


def _merged(group: Sequence[Reason]) -> Reason:
    if len(group) == 1:
        return group[0]
    texts = dict.fromkeys(reason.text for reason in group)
    ranges = union(r for reason in group for r in reason.ranges)
    return Reason(group[0].code, ranges, " ".join(texts))
