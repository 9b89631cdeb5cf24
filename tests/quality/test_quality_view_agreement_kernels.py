"""Kernels of map consistency against their definitions."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tofuse.engine.cameras.cameras import BrownConrady, Camera, Fisheye, Pinhole, Rational, RayTable
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.geometry import se3
from tofuse.engine.quality.map_agreement import SurfaceImage
from tofuse.engine.quality.view_agreement_kernels import agreement_sums, transform_points

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


def test_moved_points_keep_invalid_ones_at_origin() -> None:
    points = np.array([[0.0, 0, 0], [1, 2, 3]])
    T = se3.exp([1, 2, 3, 0.1, 0.2, 0.3])
    out = np.full((2, 3), np.nan)
    transform_points(points, T, out)
    assert out[0].tolist() == [0, 0, 0]
    assert out[1] == pytest.approx(se3.transform(T, points)[1])


def test_agreement_sums_of_plane() -> None:
    target = np.zeros((2, 3, 3))
    target[..., 2] = 2.0
    target[1, 2, 2] = 0.0  # invalid
    normals = np.zeros((2, 3, 3), np.float32)
    normals[0, :, 2] = -1
    moved = np.array(
        [
            [0, 0, 2.03],  # an inlier
            [0, 0, 1.96],  # an inlier
            [0, 0, 2.2],  # the same surface, but no inlier
            [0, 0, 2.3],  # neither
            [0, 0, 2.01],  # projects to a pixel without a normal
            [0, 0, 2.01],  # projects to an invalid pixel
            [0, 0, 2.01],  # projects outside
            [0, 0, 2.01],  # does not project
            [0, 0, 0.04],  # too near
        ]
    )
    pixels = np.array(
        [[0, 0], [1.4, -0.4], [2, 0.2], [0.5, 0], [0, 1], [2, 1], [2.6, 0], [np.nan, 0], [0, 0]]
    )
    overlapping, compared, inliers, squares = agreement_sums(
        moved, pixels, target, normals, 0.25, 0.1
    )
    assert (overlapping, compared, inliers) == (4, 4, 2)
    assert squares == pytest.approx(0.03**2 + 0.04**2)
