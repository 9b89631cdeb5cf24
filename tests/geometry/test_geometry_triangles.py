"""Areas of triangles and their closest points."""

from __future__ import annotations

import numpy as np
import pytest

from tofuse.engine.geometry import triangles

CORNER = np.array([[0.0, 0, 0], [2, 0, 0], [0, 1, 0]])


def test_area():
    assert triangles.areas(CORNER[None]) == pytest.approx(1.0)


@pytest.mark.parametrize("seed", range(3))
def test_no_sampled_point_is_closer(seed):
    rng = np.random.default_rng(seed)
    corners = rng.normal(size=(40, 3, 3))
    points = rng.normal(size=(40, 3)) * 2
    found = triangles.closest_points(points, corners)
    weights = rng.dirichlet([0.5] * 3, 4000)
    sampled = np.einsum("sk,mki->msi", weights, corners)
    least = np.linalg.norm(sampled - points[:, None], axis=2).min(1)
    distance = np.linalg.norm(found - points, axis=1)
    assert (distance <= least + 1e-12).all()
    assert (least - distance < 0.1).all()  # it is a point of the triangle


def test_triangle_without_area_is_a_line():
    line = np.array([[[0.0, 0, 0], [1, 0, 0], [3, 0, 0]]])
    found = triangles.closest_points(np.array([[2.5, 1, 0]]), line)
    np.testing.assert_allclose(found, [[2.5, 0, 0]], atol=1e-12)
