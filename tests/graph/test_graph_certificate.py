"""Certificates of global optimality."""

from dataclasses import replace

import numpy as np
import pytest

from tofuse.engine.geometry import se3
from tofuse.engine.graph.certificate import Dual, _Isotropic, certify, isotropic_weights
from tofuse.engine.graph.graph import PoseGraph
from tofuse.engine.graph.levenberg import LevenbergMarquardt
from tofuse.engine.graph.minimisation import Descent

LEAST_SQUARES = LevenbergMarquardt(robust="none")
BEST = LevenbergMarquardt(robust="none", start="best")


def ring(n: int = 20, turns: int = 1, sigma: float = 0.01, seed: int = 0) -> PoseGraph:
    """Return a ring that turns once, with poses that turn `turns` times."""
    rng = np.random.default_rng(seed)

    def poses(turns: int) -> np.ndarray:
        yaw = 2 * np.pi * np.arange(n) / n
        T = np.tile(np.eye(4), (n, 1, 1))
        T[:, :3, :3] = se3.so3_exp(np.outer(turns * yaw, [0, 0, 1]))
        T[:, :3, 3] = np.stack([np.cos(yaw), np.sin(yaw), 0 * yaw], axis=1)
        return T

    edges = np.stack([np.arange(n), np.roll(np.arange(n), -1)], axis=1)
    i, j = edges.T
    truth = poses(1)
    Z = se3.inverse(truth[i]) @ truth[j] @ se3.exp(sigma * rng.normal(size=(n, 6)))
    information = np.tile(np.eye(6) / sigma**2, (n, 1, 1))
    return PoseGraph(np.arange(n), poses(turns), edges, Z, information, i > j)


def random_graph(seed: int) -> PoseGraph:
    rng = np.random.default_rng(seed)
    n, sigma = 12, 0.05
    truth = se3.exp(rng.normal(size=(n, 6)))
    a, b = np.triu_indices(n, 2)
    some = rng.choice(len(a), 12, replace=False)
    i = np.concatenate([np.arange(n - 1), a[some]])
    j = np.concatenate([np.arange(1, n), b[some]])
    Z = se3.inverse(truth[i]) @ truth[j] @ se3.exp(sigma * rng.normal(size=(len(i), 6)))
    information = np.tile(np.diag([1, 1, 1, 4, 4, 4]) / sigma**2, (len(i), 1, 1))
    poses = truth @ se3.exp(0.3 * rng.normal(size=(n, 6)))
    return PoseGraph(np.arange(n), poses, np.stack([i, j], 1), Z, information, j - i > 1)


