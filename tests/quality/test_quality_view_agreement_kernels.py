"""Kernels of map consistency against their definitions."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tofuse.engine.cameras.cameras import BrownConrady, Camera, Fisheye, Pinhole, Rational, RayTable
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.quality.map_agreement import SurfaceImage

SIZE = (64, 48, 50.0, 51.0, 31.0, 24.0)


@pytest.mark.parametrize(
    "camera",
    [
        Pinhole(*SIZE),
        BrownConrady(*SIZE, k1=-0.2, k2=0.05, p1=0.003, p2=-0.004, k3=-0.01),
        Rational(*SIZE, k1=0.5, k2=-0.1, p1=0.002, p2=0.001, k3=0.02, k4=0.7, k5=-0.05, k6=0.01),
        Fisheye(*SIZE, k1=0.03, k2=-0.02, k3=0.005, k4=-0.001),
        RayTable(Pinhole(*SIZE).rays()),
    ],
    ids=lambda camera: camera.model,
)
def test_projection_matches_camera(camera: Camera) -> None:
    rng = np.random.default_rng(0)
    image = SurfaceImage.of(RangeFrame(0, 0.0, camera, np.ones((48, 64), np.float32)))
    points = rng.uniform([-2, -2, -1], [2, 2, 4], (500, 3))
    found, expected = image.pixels(points), camera.project(points)
    seen = (points[:, 2] > 0.05) & (points[:, 0] ** 2 + points[:, 1] ** 2 < 0.3 * points[:, 2] ** 2)
    assert seen.sum() > 50
    assert found[seen] == pytest.approx(expected[seen], abs=1e-9)
    assert np.isnan(found[points[:, 2] <= 0]).all()
    # Points outside the lens's field of view must not project into the image by its polynomials.
    inside = (found >= -0.5).all(1) & (found < [63.5, 47.5]).all(1)
    wide = np.hypot(points[:, 0], points[:, 1]) > 1.1 * math.sqrt(image.max_radius2) * points[:, 2]
    assert not (inside & wide).any()
