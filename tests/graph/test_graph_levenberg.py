"""The default optimiser: exact derivatives, weights, false loops, gravity, parts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tofuse.engine.arrays import Float64
from tofuse.engine.geometry import se3
from tofuse.engine.graph import robust
from tofuse.engine.graph.graph import Measured, PoseGraph, build_graph
from tofuse.engine.graph.levenberg import LevenbergMarquardt, minimise
from tofuse.engine.graph.solver import Settings
from tofuse.engine.graph.sparse import Blocks, PairSystem, equations
from tofuse.formats.poses.g2o import read_g2o
from walked_graph import SIGMA, walk


def ate(poses: Float64, truth: Float64) -> float:
    """Position error without alignment: the first pose is exact."""
    return float(np.sqrt(((poses - truth)[:, :3, 3] ** 2).sum(1).mean()))


def objective(graph: PoseGraph, poses: Float64) -> float:
    return graph.with_poses(poses).chi2()


def test_result_is_minimum_in_every_direction():
    """At the solution no small motion of any pose lowers the objective, and slopes are zero."""
    graph, _, _ = walk(20, 10)
    done = minimise(graph, Settings("none", tolerance=1e-14))
    least = done.graph.chi2()
    assert least == pytest.approx(done.objective[-1])
    assert least < 0.1 * graph.chi2()
    for k in range(1, 20):
        for axis in range(6):
            step = np.zeros(6)
            step[axis] = 1e-4
            values = []
            for sign in (1, -1):
                poses = done.graph.poses.copy()
                poses[k] = poses[k] @ se3.exp(sign * step)
                values.append(objective(graph, poses))
            assert min(values) > least
            # The slope, in units of the curvature over one standard deviation.
            slope, curvature = (values[0] - values[1]) / 2e-4, (sum(values) - 2 * least) / 1e-8
            assert abs(slope / curvature) < 1e-6


def dense(system: PairSystem, matrix: Blocks) -> Float64:
    """The whole matrix, in the order of the free poses."""
    n, k = len(system.free), system.size
    out = np.zeros((n, k, n, k))
    out[np.arange(n), :, np.arange(n)] = matrix.diagonal
    out[system.rows, :, system.columns] = matrix.below
    out[system.columns, :, system.rows] = np.swapaxes(matrix.below, 1, 2)
    return out.reshape(n * k, n * k)


def test_gradient_and_curvature_match_objective():
    """The assembled system agrees with numerical derivatives, far from the minimum."""
    graph, _, _ = walk(8, 5)
    rng = np.random.default_rng(1)
    poses = graph.poses @ se3.exp(rng.normal(size=(8, 6)) * 0.3)
    i, j = graph.edges.T
    system = PairSystem(8, graph.edges)
    H, g = equations(graph.with_poses(poses).residuals(), graph.information)
    matrix, gradient = system.relative(H, g, se3.inverse(poses[i]) @ poses[j])

    root = np.linalg.cholesky(graph.information)

    def whitened(x: Float64) -> Float64:
        moved = poses.copy()
        moved[system.free] = poses[system.free] @ se3.exp(x.reshape(-1, 6))
        return np.einsum("mji,mj->mi", root, graph.with_poses(moved).residuals()).ravel()

    h = 1e-6
    numeric = np.stack([(whitened(h * u) - whitened(-h * u)) / (2 * h) for u in np.eye(42)], axis=1)
    scale = np.abs(numeric.T @ numeric).max()
    np.testing.assert_allclose(dense(system, matrix), numeric.T @ numeric, atol=1e-7 * scale)
    expected = numeric.T @ whitened(np.zeros(42))
    np.testing.assert_allclose(gradient.ravel(), expected, atol=1e-7 * np.abs(expected).max())


def test_information_weights_edges():
    """Two measurements of one motion: the mean, weighted by the whole matrix."""
    rng = np.random.default_rng(3)
    roots = rng.normal(size=(2, 6, 6))
    information = roots @ np.swapaxes(roots, 1, 2)
    small = rng.normal(size=(2, 6)) * 1e-4
    edges = [Measured(0, 1, se3.exp(x), W) for x, W in zip(small, information, strict=True)]
    graph = build_graph([0, 1], np.tile(np.eye(4), (2, 1, 1)), edges)
    found = se3.log(minimise(graph, Settings(tolerance=1e-14)).graph.poses[1])
    expected = np.linalg.solve(
        information.sum(0), sum(W @ x for x, W in zip(small, information, strict=True))
    )
    np.testing.assert_allclose(found, expected, atol=5e-8)


@pytest.mark.parametrize("seed", range(3))
def test_false_loops_are_left_out_and_true_loops_kept(seed):
    clean, truth, _ = walk(seed=seed)
    graph, _, false = walk(false=12, seed=seed)
    done = LevenbergMarquardt().optimise(graph)
    np.testing.assert_array_equal(done.weights == 0, false)
    alone = ate(LevenbergMarquardt().optimise(clean).graph.poses, truth)
    assert ate(done.graph.poses, truth) < 1.01 * alone
    plain = LevenbergMarquardt(robust="none").optimise(graph).graph.poses
    assert ate(plain, truth) > 20 * alone


@pytest.mark.parametrize("seed", [0, 4, 5])
def test_false_loop_is_found_despite_weak_odometry(seed):
    """It bends the odometry and then fits; but the other loops contradict it."""
    rng = np.random.default_rng(7)
    graph, truth, false = walk(loops=5, false=2, seed=seed)
    i, j = graph.edges[:59].T
    measurements = graph.measurements.copy()
    noise = se3.exp(rng.normal(size=(59, 6)) * SIGMA * 10)
    measurements[:59] = se3.inverse(truth[i]) @ truth[j] @ noise
    loose = np.where(graph.loop, 1.0, 0.01)[:, None, None]
    graph = replace(graph, measurements=measurements, information=loose * graph.information)
    plain = LevenbergMarquardt(robust="none").optimise(graph).graph
    r = plain.residuals()[false]
    assert np.einsum("mi,mij,mj->m", r, plain.information[false], r).max() < 6
    done = LevenbergMarquardt().optimise(graph)
    np.testing.assert_array_equal(done.weights == 0, false)
    assert ate(done.graph.poses, truth) < 0.5 * ate(plain.poses, truth)


def test_uncritical_outlier_loop_is_kept():
    graph, _, _ = walk(60, 600)
    measurements = graph.measurements.copy()
    # One is off by 11 standard deviations, among 600 that share a squared error of 3600.
    off = np.zeros(6)
    off[0] = 11 * SIGMA[0]
    measurements[-1] = measurements[-1] @ se3.exp(off)
    graph = replace(graph, measurements=measurements)
    plain = LevenbergMarquardt(robust="none").optimise(graph)
    done = LevenbergMarquardt().optimise(graph)
    assert done.weights.all()
    np.testing.assert_array_equal(done.graph.poses, plain.graph.poses)
    measurements[-1] = measurements[-1] @ se3.exp(10 * off)
    assert LevenbergMarquardt().optimise(graph).weights[-1] == 0


def test_without_false_loops_result_is_least_squares():
    graph, _, _ = walk()
    plain = LevenbergMarquardt(robust="none").optimise(graph)
    done = LevenbergMarquardt().optimise(graph)
    np.testing.assert_array_equal(done.graph.poses, plain.graph.poses)
    assert done.objective == plain.objective
    assert (done.weights == 1).all()
    # Standard deviations that are too small by a factor of three do not make true loops false.
    boast = replace(graph, information=9 * graph.information)
    assert (LevenbergMarquardt().optimise(boast).weights == 1).all()


def test_best_start_does_not_depend_on_given_poses():
    graph, _, _ = walk()
    least = LevenbergMarquardt(robust="none").optimise(graph).graph.chi2()
    rng = np.random.default_rng(0)
    lost = graph.poses @ se3.exp(rng.normal(size=(len(graph.ids), 6)) * 2)
    lost[0] = graph.poses[0]
    for robust_kernel in ("none", "huber"):
        optimiser = LevenbergMarquardt(robust=robust_kernel, start="best")
        done = optimiser.optimise(graph.with_poses(lost))
        assert done.graph.chi2() == pytest.approx(least, rel=1e-5)
        assert (np.diff(done.objective) <= 0).all()
    # Good poses are not left for worse ones.
    solved = LevenbergMarquardt(robust="none").optimise(graph).graph
    again = LevenbergMarquardt(robust="none", start="best").optimise(solved)
    assert len(again.objective) <= 2
    np.testing.assert_allclose(again.graph.poses, solved.poses, atol=1e-5)


def test_overstated_information_does_not_reject_the_majority():
    graph, truth, bad = walk(false=3, seed=4)
    boast = replace(graph, information=1e4 * graph.information)
    assert (LevenbergMarquardt().optimise(boast).weights[graph.loop] == 0).mean() > 0.5
    done = LevenbergMarquardt(start="best").optimise(boast)
    assert (done.weights[graph.loop & ~bad] == 1).all()
    assert done.improved
    assert ate(done.graph.poses, truth) < ate(graph.poses, truth)


@pytest.mark.parametrize("kernel", ["huber", "cauchy", "geman-mcclure", "dcs", "switchable"])
def test_robust_kernels(kernel):
    """Weights are the slope of the cost; small errors have full weight, large ones less."""
    x = np.array([1e-6, 0.5, 3.9, 4.1, 7.0, 40.0, 1e4])
    h = 1e-6 * x
    slope = (robust.cost(kernel, x + h, 4.0) - robust.cost(kernel, x - h, 4.0)) / (2 * h)
    np.testing.assert_allclose(robust.weight(kernel, x, 4.0), slope, rtol=1e-5)
    assert robust.weight(kernel, x, 4.0)[0] == pytest.approx(1, abs=1e-5)
    assert robust.weight(kernel, x, 4.0)[-1] < 0.03
    graph, truth, _ = walk(false=3, seed=4)
    done = LevenbergMarquardt(robust=kernel, gate=16.0).optimise(graph)
    assert (np.diff(done.objective) <= 0).all()
    plain = LevenbergMarquardt(robust="none").optimise(graph)
    assert ate(done.graph.poses, truth) < 0.8 * ate(plain.graph.poses, truth)


@pytest.mark.parametrize(
    ("name", "least"), [("sphere", 63789.07892761), ("parking-garage", 0.63419240)]
)
def test_benchmark_graphs_match_gtsam(shared_data, name, least):
    """Half the squared error, as GTSAM 4.3's Levenberg-Marquardt reports it from the same start."""
    done = LevenbergMarquardt().optimise(read_g2o(shared_data / "pose_graphs" / f"{name}.g2o"))
    assert done.converged
    assert done.graph.chi2() / 2 < 1.00001 * least
    assert (done.weights == 1).all()