def dense(graph: PoseGraph, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """S and Lambda of the isotropic problem, written down from its definition in the paper."""
    n = len(graph.ids)
    tau, double_kappa = isotropic_weights(graph.information)
    rows_t, rows_R = [], []
    for (i, j), Z, a, b in zip(graph.edges, graph.measurements, tau, double_kappa / 2, strict=True):
        row = np.zeros((1, 4 * n))  # translations, then the rows of R^T
        row[0, j], row[0, i] = 1, -1
        row[0, n + 3 * i : n + 3 * i + 3] = -Z[:3, 3]
        rows_t.append(np.sqrt(a) * row)
        row = np.zeros((3, 4 * n))
        row[:, n + 3 * j : n + 3 * j + 3] = np.eye(3)
        row[:, n + 3 * i : n + 3 * i + 3] = -Z[:3, :3].T
        rows_R.append(np.sqrt(b) * row)
    A = np.concatenate(rows_t + rows_R)
    M = A.T @ A
    Q = M[n:, n:] - M[n:, :n] @ np.linalg.pinv(M[:n, :n]) @ M[:n, n:]
    product = Q @ np.concatenate(list(np.swapaxes(poses[:, :3, :3], 1, 2)))
    S = Q.copy()
    multipliers = np.zeros((n, 3, 3))
    for k in range(n):
        block = slice(3 * k, 3 * k + 3)
        L = product[block] @ poses[k, :3, :3]
        multipliers[k] = (L + L.T) / 2
        S[block, block] -= multipliers[k]
    return S, multipliers


@pytest.mark.parametrize("seed", range(4))
def test_global_optimum_is_certified_and_bound_is_tight(seed) -> None:
    graph = BEST.optimise(random_graph(seed)).graph
    found = certify(graph)
    assert found.optimal
    assert found.isotropic
    assert abs(found.eigenvalue) < 1e-4
    assert 0 <= found.gap < 0.01
    assert "No other poses fit these measurements better" in found.text
    # The bound holds for poses that are no solution as well.
    for scale in (0.01, 0.1, 1.0):
        rng = np.random.default_rng(seed)
        moved = graph.with_poses(graph.poses @ se3.exp(scale * rng.normal(size=(12, 6))))
        assert found.lower_bound < moved.chi2()
        assert certify(moved).lower_bound <= found.squared_error


@pytest.mark.parametrize("turns", [1, 0, 2])
def test_wound_ring_is_not_certified(turns) -> None:
    """A ring that winds once too often, or not at all, is a local minimum."""
    graph = LEAST_SQUARES.optimise(ring(turns=turns)).graph
    found = certify(graph)
    least = certify(BEST.optimise(ring()).graph)
    assert least.optimal
    if turns == 1:
        assert found.optimal
        return
    assert graph.chi2() > 10 * least.squared_error
    assert not found.optimal
    assert not found.isotropic
    assert found.text == ""
    assert found.eigenvalue < -1
    assert found.lower_bound <= least.squared_error
    # The other start finds the global minimum.
    again = certify(BEST.optimise(ring(turns=turns)).graph)
    assert again.squared_error == pytest.approx(least.squared_error, rel=1e-5)
    assert again.optimal


@pytest.mark.parametrize(
    "graph", [random_graph(7), ring(turns=1), ring(turns=2), ring(turns=0, sigma=0.1)],
)  # fmt: skip
def test_eigenvalue_is_that_of_dense_matrix(graph) -> None:
    solved = LEAST_SQUARES.optimise(graph).graph
    problem = _Isotropic(solved)
    descent = Descent(problem, solved.poses)
    descent.run(lambda x: x, np.ones_like, 1e-14, 100)
    dual = Dual(problem, descent.poses)
    S, multipliers = dense(solved, descent.poses)
    scale = np.abs(S).max()
    # The translations of the dense matrix are the best ones for the rotations.
    np.testing.assert_allclose(dual.multipliers, multipliers, atol=1e-5 * scale)
    value, shift = dual.smallest_eigenvalue(1e-3 * solved.chi2())
    assert value == pytest.approx(np.linalg.eigvalsh(S)[0], abs=1e-5 * scale)
    assert np.linalg.eigvalsh(S)[0] > -shift


def test_isotropic_weights_are_below_information() -> None:
    rng = np.random.default_rng(0)
    A = rng.normal(size=(50, 6, 6)) * np.array([1, 1, 1, 10, 10, 10])[:, None]
    information = A @ np.swapaxes(A, 1, 2)
    a, b = isotropic_weights(information)
    assert (a > 0).all()
    below = information.copy()
    below[:, range(6), range(6)] -= np.repeat(np.stack([a, b], axis=1), 3, axis=1)
    smallest = np.linalg.eigvalsh(below)[:, 0]
    assert (np.abs(smallest) < 1e-9 * np.linalg.eigvalsh(information)[:, -1]).all()  # the largest
    flat = np.diag([1.0, 1, 0, 1, 1, 1])[None]
    assert [w.tolist() for w in isotropic_weights(flat)] == [[0.0], [0.0]]


def test_anisotropic_information_leaves_weaker_statement() -> None:
    graph = random_graph(3)
    squeezed = graph.information * np.outer([1, 1, 10, 1, 1, 1], [1, 1, 10, 1, 1, 1])
    found = certify(BEST.optimise(replace(graph, information=squeezed)).graph)
    assert not found.optimal
    assert 0 < found.lower_bound < found.squared_error
    assert found.isotropic
    assert found.text.startswith("If every measurement counts alike in all directions")


def test_small_and_exact_and_large_graphs() -> None:
    exact = random_graph(0)
    i, j = exact.edges.T
    exact = replace(exact, measurements=se3.inverse(exact.poses[i]) @ exact.poses[j])
    assert certify(exact).optimal
    assert certify(PoseGraph.empty()).optimal
    assert certify(random_graph(0), max_factor=10) is None
    flat = np.tile(np.diag([1.0, 1, 0, 1, 1, 1]), (len(i), 1, 1))
    found = certify(replace(random_graph(0), information=flat))
    assert found.eigenvalue is None
    assert found.lower_bound == 0
    assert found.text == ""
