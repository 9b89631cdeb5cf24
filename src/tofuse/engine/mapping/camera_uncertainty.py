"""Uncertainty of the camera's calibration, and the errors of the poses that it causes.

Multipath has the same effects as an error of the calibration: an estimated error counts in full
only if it may well be true, and otherwise as an unknown one.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tofuse.engine.quality import pose_accuracy
from tofuse.engine.refinement import calibration_check
from tofuse.engine.sensor import CameraErrors

_UNKNOWN = float(np.sqrt(pose_accuracy.UNKNOWN_FRACTION))


def _credence(check: calibration_check.CalibrationCheck) -> float:
    """Return the fraction of an estimated error that counts."""
    return 1.0 if check.is_likely else _UNKNOWN


def pose_errors(
    check: calibration_check.CalibrationCheck, corrections: Sequence[CameraErrors]
) -> tuple[float, float]:
    """Return the rms of the pose errors (m, rad) due to the calibration.

    An error that the views don't determine may be that of usual cameras. Added are the uncertainty
    of corrections that were estimated from the views, and the gap of a loop that a better
    calibration would close.
    """
    credence_of_change = 1.0 if check.change_confirmed else _UNKNOWN
    errors = [
        _credence(check) * np.array(check.moved),
        credence_of_change * np.array(check.changed),
    ]
    errors += [_UNKNOWN * np.array(motion) for motion in check.undetermined.values()]
    if check.alarm and check.gap is not None:
        errors.append(np.array(check.gap.before))
    for part in corrections:
        for name, motion in check.motion.items():
            errors.append(part.sigmas[name] * np.array(motion))
            if part.errors[name]:  # as of usual cameras, by what all views have in common
                errors.append(_UNKNOWN * calibration_check.TOLERANCES[name] * np.array(motion))
    m, rad = np.linalg.norm(errors, axis=0).tolist()
    return m, rad


def sigmas(
    check: calibration_check.CalibrationCheck, corrections: Sequence[CameraErrors]
) -> dict[str, float]:
    """Return the standard deviations of the focal length and of the range offset, by name.

    That of the focal length is that of usual cameras, as far as the views don't know better; it
    stands for an offset that they don't determine. An estimated error that was not corrected counts
    as in `pose_errors`.
    """
    found = {}
    for name in ("focal", "offset"):
        error, sigma = check.estimates.get(name, (0.0, np.inf))
        shown = max((part.sigmas[name] for part in corrections), default=0.0)
        if not corrections and check.determines(name):
            shown = (_credence(check) if name in check.errors else _UNKNOWN) * abs(error)
        known = float(1 / np.hypot(1 / calibration_check.TOLERANCES[name], 1 / sigma))
        if name == "focal" or shown > 0:
            found[name] = float(np.hypot(shown, known))
    return found
