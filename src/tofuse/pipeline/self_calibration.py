"""Self-calibration: calibration errors that a recording shows are corrected.

Refined views show whether an error of the focal length or the depth offset distorts the trajectory:
corrected, they support each other better, and the drift over a loop is smaller
(`posegraph.calibration_check`). The recording is then reconstructed again with the correction,
which stays only if the stated bound of the poses is smaller (`posegraph.accuracy`), although it
includes the uncertainty of the correction. If neither trajectory is bounded, views must fit better
before refinement. And the views must keep it: a drift that some error of the camera happens to
explain is no error of the camera, and views that are corrected for it undo much of the correction.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from tofuse.corrections.camera_errors import CameraErrors
from tofuse.pipeline.config import Config
from tofuse.pipeline.progress import Progress
from tofuse.posegraph.calibration_check import CalibrationCheck
from tofuse.posegraph.calibration_check import in_words as errors_in_words
from tofuse.results.card import length
from tofuse.results.types import Diagnostics, Reason, Reconstruction, SelfCalibration
from tofuse.results.verdict import ranked

# The first estimate uses poses that the error has distorted, the second one does not.
_ROUNDS = 2
# Options of `CameraErrors` by the names of the errors; their standard deviations.
_FIELDS = {"focal": "focal", "offset": "offset_m"}
_SIGMAS = {"focal": "focal_sigma", "offset": "offset_sigma_m"}

Once = Callable[[Config], Reconstruction]


def self_calibrated(
    first: Reconstruction, config: Config, once: Once, progress: Progress
) -> Reconstruction:
    """Reconstruct again without the calibration errors that the views show.

    Parameters
    ----------
    first
        The reconstruction without a correction.
    config
        Its configuration.
    once
        Reconstructs the recording with a configuration.
    progress
        Receives notes.
    """
    best, corrected = first, CameraErrors()
    for _ in range(_ROUNDS):
        shown = _shown(best, corrected)
        if shown is None:
            break
        check, error = shown
        wrong = corrected.and_then(error)
        progress.note(f"views agree better with {in_words(wrong)}: reconstructing again with it")
        again = once(replace(config, corrections=(wrong, *config.corrections)))
        if not (_is_better(again, best) and _is_kept(again, check)):
            progress.note("views do not agree better with it: the calibration stays")
            break
        calibration = SelfCalibration(
            wrong.focal,
            wrong.offset_m,
            {_FIELDS[check.best]: check.sigmas[check.best]},
            (_bound(first), _bound(again)),
        )
        best = replace(again, diagnostics=_with_calibration(again, calibration))
        corrected = wrong
    return best


def in_words(wrong: CameraErrors) -> str:
    """Describe a correction: "a focal length 4.5 % smaller"."""
    errors = {name: getattr(wrong, field) for name, field in _FIELDS.items()}
    return " and ".join(errors_in_words({name: e for name, e in errors.items() if e}))


def _shown(
    result: Reconstruction, corrected: CameraErrors
) -> tuple[CalibrationCheck, CameraErrors] | None:
    """Return the calibration error that explains the views best; None without an alarm.

    After a correction, also what is left of the same error, though it may be within the tolerance.
    """
    found = _check_of(result)
    if found is None:
        return None
    best = found.best
    left = found.improves and best in found.unconfirmed and getattr(corrected, _FIELDS[best])
    if not (found.alarm or left):
        return None
    values = {_FIELDS[best]: found.errors[best], _SIGMAS[best]: found.sigmas[best]}
    try:
        return found, CameraErrors(**values)
    except ValueError:
        return None  # implausibly large


def _is_better(again: Reconstruction, before: Reconstruction) -> bool:
    """Whether no frame lost its pose, and the error bound is smaller."""
    if again.has_pose.sum() < before.has_pose.sum():
        return False
    new, old = _bound(again), _bound(before)
    # If neither is bounded, the support of the views decides.
    return new < old if np.isfinite([new, old]).any() else _support(again) > _support(before)


def _is_kept(again: Reconstruction, check: CalibrationCheck) -> bool:
    """Whether the views do not significantly undo the correction that a check proposed."""
    found = _check_of(again)
    left = 0.0 if found is None else found.large.get(check.best, 0.0)
    return left * check.errors[check.best] >= 0


def _check_of(result: Reconstruction) -> CalibrationCheck | None:
    refinement = result.diagnostics.refinement
    return None if refinement is None else refinement.calibration_check


def _bound(result: Reconstruction) -> float:
    return result.diagnostics.accuracy.position_m


def _gain(before: float, after: float) -> str:
    """Describe the change of the bound."""
    if not np.isfinite([before, after]).all():
        return ""
    return f" The bound of the pose error is {length(after)} (95 %) instead of {length(before)}."


def _support(result: Reconstruction) -> float:
    """Return the support of the views before refinement, which may absorb the error."""
    refinement = result.diagnostics.refinement
    return refinement.support[0] if refinement is not None else 0.0


def _with_calibration(result: Reconstruction, calibration: SelfCalibration) -> Diagnostics:
    """Return the diagnostics with the self-calibration and its reason."""
    d = result.diagnostics
    indices = [f.index for f in d.frames]
    wrong = CameraErrors(calibration.focal, calibration.offset_m)
    text = (
        f"The calibration of the camera was corrected: views agree with {in_words(wrong)} "
        f"than stated.{_gain(*calibration.bound_m)}"
    )
    reason = Reason("self_calibrated", ((indices[0], indices[-1]),), text)
    return replace(d, calibrated=calibration, reasons=ranked([*d.reasons, reason]))
