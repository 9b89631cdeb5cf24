"""Self-calibration: calibration errors that a recording shows are corrected.

Refined views show whether an error of the intrinsics or of the depth distorts the trajectory:
with a correction, they support each other better, and the drift over a loop is smaller
(`refinement.calibration_check`). The recording is then reconstructed again with the correction,
which is kept only if the error bound of the poses is smaller (`quality.pose_accuracy`), although it
includes the uncertainty of the correction. And the correction must be stable: if a calibration
error only happens to explain a drift, the corrected views yield an estimate that undoes much of the
correction.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from tofuse.engine.mapping.config import Config
from tofuse.engine.progress import Progress
from tofuse.engine.quantities import length
from tofuse.engine.refinement import calibration_check
from tofuse.engine.results import Diagnostics, Reason, Reconstruction, SelfCalibration, verdicts
from tofuse.engine.sensor import ERROR_OPTIONS, CameraErrors

# The first estimate uses poses that the error has distorted, the second one does not.
_ROUNDS = 2
Reconstruct = Callable[[Config], Reconstruction]


def self_calibrated(
    initial: Reconstruction, config: Config, reconstruct: Reconstruct, progress: Progress
) -> Reconstruction:
    """Reconstruct again with calibration errors corrected, if the views show any.

    Parameters
    ----------
    initial
        The reconstruction without a correction.
    config
        Its configuration.
    reconstruct
        Reconstructs the recording with a configuration.
    progress
        Receives notes.
    """
    best, applied = initial, CameraErrors()
    for _ in range(_ROUNDS):
        estimate = _estimated_error(best, applied)
        if estimate is None:
            break
        check, error = estimate
        correction = applied.and_then(error)
        progress.note(
            f"views agree better with {in_words(correction)}: reconstructing again with it"
        )
        candidate = reconstruct(replace(config, corrections=(correction, *config.corrections)))
        if not (_is_better(candidate, best) and _is_stable(candidate, check)):
            progress.note("views do not agree better with it: the calibration stays")
            break
        calibration = SelfCalibration(
            correction.focal,
            correction.offset_m,
            correction.center_x,
            correction.center_y,
            correction.distortion,
            {ERROR_OPTIONS[name][0]: s for name, s in correction.sigmas.items() if s},
            (_bound(initial), _bound(candidate)),
        )
        diagnostics = _with_calibration(candidate, correction, calibration)
        best = replace(candidate, diagnostics=diagnostics)
        applied = correction
    return best


def in_words(correction: CameraErrors) -> str:
    """Describe a correction: "a focal length 4.5 % smaller"."""
    return calibration_check.in_words({name: e for name, e in correction.errors.items() if e})


def _estimated_error(
    result: Reconstruction, applied: CameraErrors
) -> tuple[calibration_check.CalibrationCheck, CameraErrors] | None:
    """Return the calibration error that fits the views best; None without an alarm.

    After a correction, also the remainder of the same error without confirmation by a loop.
    """
    check = _check_of(result)
    if check is None:
        return None
    again = any(applied.errors[name] for name in check.unconfirmed) and check.improves
    if not (check.alarm or again):
        return None
    values = {ERROR_OPTIONS[name][0]: error for name, error in check.errors.items()}
    sigmas = {ERROR_OPTIONS[name][1]: check.sigma(name) for name in check.errors}
    try:
        return check, CameraErrors(**values, **sigmas)
    except ValueError:
        return None  # implausibly large


def _is_better(candidate: Reconstruction, current: Reconstruction) -> bool:
    """Whether the candidate loses no poses, and its error bound is smaller.

    Where nothing bounds the poses, surfaces may have slid, and an error of the camera explain that.
    """
    loses = candidate.has_pose.sum() < current.has_pose.sum()
    return not loses and _bound(candidate) < _bound(current)


def _is_stable(candidate: Reconstruction, check: calibration_check.CalibrationCheck) -> bool:
    """Whether the views do not significantly undo the correction that a check proposed."""
    check_after = _check_of(candidate)
    remaining = check_after.errors if check_after is not None and check_after.certain else {}
    return all(error * check.errors.get(name, 0.0) >= 0 for name, error in remaining.items())


def _check_of(result: Reconstruction) -> calibration_check.CalibrationCheck | None:
    refinement = result.diagnostics.refinement
    return None if refinement is None else refinement.calibration_check


def _bound(result: Reconstruction) -> float:
    return result.diagnostics.accuracy.position_m


def _bound_change(before: float, after: float) -> str:
    """Describe the change of the bound."""
    if not np.isfinite([before, after]).all():
        return ""
    new, old = length(after), length(before)
    return f" The bound of the pose error is {new} (95 %) instead of {old}."


def _with_calibration(
    result: Reconstruction, correction: CameraErrors, calibration: SelfCalibration
) -> Diagnostics:
    """Return the diagnostics with the self-calibration and its reason."""
    d = result.diagnostics
    indices = [f.index for f in d.frames]
    text = (
        f"The calibration of the camera was corrected: views agree with {in_words(correction)} "
        f"than stated.{_bound_change(*calibration.bound_m)}"
    )
    reason = Reason("self_calibrated", ((indices[0], indices[-1]),), text)
    return replace(d, calibrated=calibration, reasons=verdicts.ranked([*d.reasons, reason]))
