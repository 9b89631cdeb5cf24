"""Accuracy and completeness of surfaces, against distances computed by hand."""

from __future__ import annotations

import numpy as np
import pytest

from tofuse.lab.experiments.surface_error import Surface, compare_surfaces, distances

SQUARE = Surface(
    np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float), np.array([[0, 1, 2], [0, 2, 3]])
)


def shifted(shape, by):
    return Surface(shape.points + by, shape.faces)


def slow_distance(p, a, b, c):
    """To a triangle, by a fine grid of its points."""
    n = 150
    u, v = np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, n))
    keep = u + v <= 1
    u, v = u[keep][:, None], v[keep][:, None]
    return np.linalg.norm(a + u * (b - a) + v * (c - a) - p, axis=1).min()


def test_triangle_distances_match_slow_search() -> None:
    rng = np.random.default_rng(0)
    mesh = Surface(rng.normal(size=(9, 3)), np.arange(9).reshape(3, 3))
    points = rng.normal(size=(40, 3))
    found = distances(points, mesh, 50_000)
    expected = [min(slow_distance(p, *mesh.points[face]) for face in mesh.faces) for p in points]
    np.testing.assert_allclose(found, expected, atol=0.02)
    np.testing.assert_allclose(distances(points, Surface(points[:7]))[:7], 0, atol=1e-12)


def test_shifted_square_has_distance_of_shift() -> None:
    found = compare_surfaces(shifted(SQUARE, [0, 0, 0.004]), SQUARE, samples=20_000)
    for value in (found.accuracy_m, found.accuracy_median_m, found.completeness_m):
        assert value == pytest.approx(0.004, rel=1e-3)
    assert (found.precision, found.recall, found.fscore, found.outliers) == (1, 1, 1, 0)
    far = compare_surfaces(shifted(SQUARE, [0, 0, 0.06]), SQUARE, samples=20_000)
    assert (far.precision, far.recall, far.fscore, far.outliers) == (0, 0, 0, 1)


def test_missing_half_is_accurate_but_incomplete() -> None:
    half = Surface(SQUARE.points * [0.5, 1, 1], SQUARE.faces)
    found = compare_surfaces(half, SQUARE, samples=20_000)
    assert found.accuracy_m == pytest.approx(0, abs=1e-5)
    assert found.precision == 1
    assert found.recall == pytest.approx(0.51, abs=0.01)  # the half and 1 cm
    assert found.fscore == pytest.approx(2 * 0.51 / 1.51, abs=0.01)
    seen = np.array([[0.1, 0.5, 0], [0.3, 0.2, 0]])
    assert compare_surfaces(half, SQUARE, visible=seen, samples=20_000).recall == 1
    back = compare_surfaces(SQUARE, half, samples=20_000)
    assert back.recall == 1
    assert back.accuracy_p95_m == pytest.approx(0.45, abs=0.01)
