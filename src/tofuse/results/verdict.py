"""The verdict: how far the result can be trusted, from checks that never saw the truth."""

from __future__ import annotations

from collections.abc import Sequence

from tofuse.results.types import Reason, Verdict

# The closed list of reason codes. "failed" and "degraded" name the verdict each one forces;
# "note" tells something without changing the verdict.
REASONS: dict[str, tuple[str, str]] = {
    "few_poses": ("failed", "Fewer than half of the readable frames have a pose."),
    "images_disagree": ("failed", "Most of what the images saw contradicts the estimated poses."),
    "lost_frames": ("degraded", "Some readable frames have no pose."),
    "images_differ": ("degraded", "Images that overlap do not agree as well as neighbours do."),
    "jumped": ("degraded", "A frame was found far from where the motion led."),
    "faulty_recording": ("degraded", "The recording itself is wrong, by what its frames show."),
    "unobserved_motion": ("degraded", "Often the data did not hold the camera in every direction."),
    "repeated_images": ("degraded", "Images were repeated, to the last pixel."),
    "implausible_depth": ("degraded", "Depths are not such as this camera measures."),
    "weak_registration": ("degraded", "Neighbouring frames had few points in common."),
    "not_converged": ("degraded", "Registrations stopped before they settled."),
    "uncertain_poses": ("degraded", "What was measured holds poses too loosely."),
    "calibration_alarm": ("degraded", "Loops miss by more than noise explains."),
    "unchecked_drift": ("degraded", "No loop checks how much error has built up."),
    "loop_gap": ("degraded", "Closing a loop moved the cameras far; the path bends to fit."),
    "optimiser_gave_up": ("degraded", "The optimiser ran out of iterations before it settled."),
    "not_improved": ("note", "The optimiser found nothing better than what it was given."),
    "not_refined": ("note", "Refining all views together made them agree worse."),
    "sensor_differs": ("note", "A sensor beside the camera does not fit what was tracked."),
    "uncertain_frames": ("note", "Few frames are held more loosely than the others."),
    "unreadable_frames": ("note", "Some frames could not be read and were skipped."),
    "single_frame": ("note", "Only one frame has a pose: there was nothing to register."),
    "stood_still": ("note", "The camera never moved: the model is what one view sees."),
    "no_surface": ("note", "No surface could be made, only a cloud."),
    "loop_rejected": ("note", "A loop given by hand could not be confirmed."),
}


def verdict_of(reasons: Sequence[Reason]) -> Verdict:
    """Return the verdict that the gravest of the reasons forces."""
    forced = {REASONS[reason.code][0] for reason in reasons}
    if "failed" in forced:
        return "failed"
    return "degraded" if "degraded" in forced else "good"
