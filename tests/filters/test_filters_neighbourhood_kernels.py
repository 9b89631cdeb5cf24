"""The neighbourhood angle against a slow NumPy reference."""

from __future__ import annotations

import numpy as np
import pytest

from tofuse.engine.filters.neighbourhood_kernels import is_steeper


def angle_twin(points: np.ndarray, valid: np.ndarray) -> np.ndarray:
    out = np.zeros(valid.shape)
    h, w = valid.shape
    for i, j in np.argwhere(valid):
        p = points[i, j].astype(float)
        for v in range(i - 1, i + 2):
            for u in range(j - 1, j + 2):
                if (v, u) != (i, j) and 0 <= v < h and 0 <= u < w and valid[v, u]:
                    d = points[v, u] - p
                    cosine = -(p @ d) / np.linalg.norm(p) / np.linalg.norm(d)
                    out[i, j] = max(out[i, j], np.arccos(np.clip(cosine, -1, 1)))
    return out


@pytest.mark.parametrize("threshold", [np.pi / 2, 2.0, 2.6])
def test_is_steeper_matches_twin(threshold: float) -> None:
    rng = np.random.default_rng(1)
    z = (rng.uniform(1, 3, (9, 11)) * (rng.random((9, 11)) < 0.7)).astype(np.float32)
    rays = np.stack(np.meshgrid(np.linspace(-2, 2, 11), np.linspace(-2, 2, 9)), -1)
    points = np.concatenate([rays, np.ones((9, 11, 1))], -1) * z[..., None]
    rays = np.where(z[..., None] > 0, rays, np.nan).astype(np.float32)  # never read
    out = np.zeros((9, 11), bool)
    cosine2 = np.float32(np.cos(threshold) ** 2)
    is_steeper(z, rays, cosine2, 0, 4, out)
    assert not out[4:].any()  # only its own rows
    is_steeper(z, rays, cosine2, 4, 9, out)
    expected = angle_twin(points, z > 0)
    far = np.abs(expected - threshold) > 1e-4
    assert (out == (expected > threshold))[far].all()
    assert 5 < out.sum() < (z > 0).sum()
