"""Errors of the poses by the calibration of the camera."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tofuse.engine.mapping.camera_uncertainty import pose_errors, sigmas
from tofuse.engine.refinement.calibration_check import USUAL, CalibrationCheck
from tofuse.engine.sensor.camera_errors import CameraErrors


def test_estimated_errors_count_in_full_only_if_they_may_well_be_true():
    check = CalibrationCheck(
        estimates={"focal": (0.02, 0.004)}, moved=(0.03, 0.01), spread=(0.004, 0.0)
    )
    likely = replace(check, errors={"focal": 0.02})
    m, rad = pose_errors(check, [])
    assert m**2 == pytest.approx(0.03**2 / 3 + 0.004**2)
    assert rad == pytest.approx(0.01 / 3**0.5)
    assert pose_errors(likely, []) == pytest.approx(((0.03**2 + 0.004**2) ** 0.5, 0.01))
    assert sigmas(likely)["focal"] == pytest.approx((0.02**2 + 0.004**2) ** 0.5)


def test_few_views_leave_the_errors_of_usual_cameras():
    check = CalibrationCheck(motion={"focal": (1.0, 0.3), "center_x": (2.5, 0.2)})
    assert pose_errors(check, []) == pytest.approx((USUAL * 7.25**0.5, USUAL * 0.13**0.5))
    assert sigmas(check) == {"focal": USUAL, "offset": USUAL}


def test_correction_hides_what_sections_of_the_images_share():
    """As large as what they differ by, of which the estimate is the mean of eight."""
    check = CalibrationCheck(estimates={"focal": (0.0, 0.001)}, motion={"focal": (2.0, 0.5)})
    correction = CameraErrors(focal=0.03, focal_sigma=0.001)
    assert pose_errors(check, [correction]) == pytest.approx((8**0.5 * 0.002, 8**0.5 * 0.0005))
