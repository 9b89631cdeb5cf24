"""Given poses against registrations: lower bound of their error, and its significance."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.linalg import eigh
from scipy.optimize import brentq
from tests.helpers.measured_graph import DEPTH_M, RIGID, SIGMA, jumped, measured

from tofuse.engine.geometry import se3
from tofuse.engine.quality.pose_deviation import _Corrections, deviation, fitted


def around(count=24):
    """Poses on a circle of 1 m, looking along it."""
    turn = np.linspace(0, 1.5 * np.pi, count)
    return np.array([se3.exp([0, 0, 0, 0, a, 0]) @ se3.exp([1.0, 0, 0, 0, 0, 0]) for a in turn])


def off(poses, truth):
    """The norm of `deviation` between two trajectories."""
    rest = deviation(fitted(measured(truth, noise=0.0), DEPTH_M), poses)
    return rest.distance_m


@pytest.fixture(scope="module")
def truth():
    return around()


@pytest.fixture(scope="module")
def fit(truth):
    return fitted(measured(truth), DEPTH_M)


def test_correct_poses_are_consistent(truth) -> None:
    for seed in range(5):
        found = deviation(fitted(measured(truth, seed=seed), DEPTH_M), truth)
        assert found.consistent
        assert found.at_least_m == found.estimate_m == 0
        assert 0 < found.distance_m < found.at_most_m < 0.05
        assert not len(found.steps)
        assert not found.of_views_m.any()


def test_deviation_is_invariant_to_rigid_motion(fit, truth) -> None:
    wrong = jumped(truth, [0.05, 0, 0, 0, 0.02, 0])
    a, b = deviation(fit, wrong), deviation(fit, RIGID @ wrong)
    assert b.at_least_m == pytest.approx(a.at_least_m, rel=1e-2)
    assert b.estimate_m == pytest.approx(a.estimate_m, rel=1e-2)
    assert b.distance_m == pytest.approx(a.distance_m, rel=1e-6)


@pytest.mark.parametrize("size", [0.5, 1.0, 3.0])
def test_true_error_is_within_bounds(fit, truth, size) -> None:
    drift = se3.exp(size * np.array([0.002, 0.001, 0.0, 0.0, 0.002, 0.001]))
    drifting = [truth[0]]
    for a, b in pairwise(truth):
        drifting.append(drifting[-1] @ se3.inverse(a) @ b @ drift)
    shaken = truth @ se3.exp(
        size * 0.01 * np.random.default_rng(1).standard_normal((len(truth), 6))
    )
    wrong = jumped(truth, size * np.array([0.04, 0, 0.03, 0, 0.03, 0]))
    for poses in (np.array(drifting), shaken, wrong):
        found, true = deviation(fit, poses), off(poses, truth)
        assert found.at_least_m <= true
        assert found.at_least_m <= found.estimate_m <= found.at_most_m
        assert true <= found.at_most_m
        if size >= 1:
            assert found.estimate_m > 0.4 * true
        if size >= 3:
            assert not found.consistent
            assert found.estimate_m > 0.7 * true


def test_significance_scales_with_registration_noise(truth) -> None:
    """An error that precise registrations reveal is insignificant among noisy ones."""
    wrong = jumped(truth, [0.015, 0, 0, 0, 0.005, 0])
    for noise, consistent in ((0.2, False), (4.0, True)):
        fit = fitted(measured(truth, noise=noise), DEPTH_M)
        assert fit.scale == pytest.approx(noise, rel=0.3)
        assert deviation(fit, wrong).consistent is consistent
        assert deviation(fit, truth).consistent


def test_chain_relies_on_stated_covariance(truth) -> None:
    """Without redundant pairs there are no residuals to estimate the size of errors."""
    fit = fitted(measured(truth, reach=1), DEPTH_M)
    assert fit.scale == pytest.approx(1.0)
    assert deviation(fit, truth).consistent
    assert not deviation(fit, jumped(truth, [0.3, 0, 0, 0, 0.2, 0])).consistent


def test_deviation_is_robust_to_outlier_registrations(truth) -> None:
    graph = measured(truth)
    rng = np.random.default_rng(5)
    Z = graph.measurements.copy()
    bad = rng.choice(len(Z), 5, replace=False)
    Z[bad] = Z[bad] @ se3.exp(0.2 * rng.standard_normal((5, 6)))
    fit = fitted(replace(graph, measurements=Z), DEPTH_M)
    assert deviation(fit, truth).consistent
    assert not deviation(fit, jumped(truth, [0.08, 0, 0, 0, 0.04, 0])).consistent


def test_unconstrained_directions_are_free() -> None:
    """One direction is unconstrained in every pair: poses may be anywhere along it."""
    row = np.tile(np.eye(4), (12, 1, 1))
    row[:, 0, 3] = np.linspace(0, 1, 12)
    stated = SIGMA.copy()
    stated[0] = 30.0
    fit = fitted(measured(row, stated=stated), DEPTH_M)
    far = row.copy()
    far[:, 0, 3] *= 1.3
    found = deviation(fit, far)
    assert found.consistent
    assert found.distance_m > 0.05
    assert np.isinf(found.at_most_m)
    away = far.copy()
    away[6:, 1, 3] += 0.06
    found = deviation(fit, away)
    assert 0 < found.at_least_m < 0.04


def test_correction_is_minimal(fit, truth) -> None:
    """Compared with dense linear algebra, in the generalized eigenvectors of both forms."""
    problem = _Corrections(fit.graph, DEPTH_M)
    n = len(truth)
    rng = np.random.default_rng(2)
    x = 0.02 * rng.standard_normal((n, 6))
    unit = np.eye(6 * n).reshape(-1, n, 6)
    # Polarization: the form of a sum of two vectors, and those of each.
    single = np.array([problem.product(u) for u in unit])
    S = np.array(
        [
            [(problem.product(a + b) - single[p] - single[q]) / 2 for q, b in enumerate(unit)]
            for p, a in enumerate(unit[:6])
        ]
    )
    assert np.allclose(np.diag(S), single[:6])
    H = dense(fit.graph)
    assert np.allclose(H[:6], S, atol=1e-6 * np.abs(H).max())
    M = np.tile([1, 1, 1, *[DEPTH_M**2] * 3], n) / n
    values, vectors = eigh(H, np.diag(M))
    a = vectors.T @ (M * x.ravel())
    allowed = 0.1 * problem.product(x)

    def left(log_m):
        return float((values * (a / (1 + np.exp(log_m) * values)) ** 2).sum()) - allowed

    m = np.exp(brentq(left, -30, 30))
    expected = a - a / (1 + m * values)
    found = problem.smallest_correction(x, allowed)
    assert problem.product(x - found) == pytest.approx(allowed, rel=1e-2)
    assert problem.norm(found) == pytest.approx(np.linalg.norm(expected), rel=1e-3)
    assert not problem.smallest_correction(x, 2 * problem.product(x)).any()


def dense(graph):
    """The information matrix of all poses."""
    n = len(graph.ids)
    H = np.zeros((6 * n, 6 * n))
    for (i, j), W in zip(graph.edges, graph.information, strict=True):
        J = np.zeros((6, 6 * n))
        J[:, 6 * j : 6 * j + 6] = np.eye(6)
        T_j_i = se3.inverse(graph.poses[j]) @ graph.poses[i]
        J[:, 6 * i : 6 * i + 6] = -se3.adjoint(T_j_i)
        H += J.T @ W @ J
    return H
