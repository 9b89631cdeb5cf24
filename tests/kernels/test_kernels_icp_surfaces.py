"""The kernels of surface registration equal their slow references."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tofuse.errors import InputError
from tofuse.geometry import se3
from tofuse.kernels.cloud_matching import grid_search
from tofuse.kernels.cloud_shape import local_shapes, symmetric_eigen
from tofuse.kernels.cloud_sums import (
    direction_products,
    matrix_sums,
    plane_sums,
    plane_to_plane_weights,
    symmetric_sums,
)
from tofuse.kernels.kdtree import KdTree
from tofuse.kernels.threads import threads

seeds = st.integers(0, 2**32 - 1)


def units(r, n):
    a = r.normal(size=(n, 3))
    return a / np.linalg.norm(a, axis=1)[:, None]


@settings(max_examples=100)
@given(seed=seeds, flat=st.floats(0, 1), size=st.floats(-6, 6))
def test_eigenvalues_match_lapack(seed, flat, size):
    x = np.random.default_rng(seed).normal(size=(9, 3)) * [1, 0.5, flat] * 10.0**size
    A = x.T @ x
    values, vectors = np.empty(3), np.empty((3, 3))
    symmetric_eigen(A.copy(), values, vectors)
    np.testing.assert_allclose(values, np.linalg.eigvalsh(A), atol=1e-13 * values[2])
    np.testing.assert_allclose(vectors @ np.diag(values) @ vectors.T, A, atol=1e-13 * values[2])
    np.testing.assert_allclose(vectors.T @ vectors, np.eye(3), atol=1e-13)


def shapes(points, k, origin=(0.0, 0.0, 0.0)):
    points = np.asarray(points, float)
    index, _ = KdTree(points).neighbours(points, k)
    n = len(points)
    out = np.empty((n, 3)), np.empty(n), np.empty(n), np.empty(n)
    local_shapes(points, index, points, np.array(origin), *out)
    return index, out


def test_normals_are_plane_fits_facing_origin():
    r = np.random.default_rng(0)
    points = r.normal(size=(300, 3)) * [1, 1, 0.1] + np.array([0, 0, 3])
    index, (normals, _, _, roughness) = shapes(points, 10)
    for i in range(300):
        near = points[index[i]]
        values, vectors = np.linalg.eigh(np.cov(near.T, bias=True))
        n = vectors[:, 0] * np.sign(-vectors[:, 0] @ points[i])
        np.testing.assert_allclose(normals[i], n, atol=1e-9)
        np.testing.assert_allclose(roughness[i], np.sqrt(values[0] / values[1]), atol=1e-9)


def test_curvature_of_sphere_is_inverse_radius():
    r = np.random.default_rng(1)
    ball = 0.5 * units(r, 4000)
    _, (_, outside, _, _) = shapes(ball + np.array([0, 0, 3]), 20, origin=(0, 0, 3 - 1e6))
    front = ball[:, 2] < -0.1
    np.testing.assert_allclose(np.median(outside[front]), 2.0, rtol=0.02)
    # Seen from inside it is concave.
    _, (_, inside, _, _) = shapes(ball, 20)
    np.testing.assert_allclose(np.median(inside), -2.0, rtol=0.02)


def test_curvature_of_cylinder_is_half_inverse_radius():
    r = np.random.default_rng(2)
    a, h = r.uniform(0, 2 * np.pi, 6000), r.uniform(-1, 1, 6000)
    _, (_, curvature, _, _) = shapes(np.column_stack([np.cos(a), h, np.sin(a)]), 20)
    np.testing.assert_allclose(np.median(curvature), -0.5, rtol=0.05)


def test_sheet_border_has_wide_angular_gap():
    x, y = np.meshgrid(np.arange(20.0), np.arange(20.0))
    sheet = np.column_stack([x.ravel(), y.ravel(), np.full(400, 9.0)])
    _, (_, _, gap, roughness) = shapes(sheet, 9)
    edge = (x == 0) | (x == 19) | (y == 0) | (y == 19)
    assert np.rad2deg(gap[~edge.ravel()]).max() < 91
    assert np.rad2deg(gap[edge.ravel()]).min() > 135
    assert roughness.max() < 1e-6


def test_collinear_points_have_no_normal():
    _, (normals, curvature, gap, _) = shapes(np.outer(np.arange(20.0), [1, 2, 3]), 6)
    assert np.isnan(normals).all()
    assert np.isnan(curvature).all()
    assert (gap == 2 * np.pi).all()


def test_moments_match_twin_and_are_rotation_invariant():
    r = np.random.default_rng(3)
    points = r.normal(size=(500, 3))
    centres = np.vstack([points[:50], [[50, 0, 0]]])
    found = KdTree(points).moments(centres, 0.7)
    for c, values in zip(centres, found, strict=True):
        near = points[((points - c) ** 2).sum(1) <= 0.49] - c
        wanted = np.linalg.eigvalsh(near.T @ near / len(near)) if len(near) else np.zeros(3)
        np.testing.assert_allclose(values, wanted, atol=1e-12)
    T = se3.exp([1, 2, 3, 0.5, -1, 0.3])
    turned = KdTree(se3.transform(T, points)).moments(se3.transform(T, centres), 0.7)
    np.testing.assert_allclose(turned, found, atol=1e-9)


def numeric(residuals, step=1e-6):
    """Derivative of residuals(xi) at zero."""
    return np.stack(
        [(residuals(d) - residuals(-d)) / (2 * step) for d in np.eye(6) * step], axis=-1
    )


def test_plane_sums_are_point_to_plane_normal_equations():
    r = np.random.default_rng(4)
    T = se3.exp(r.normal(size=6))
    p, q, w = r.normal(size=(30, 3)), r.normal(size=(30, 3)), r.uniform(0, 2, 30)
    n, m = units(r, 30), units(r, 30)

    def along(n):
        return lambda xi: ((se3.transform(T @ se3.exp(xi), p) - q) * n).sum(1)

    J, K = numeric(along(n)), numeric(along(m))
    residual = along(n)(np.zeros(6))
    turned_n, turned_m = n @ T[:3, :3], m @ T[:3, :3]
    H, g, square = plane_sums(p, turned_n, turned_m, residual, w)
    np.testing.assert_allclose(H, J.T @ (w[:, None] * K), atol=1e-6)
    np.testing.assert_allclose(g, J.T @ (w * residual), atol=1e-6)
    np.testing.assert_allclose(square, w @ residual**2)
    directions = r.normal(size=(4, 6))
    both, plain = direction_products(p, turned_n, turned_m, w, directions)
    np.testing.assert_allclose(both, [u @ H @ u for u in directions], rtol=1e-9)
    own = J.T @ (w[:, None] * J) + K.T @ (w[:, None] * K)
    np.testing.assert_allclose(plain, [u @ own @ u / 2 for u in directions], rtol=1e-6)


def test_matrix_sums_are_normal_equations_of_weighted_distance():
    r = np.random.default_rng(5)
    T = se3.exp(r.normal(size=6))
    p, q, w = r.normal(size=(20, 3)), r.normal(size=(20, 3)), r.uniform(0, 2, 20)
    W = plane_to_plane_weights(units(r, 20), units(r, 20), 0.01)

    def residuals(xi):
        return (se3.transform(T @ se3.exp(xi), p) - q) @ T[:3, :3]

    J, e = numeric(residuals), residuals(np.zeros(6))
    H, g, square = matrix_sums(p, e, W, w)
    np.testing.assert_allclose(H, np.einsum("k,kia,kij,kjb->ab", w, J, W, J), rtol=1e-6, atol=1e-5)
    np.testing.assert_allclose(g, np.einsum("k,kia,kij,kj->a", w, J, W, e), rtol=1e-6, atol=1e-5)
    np.testing.assert_allclose(square, np.einsum("k,ki,kij,kj->", w, e, W, e))


def test_plane_to_plane_weights_invert_sum_of_disc_covariances():
    r = np.random.default_rng(6)
    a, b = units(r, 50), units(r, 50)
    W = plane_to_plane_weights(a, b, 0.02)
    for n, m, each in zip(a, b, W, strict=True):
        discs = 2 * np.eye(3) - 0.98 * (np.outer(n, n) + np.outer(m, m))
        np.testing.assert_allclose(each, np.linalg.inv(discs), atol=1e-9)


def test_symmetric_sums_match_twin():
    r = np.random.default_rng(7)
    p, q, n, w = (*r.normal(size=(3, 20, 3)), r.uniform(0, 2, 20))
    J = np.hstack([n, np.cross(p + q, n)])
    e = ((p - q) * n).sum(1)
    H, g = symmetric_sums(p, q, n, w)
    np.testing.assert_allclose(H, J.T @ (w[:, None] * J), atol=1e-12)
    np.testing.assert_allclose(g, J.T @ (w * e), atol=1e-12)


@settings(max_examples=40)
@given(
    seed=seeds,
    n=st.integers(0, 120),
    k=st.integers(1, 3),
    tolerance=st.sampled_from([0.3, 1.0, np.inf]),
    limit=st.sampled_from([0.4, np.inf]),
    share=st.sampled_from([0.0, 1.0]),
    count=st.sampled_from([1, 3]),
)
def test_nearest_featured_matches_brute_force(seed, n, k, tolerance, limit, share, count):
    r = np.random.default_rng(seed)
    # Coordinates on a grid, so that there are ties.
    points, queries = (r.integers(0, 8, (m, 3)) / 8 for m in (n, 40))
    f, g = (r.integers(0, 4, (m, k)) / 4 for m in (n, 40))
    f[: n // 5] = np.nan
    with threads(count):
        index, squared = KdTree(points).nearest_featured(queries, f, g, tolerance, limit, share)
    for q in range(40):
        d = ((points - queries[q]) ** 2).sum(1)
        gap = f - g[q]
        ok = (d <= limit**2) & (np.abs(gap) <= tolerance).all(1)
        total = np.where(ok, d + share * (gap**2).sum(1), np.inf)
        if not ok.any():
            assert index[q] == -1
            assert squared[q] == np.inf
        else:
            assert index[q] == np.argmin(total)
            assert squared[q] == d[index[q]]


def test_grid_search_descends_from_pixel():
    grid = np.arange(400).reshape(20, 20)
    grid[5, 5] = -1
    v, u = np.divmod(np.arange(400), 20)
    points = np.column_stack([u, v, np.zeros(400)]).astype(float)
    moved = np.array([[7.2, 3.1, 1], [5, 5, 0], [3, 3, 0], [0, 0, 0], [9, 9, 0.0]])
    pixels = np.array([[1, 1], [5, 5], [np.nan, 3], [-1e300, 0], [-2, 9.0]])
    index, squared = np.empty(5, np.int64), np.empty(5)
    grid_search(grid, points, moved, pixels, 2, index, squared)
    # Six pixels away, with steps of two; a pixel without a point; behind the camera; outside.
    assert index[0] == 3 * 20 + 7
    assert squared[0] == pytest.approx(0.04 + 0.01 + 1)
    assert squared[1] == 1
    assert list(index[2:]) == [-1, -1, 9 * 20 + 9]
    grid_search(grid, points, moved, pixels, 0, index, squared)
    assert list(index) == [21, -1, -1, -1, -1]


def test_search_rejects_wrong_shape():
    with pytest.raises(InputError, match="shape"):
        KdTree(np.zeros((3, 3))).moments(np.zeros((3, 2)), 1.0)
