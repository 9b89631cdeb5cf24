"""The robust kernel: its weight, support and slope are those of one cost."""

from __future__ import annotations

import numpy as np
import pytest

from tofuse.engine.compute import tukey_kernels as tukey

E2 = np.linspace(0, 1.5, 301)


def influence(r):
    return r * tukey.weights(np.asarray(r * r))


def test_support_is_one_minus_integral_of_influence() -> None:
    r = (np.arange(100_000) + 0.5) / 100_000
    cost = np.cumsum(influence(r)) / len(r)
    cost /= cost[-1]  # of an outlier
    edge = r + 0.5 / len(r)
    expected = [1 - tukey.support(w) for w in tukey.weights(edge[::5000] ** 2)]
    np.testing.assert_allclose(expected, cost[::5000], atol=1e-9)


def test_slope_is_derivative_of_influence() -> None:
    r, h = np.sqrt(E2), 1e-6
    inside = E2 < 0.99
    numeric = (influence(r + h) - influence(r - h)) / (2 * h)
    np.testing.assert_allclose(tukey.slopes(E2)[inside], numeric[inside], atol=1e-8)
    assert not tukey.slopes(E2)[E2 >= 1].any()


def test_weight_falls_from_one_to_zero_at_cutoff() -> None:
    weights = tukey.weights(E2)
    assert weights[0] == 1
    assert (np.diff(weights) <= 0).all()
    assert not weights[E2 >= 1].any()


def test_scalars_match_arrays() -> None:
    for dtype in (np.float32, np.float64):
        for e2 in E2[E2 < 1].astype(dtype):
            w = tukey.weight(e2)
            tolerance = 50 * np.finfo(dtype).eps
            np.testing.assert_allclose(w, tukey.weights(e2), rtol=tolerance)
            np.testing.assert_allclose(tukey.root_weight(e2) ** 2, w, rtol=tolerance)
            slope = tukey.slopes(np.float64(e2))
            np.testing.assert_allclose(w * tukey.relative_slope(w), slope, atol=tolerance)
    assert tukey.relative_slope(0.0) == 0


@pytest.mark.parametrize("cutoff", [1.0, 2.5, 3.5, 4.685, 10.0])
def test_consistency_gives_variance_of_normal_residuals(cutoff: float) -> None:
    residuals = np.random.default_rng(0).normal(0, 1, 1_000_000)
    weights = tukey.weights((residuals / cutoff) ** 2)
    mean_square = (weights * residuals**2).sum() / weights.sum()
    assert tukey.consistency(cutoff) == pytest.approx(mean_square, rel=5e-3)
    # The derivative of the influence has the same mean: an M-estimate's sandwich needs it.
    slopes = tukey.slopes((residuals / cutoff) ** 2)
    assert tukey.consistency(cutoff) == pytest.approx(slopes.sum() / weights.sum(), rel=2e-2)
