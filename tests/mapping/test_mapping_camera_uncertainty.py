"""Errors of the poses by the calibration of the camera."""

from __future__ import annotations

import pytest

from tofuse.engine.mapping.camera_uncertainty import pose_errors
from tofuse.engine.refinement.calibration_check import CalibrationCheck


def test_errors_that_the_views_leave_open_count_as_those_of_usual_cameras():
    """A principal point 1 % of the focal length off: uniform between none and all of it."""
    check = CalibrationCheck(
        estimates={"focal": (0.0, 0.001), "center_x": (0.01, 0.02)},
        motion={"focal": (1.0, 0.3), "center_x": (2.5, 0.2)},
    )
    assert pose_errors(check, []) == pytest.approx((0.025 / 3**0.5, 0.002 / 3**0.5))
