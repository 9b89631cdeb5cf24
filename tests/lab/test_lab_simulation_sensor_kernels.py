"""Kernels of the simulated camera against slow NumPy references."""

from __future__ import annotations

import numpy as np
import pytest

from tofuse.lab.simulation import phasor_kernels as phasor

RNG = np.random.default_rng(7)


def test_ray_phasors_match_twin() -> None:
    strength = RNG.uniform(-0.2, 1, (50, 3))
    path = RNG.uniform(0, 12, (50, 3))
    k = 0.63
    out = np.full((50, phasor.CHANNELS), np.nan)
    phasor.ray_phasors(strength, path, k, 0, 20, out)
    assert np.isnan(out[20:]).all()
    phasor.ray_phasors(strength, path, k, 20, 50, out)
    s = np.maximum(strength, 0)
    np.testing.assert_allclose(out[:, 0], s.sum(1))
    for c, n in ((1, 1), (3, 3), (5, 5)):
        twin = (s * np.exp(1j * n * k * path)).sum(1)
        np.testing.assert_allclose(out[:, c] + 1j * out[:, c + 1], twin, atol=1e-12)


@pytest.mark.parametrize(("stride", "weights"), [(1, [1.0]), (2, [0.25, 0.5, 0.25])])
def test_pooling_is_weighted_sum_over_windows(stride: int, weights: list[float]) -> None:
    weights = np.array(weights)
    height, width, n = 5, 6, len(weights)
    fine = RNG.normal(size=((height - 1) * stride + n, (width - 1) * stride + n, 4))
    out = np.zeros((height, width, 4))
    phasor.pool(fine, weights, stride, 0, height, out)
    for v in range(height):
        for u in range(width):
            window = fine[v * stride : v * stride + n, u * stride : u * stride + n]
            twin = np.einsum("i,j,ijc->c", weights, weights, window)
            np.testing.assert_allclose(out[v, u], twin, atol=1e-12)


def test_plane_deviation_matches_twin() -> None:
    points = RNG.normal(size=(7, 9, 3))
    points[0:3, 0:3][RNG.random((3, 3)) < 0.3] = np.inf
    points[1, 3] = np.inf
    normals = RNG.normal(size=(7, 9, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    out = np.zeros((3, 4))
    phasor.plane_deviation(points, normals, 3, 2, 0, 3, out)
    for v in range(3):
        for u in range(4):
            window = points[2 * v : 2 * v + 3, 2 * u : 2 * u + 3].reshape(-1, 3)
            window = window[np.isfinite(window).all(1)]
            centre, normal = points[2 * v + 1, 2 * u + 1], normals[2 * v + 1, 2 * u + 1]
            if np.isfinite(centre).all():
                twin = np.abs((window - centre) @ normal).max()
            else:
                twin = np.ptp(np.linalg.norm(window, axis=1))
            assert out[v, u] == pytest.approx(twin)


def plane_grid(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    v, u = np.mgrid[0:height, 0:width] / 50
    points = np.stack([u, v, np.full_like(u, 2.0)], -1)
    normals = np.zeros_like(points)
    normals[..., 2] = -1
    return points, normals


def test_upsampling_matches_weighted_twin() -> None:
    points, normals = plane_grid(12, 12)
    points += RNG.normal(0, 0.01, points.shape)
    normals += RNG.normal(0, 0.2, normals.shape)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    pick = (slice(2, None, 4), slice(2, None, 4))
    x, n = points[pick].copy(), normals[pick].copy()
    coarse = RNG.normal(size=(3, 3, 2))
    out = np.zeros((12, 12, 2))
    phasor.upsample(coarse, x, n, points, normals, 4, 0, 12, out)
    for v, u in ((0, 0), (5, 6), (11, 3)):
        p, m = points[v, u], normals[v, u]
        scale = 0.01 * np.linalg.norm(p) + 0.005
        ci, cj = round((v - 2) / 4), round((u - 2) / 4)
        total, weight = np.zeros(2), 0.0
        for i in range(max(0, ci - 1), min(3, ci + 2)):
            for j in range(max(0, cj - 1), min(3, cj + 2)):
                off = (x[i, j] - p) @ m / scale
                alike = max(0.0, float(n[i, j] @ m))
                away = (i - (v - 2) / 4) ** 2 + (j - (u - 2) / 4) ** 2
                w = np.exp(-1.5 * away) * (np.exp(-(off**2)) * alike**4 + 1e-6)
                total += w * coarse[i, j]
                weight += w
        np.testing.assert_allclose(out[v, u], total / weight, rtol=1e-9)
