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
    """Return the fraction of the estimated errors that counts."""
    return 1.0 if check.is_likely else _UNKNOWN


def pose_errors(
    check: calibration_check.CalibrationCheck, corrections: Sequence[CameraErrors]
) -> tuple[float, float]:
    """Return the rms of the pose errors (m, rad) due to the calibration.

    Those by the estimated errors and by their uncertainty, which is that of usual cameras where the
    views don't determine them. A correction that was estimated from the views hides what all
    sections of their images share.
    """
    credence_of_change = 1.0 if check.change_confirmed else _UNKNOWN
    errors = [
        _credence(check) * np.array(check.moved),
        np.array(check.spread),
        credence_of_change * np.array(check.changed),
    ]
    if not check.estimates:
        errors += [calibration_check.USUAL * np.array(motion) for motion in check.motion.values()]
    for part in corrections:
        for name, motion in check.motion.items():
            errors.append(calibration_check.HIDDEN * part.sigmas[name] * np.array(motion))
    m, rad = np.linalg.norm(errors, axis=0).tolist()
    return m, rad


def sigmas(check: calibration_check.CalibrationCheck) -> dict[str, float]:
    """Return the standard deviations of the focal length and of the range offset, by name.

    Those of their estimates. An estimated error that was not corrected counts as in `pose_errors`.
    """
    found = {}
    for name in ("focal", "offset"):
        error, sigma = check.estimates.get(name, (0.0, calibration_check.USUAL))
        found[name] = float(np.hypot(_credence(check) * error, sigma))
    return found
