"""Kernels of the edges of a pose graph, against the same in NumPy."""

from __future__ import annotations

import numpy as np
import pytest

from tofuse.engine.geometry import se3
from tofuse.engine.graph import sparse
from tofuse.engine.graph.minimisation import Problem

# From rounding to half a turn, on both sides of each series.
ANGLES = np.array([0, 1e-9, 1e-5, 0.019, 0.021, 0.099, 0.101, 1.0, 2.9, 3.05, np.pi - 1e-7])


@pytest.fixture
def rng():
    return np.random.default_rng(5)


def twists(rng, angles):
    axes = rng.normal(size=(len(angles), 3))
    axes *= (angles / np.linalg.norm(axes, axis=1))[:, None]
    return np.concatenate([rng.normal(size=(len(angles), 3)), axes], 1)


def right_jacobian(xi):
    """The series sum (-ad)^n / (n + 1)!, which converges for every twist."""
    ad = np.zeros((len(xi), 6, 6))
    ad[:, :3, :3] = ad[:, 3:, 3:] = se3.hat(xi[:, 3:])
    ad[:, :3, 3:] = se3.hat(xi[:, :3])
    series, term = np.zeros((6, 6)), np.eye(6)
    for n in range(60):
        series = series + term
        term = term @ -ad / (n + 2)
    return series


def test_normal_equations_are_those_of_the_jacobian(rng):
    e = twists(rng, ANGLES)
    root = rng.normal(size=(len(e), 6, 6))
    information, weights = root @ np.swapaxes(root, 1, 2), rng.uniform(0, 1, len(e))
    H, g = sparse.equations(e, information, weights)
    J = np.linalg.inv(right_jacobian(e))
    JtW = np.swapaxes(J, 1, 2) @ (weights[:, None, None] * information)
    scale = np.abs(JtW @ J).max()
    np.testing.assert_allclose(H, JtW @ J, rtol=1e-9, atol=1e-11 * scale)
    np.testing.assert_allclose(g, (JtW @ e[..., None])[..., 0], rtol=1e-9, atol=1e-10 * scale)


def test_jacobian_is_derivative_of_log(rng):
    xi = rng.normal(size=(5, 6))
    J = np.zeros((5, 6, 6))
    for axis in range(6):
        d = np.zeros(6)
        d[axis] = 1e-6
        up, down = (se3.log(se3.exp(xi) @ se3.exp(sign * d)) for sign in (1, -1))
        J[..., axis] = (up - down) / 2e-6
    H, g = sparse.equations(xi, np.tile(np.eye(6), (5, 1, 1)))
    Jt = np.swapaxes(J, 1, 2)
    np.testing.assert_allclose(H, Jt @ J, rtol=1e-8, atol=1e-7)
    np.testing.assert_allclose(g, (Jt @ xi[..., None])[..., 0], rtol=1e-8, atol=1e-7)


def test_errors_are_logarithms(rng):
    expected = twists(rng, ANGLES)
    count = len(expected)
    poses = se3.exp(rng.normal(size=(count, 6)))
    measurements = se3.exp(rng.normal(size=(count, 6)))
    poses = np.concatenate([poses, poses @ measurements @ se3.exp(expected)])
    pairs = np.stack([np.arange(count), count + np.arange(count)], 1)
    fixed = np.arange(2 * count) == 0
    problem = Problem(pairs, measurements, np.tile(np.eye(6), (count, 1, 1)), fixed, None)
    np.testing.assert_allclose(problem.errors(poses)[0], expected, atol=1e-6)
    np.testing.assert_allclose(problem.errors(poses)[0][:-1], expected[:-1], atol=1e-11)
