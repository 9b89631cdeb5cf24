"""The bound on the accuracy of poses: a cube by hand, and the peaks."""

from __future__ import annotations

import numpy as np
import pytest

from tofuse.lab.experiments.bound import mean_distance, mean_distances, pose_covariances
from tofuse.lab.experiments.peaks import peaks_bound, peaks_bound_quantiles


def test_bound_of_cube_seen_twice():
    """Difference of two noisy heights, averaged over the samples that face each axis."""
    corners = np.array([[0, 0.5, 0.5], [0, 0.5, -0.5], [0, -0.5, 0.5], [0, -0.5, -0.5]])
    points, normals = [], []
    for axis in range(3):
        for side in (1, -1):
            points.append(np.roll(corners, axis, 1) + side * np.eye(3)[axis])
            normals.append(np.tile(side * np.eye(3)[axis], (4, 1)))
    points, normals = np.concatenate(points), np.concatenate(normals)
    seen = np.ones((24, 2), bool)
    C = pose_covariances(points, normals, seen, np.tile(np.eye(4), (2, 1, 1)), 0.1)
    np.testing.assert_array_equal(C[0], 0)
    # 8 samples face each axis; 16 of them, with a lever of 0.5 m, constrain each rotation.
    np.testing.assert_allclose(np.diag(C[1]), [2 * 0.01 / 8] * 3 + [2 * 0.01 / 4] * 3)
    # A third view of the unknown surface improves its accuracy.
    third = pose_covariances(
        points, normals, np.ones((24, 3), bool), np.tile(np.eye(4), (3, 1, 1)), 0.1
    )
    np.testing.assert_allclose(third[1:], np.broadcast_to(C[1], (2, 6, 6)), atol=1e-12)
    assert mean_distance(C[1:, :3, :3]) == pytest.approx(
        np.sqrt(2 * 0.01 / 8) * np.sqrt(8 / np.pi), rel=0.01
    )


def test_bound_of_peaks_grows_with_noise():
    assert peaks_bound(0.1) == pytest.approx(0.046, abs=0.001)
    assert peaks_bound(0.02) == pytest.approx(peaks_bound(0.1) / 5)


def test_bound_of_single_recordings_varies_with_first_view():
    low, high = peaks_bound_quantiles(0.1, (0.05, 0.95))
    assert low < peaks_bound(0.1) < high
    assert high > 2 * low
    # Two views: half the distance of the second one.
    C = np.diag([1.0, 1.0, 1.0, 0.1, 0.1, 0.1])
    assert mean_distances(C).mean() == pytest.approx(np.sqrt(8 / np.pi) / 2, rel=0.02)
