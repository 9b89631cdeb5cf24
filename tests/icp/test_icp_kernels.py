"""The kernels of surface registration equal their slow references."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from tofuse.engine.geometry import se3
from tofuse.engine.geometry.kdtree import KdTree
from tofuse.engine.icp.icp_kernels import (
    direction_products,
    local_shapes,
    matrix_sums,
    plane_sums,
    plane_to_plane_weights,
    symmetric_eigen,
)

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
    out = np.empty((n, 3)), np.empty(n), np.empty((n, 2))
    local_shapes(points, index, points, np.array(origin), *out)
    return index, out


def test_normals_are_plane_fits_facing_origin():
    r = np.random.default_rng(0)
    points = r.normal(size=(300, 3)) * [1, 1, 0.1] + np.array([0, 0, 3])
    index, (normals, _, extents) = shapes(points, 10)
    for i in range(300):
        near = points[index[i]]
        values, vectors = np.linalg.eigh(np.cov(near.T, bias=True))
        n = vectors[:, 0] * np.sign(-vectors[:, 0] @ points[i])
        np.testing.assert_allclose(normals[i], n, atol=1e-9)
        np.testing.assert_allclose(extents[i], np.sqrt(values[:2]), atol=1e-9)


def test_sheet_border_has_wide_angular_gap():
    x, y = np.meshgrid(np.arange(20.0), np.arange(20.0))
    sheet = np.column_stack([x.ravel(), y.ravel(), np.full(400, 9.0)])
    _, (_, gap, extents) = shapes(sheet, 9)
    edge = (x == 0) | (x == 19) | (y == 0) | (y == 19)
    assert np.rad2deg(gap[~edge.ravel()]).max() < 91
    assert np.rad2deg(gap[edge.ravel()]).min() > 135
    assert extents[:, 0].max() < 1e-6


def test_collinear_points_have_no_normal():
    _, (normals, gap, _) = shapes(np.outer(np.arange(20.0), [1, 2, 3]), 6)
    assert np.isnan(normals).all()
    assert (gap == 2 * np.pi).all()


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
