"""6D Lu-Milios and ELCH: claims of their papers."""

from __future__ import annotations

import numpy as np
import pytest

from tofuse.engine.arrays import Float64
from tofuse.engine.geometry import se3
from tofuse.engine.graph.graph import Measured, PoseGraph, build_graph
from tofuse.engine.graph.levenberg import minimise
from tofuse.engine.graph.robust import Settings
from tofuse.engine.graph.sparse import PairSystem
from tofuse.lab.experiments.peaks import chain
from tofuse.lab.methods.elch import Elch
from tofuse.lab.methods.lu_milios import LuMilios, solve_linear


def ring(n: int, noise: float, seed: int = 0, loops: int = 1) -> tuple[PoseGraph, Float64]:
    """A camera on a closed path, each step with its own uncertainty; and the true poses."""
    rng = np.random.default_rng(seed)
    step = se3.exp([0.2, 0.0, 0.03, 0.01, 2 * np.pi / n, 0.0])
    truth = np.array([np.linalg.matrix_power(step, k) for k in range(n)])
    sigma = noise * rng.uniform(0.3, 2, n)
    edges = []
    for k in range(n - 1):
        measured = step @ se3.exp(rng.normal(size=6) * sigma[k])
        edges.append(Measured(k, k + 1, measured, np.eye(6) / sigma[k] ** 2))
    closing = [
        Measured(k, n - 1 - k, se3.inverse(truth[k]) @ truth[n - 1 - k], np.eye(6) / noise**2)
        for k in range(loops)
    ]
    poses = [np.eye(4)]
    for edge in edges:
        poses.append(poses[-1] @ edge.T_i_j)
    return build_graph(range(n), np.array(poses), edges, closing), truth


def test_linear_system_matches_paper():
    """G X = B, block by block."""
    graph, _ = ring(8, 0.01, loops=2)
    X = solve_linear(graph, PairSystem(8, graph.edges))
    G, B = np.zeros((8, 6, 8, 6)), np.zeros((8, 6))
    for (i, j), e, W in zip(graph.edges, graph.residuals(), graph.information, strict=True):
        A = se3.adjoint(graph.poses[j])
        D, C_inverse = -A @ e, np.linalg.inv(A @ np.linalg.inv(W) @ A.T)
        for a, b, sign in ((i, i, 1), (j, j, 1), (i, j, -1), (j, i, -1)):
            G[a, :, b] += sign * C_inverse
        B[j] += C_inverse @ D
        B[i] -= C_inverse @ D
    expected = np.linalg.solve(G.reshape(48, 48)[6:, 6:], B[1:].ravel())
    np.testing.assert_allclose(X[1:].ravel(), expected, rtol=1e-6, atol=1e-9)
    np.testing.assert_array_equal(X[0], 0)


@pytest.mark.parametrize("seed", range(3))
def test_small_loops_converge_to_minimum(seed):
    graph, _ = ring(30, 0.01, seed, loops=4)
    done = LuMilios(tolerance=1e-12).optimise(graph)
    assert done.converged
    assert len(done.objective) < 15
    least = minimise(graph, Settings("none", tolerance=1e-14)).graph
    assert done.graph.chi2() == pytest.approx(least.chi2(), rel=1e-3)
    np.testing.assert_allclose(done.graph.poses, least.poses, atol=1e-3)
    assert done.graph.chi2() < 0.1 * graph.chi2()
    np.testing.assert_array_equal(done.graph.poses[0], graph.poses[0])


def test_relaxation_never_increases_the_error():
    graph, _ = ring(20, 0.01)
    best = minimise(graph, Settings("none", tolerance=1e-14)).graph
    done = LuMilios().optimise(best)
    assert done.graph.chi2() <= best.chi2()
    np.testing.assert_allclose(done.graph.poses, best.poses, atol=1e-6)


def test_elch_closes_the_loop():
    graph, _ = ring(40, 0.02)
    done = Elch().optimise(graph).graph
    assert np.abs(graph.residuals()[-1]).max() > 0.02
    np.testing.assert_allclose(done.residuals()[-1], 0, atol=1e-9)
    np.testing.assert_array_equal(done.poses[0], graph.poses[0])


def test_elch_distributes_error_by_covariance():
    """Each pose moves by the share of the uncertainty that lies before it on the loop."""
    graph, _ = ring(25, 0.02)
    done = Elch().optimise(graph).graph
    variance = 1 / graph.information[:24, 0, 0]
    share = np.concatenate([[0], np.cumsum(variance)]) / variance.sum()
    moved = done.poses[:, :3, 3] - graph.poses[:, :3, 3]
    np.testing.assert_allclose(moved, share[:, None] * moved[-1], atol=1e-12)
    turned = done.poses[:, :3, :3] @ np.swapaxes(graph.poses[:, :3, :3], 1, 2)
    angle = se3.angle(turned)
    assert angle[-1] > 0.01
    np.testing.assert_allclose(angle, share * angle[-1], atol=1e-12)


def test_branches_of_loop_move_with_it():
    """Poses before the loop are fixed, those after it move as its end, a branch as its root."""
    relative = np.tile(se3.exp([1.0, 0, 0, 0, 0, 0]), (9, 1, 1))
    loop = Measured(2, 6, se3.exp([4.4, 0, 0, 0, 0, 0]), np.eye(6))
    graph = chain(relative, [loop])
    branch = build_graph(
        range(11),
        np.concatenate([graph.poses, graph.poses[4:5] @ se3.exp([0, 1.0, 0, 0, 0, 0])]),
        [Measured(k, k + 1, T, np.eye(6)) for k, T in enumerate(relative)]
        + [Measured(4, 10, se3.exp([0, 1.0, 0, 0, 0, 0]), np.eye(6))],
        [loop],
    )
    moved = (Elch().optimise(branch).graph.poses - branch.poses)[:, 0, 3]
    expected = [0, 0, 0, 0.1, 0.2, 0.3, 0.4, 0.4, 0.4, 0.4, 0.2]
    np.testing.assert_allclose(moved, expected, atol=1e-12)
