"""The verdict: how far a result can be trusted, from checks that need no ground truth."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from tofuse.engine.frames import frame_ranges
from tofuse.engine.results.types import Reason, Verdict

# The closed list of reason codes. "failed" and "degraded" name the verdict each one forces;
# "note" adds information without changing the verdict.
REASONS: dict[str, tuple[str, str]] = {
    "few_poses": ("failed", "Fewer than half of the readable frames are in the main model."),
    "images_disagree": ("failed", "Most overlapping measurements contradict the poses."),
    "object_still": ("failed", "The object of `--object` was not seen to turn."),
    "lost_frames": ("degraded", "Some readable frames have no pose."),
    "disconnected": ("degraded", "The recording consists of disconnected parts."),
    "bridged_gap": ("degraded", "Parts are connected over a gap without overlap."),
    "single_link": ("degraded", "Parts are connected by a single registration."),
    "images_differ": ("degraded", "Overlapping frames agree less than consecutive ones do."),
    "jumped": ("degraded", "A frame's pose jumps away from the predicted motion."),
    "doubtful_poses": ("note", "Frames fit worse than usual for this camera."),
    "faulty_recording": ("degraded", "The recording has a fault (see inspection)."),
    "unobserved_motion": (
        "degraded",
        "Motion was not observable in some direction (degenerate geometry).",
    ),
    "repeated_images": ("degraded", "Images are identical to the preceding one."),
    "implausible_depth": ("degraded", "Depths are implausible for this camera."),
    "weak_registration": (
        "degraded",
        "Frames have too few correspondences, or their registration was not accepted.",
    ),
    "not_converged": ("degraded", "Registrations stopped before they converged."),
    "rig_changed": ("degraded", "A camera of the rig has moved from its pose in rig.json."),
    "uncertain_rig": ("degraded", "The pose errors of the rig's cameras may exceed the tolerance."),
    "inconsistent_poses": ("degraded", "Registrations contradict the poses that were given."),
    "uncertain_poses": ("degraded", "Pose errors may exceed the tolerance."),
    "calibration_alarm": ("degraded", "Loop-closure errors are larger than noise explains."),
    "range_changes": ("degraded", "The range of the camera changes during the recording."),
    "unchecked_drift": ("degraded", "No loop closure checks the accumulated drift."),
    "loop_gap": ("degraded", "Odometry drifted far before a loop was closed."),
    "optimiser_gave_up": ("degraded", "The optimiser stopped before it converged."),
    "unchecked_calibration": ("note", "The recording does not determine the camera's calibration."),
    "self_calibrated": ("note", "The calibration was corrected from the recording itself."),
    "correction_left_out": (
        "note",
        "A correction was not applied: the views do not show the error that it removes.",
    ),
    "open_motion": ("degraded", "So much of the view moves that what stands still is open."),
    "ambiguous_steps": (
        "degraded",
        "The scene repeats itself: other steps between frames, or other places, fit as well.",
    ),
    "moving_objects": ("note", "Objects move in front of the camera; they are excluded."),
    "unstable_depth": ("note", "Depth varies from view to view; it is excluded there."),
    "not_improved": ("note", "The optimiser did not improve on the initial poses."),
    "not_refined": ("note", "Global refinement did not improve consistency and was discarded."),
    "sensor_differs": ("note", "An external sensor is inconsistent with the tracked motion."),
    "bounded_by_odometry": (
        "note",
        "Only recorded odometry, or the device's poses, constrain the motion.",
    ),
    "bounded_by_motion": ("note", "Only the motion before and after constrains some poses."),
    "unreadable_frames": ("note", "Some frames could not be read and were skipped."),
    "single_frame": ("degraded", "Single view: nothing to register, accuracy not assessed."),
    "stood_still": (
        "note",
        "The camera did not move: the model contains only the surfaces of one view.",
    ),
    "no_surface": ("note", "No surface could be reconstructed, only a point cloud."),
    "loop_rejected": ("note", "A loop closure given by the user could not be confirmed."),
}

# What to do about reasons of a code, where there is anything.
_REMEDIES: dict[str, str] = {
    "rig_changed": "Recalibrate the rig: tofuse rig calibrate.",
    "uncertain_rig": "Let the fields of view overlap more, or add a camera, and recalibrate.",
    "few_poses": "Record again with smaller steps between frames, or use every frame.",
    "images_disagree": "Look at the model from above: a wall that appears twice shows where "
    "tracking failed.",
    "object_still": "Keep only the turning object in view, by --max-depth, a box or a mask; "
    "a round object needs texture or colour.",
    "lost_frames": "Move more slowly there, and keep corners and furniture in view.",
    "disconnected": "Record again with overlap between these parts, or use them as separate "
    "models.",
    "bridged_gap": "Distances across the gap are not measured; check one that you know.",
    "single_link": "The link may be a false match with a similar place; record again with more "
    "overlap between these parts.",
    "images_differ": "Surfaces may be doubled there; don't measure distances there.",
    "doubtful_poses": "Check the model there, or record that part again.",
    "weak_registration": "Record with smaller steps between frames, or with more structure in "
    "view.",
    "not_converged": "Use more iterations, or record with smaller steps between frames.",
    "inconsistent_poses": "Use the refined poses, or find what distorted the given ones.",
    "open_motion": "Record again with less that moves in view, or from farther away.",
    "ambiguous_steps": "Record at a higher frame rate or move more slowly, and keep things that "
    "don't repeat in view.",
    "calibration_alarm": "Check the camera's calibration against a known distance and a right "
    "angle.",
    "range_changes": "Let the camera warm up and keep its mode; check the unit of all depth files.",
    "unchecked_calibration": "Turn the camera more, and return to the start.",
    "self_calibrated": "Copy the corrected values into camera.json, and check a known distance.",
    "unobserved_motion": "Keep corners, furniture or texture in view there.",
    "bounded_by_motion": "Keep corners, furniture or texture in view there.",
    "unchecked_drift": "Check a known distance, or return to the start, so that a loop closure can "
    "correct the drift.",
    "loop_gap": "Distances across the loop may be distorted; check one that you know.",
    "optimiser_gave_up": "Allow the optimiser more iterations.",
}

_SEVERITY = {"failed": 0, "degraded": 1, "note": 2}


def verdict_of(reasons: Iterable[Reason]) -> Verdict:
    """Return the verdict that the most severe of the reasons forces; "good" without any."""
    forced = {REASONS[reason.code][0] for reason in reasons}
    if "failed" in forced:
        return "failed"
    return "degraded" if "degraded" in forced else "good"


def ranked(reasons: Sequence[Reason]) -> tuple[Reason, ...]:
    """Return the reasons, each code once: the most severe first, then those of most frames.

    Reasons with the same code are merged: the union of their ranges, and all their texts. Those
    without a remedy get that of their code, if there is any.
    """
    by_code: dict[str, list[Reason]] = {}
    for reason in reasons:
        by_code.setdefault(reason.code, []).append(reason)
    merged = [_merged(group) for group in by_code.values()]
    return tuple(
        sorted(merged, key=lambda r: (_SEVERITY[REASONS[r.code][0]], -frame_ranges.size(r.ranges)))
    )


def _merged(group: Sequence[Reason]) -> Reason:
    code = group[0].code
    ranges = frame_ranges.union(r for reason in group for r in reason.ranges)
    texts, remedies = (
        " ".join(filter(None, dict.fromkeys(each)))
        for each in zip(*((r.text, r.remedy) for r in group), strict=True)
    )
    return Reason(code, ranges, texts, remedies or _REMEDIES.get(code, ""))
