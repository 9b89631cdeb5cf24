"""Chordal initialisation, and the optimiser where a descent from the given poses fails."""

from __future__ import annotations

import numpy as np
import pytest

from tofuse.engine.arrays import Bool, Float64, Intp
from tofuse.engine.geometry import se3
from tofuse.engine.graph.gnc import GraduatedNonConvexity, chordal_poses
from tofuse.engine.graph.graph import PoseGraph
from tofuse.engine.graph.levenberg import LevenbergMarquardt, minimise
from tofuse.engine.graph.minimisation import Problem
from tofuse.engine.graph.robust import Settings
from tofuse.lab.world.laps import drifting_laps
from walked_graph import SIGMA, walk

SOMEWHERE = se3.exp(np.array([3.0, -1, 2, 0.5, -2, 1]))


def first_only(n: int) -> Bool:
    return np.arange(n) == 0


def chordal(graph: PoseGraph, fixed: Bool) -> Float64 | None:
    return chordal_poses(graph.poses, graph.edges, graph.measurements, graph.information, fixed)


def test_exact_measurements_give_exact_poses_from_any_start():
    graph, truth, _ = walk(30, 12)
    i, j = graph.edges.T
    n = len(truth)
    rng = np.random.default_rng(0)
    anywhere = se3.exp(rng.normal(size=(n, 6)))
    anywhere[0] = SOMEWHERE @ truth[0]
    exact = se3.inverse(truth[i]) @ truth[j]
    found = chordal_poses(anywhere, graph.edges, exact, graph.information, first_only(n))
    assert found is not None
    np.testing.assert_allclose(found, SOMEWHERE @ truth, atol=1e-9)


def test_each_part_starts_at_its_fixed_pose():
    graph, truth, _ = walk(20, 8)
    n = len(truth)
    edges: Intp = np.concatenate([graph.edges, graph.edges + n])
    i, j = graph.edges.T
    exact = np.tile(se3.inverse(truth[i]) @ truth[j], (2, 1, 1))
    poses = np.concatenate([truth, SOMEWHERE @ truth])
    information = np.tile(graph.information, (2, 1, 1))
    found = chordal_poses(poses, edges, exact, information, np.arange(2 * n) % n == 0)
    assert found is not None
    np.testing.assert_allclose(found, poses, atol=1e-9)


def test_weights_are_those_of_the_edges():
    """Of two measurements of one motion, the certain one counts."""
    T = se3.exp(np.array([[0.1, 0, 0, 0, 0, 0.1], [0.5, 0, 0, 0, 0, 0.3]]))
    pairs = np.array([[0, 1], [0, 1]])
    information = np.stack([np.eye(6) * 1e8, np.eye(6)])
    found = chordal_poses(np.tile(np.eye(4), (2, 1, 1)), pairs, T, information, first_only(2))
    assert found is not None
    np.testing.assert_allclose(found[1], T[0], atol=1e-6)


def test_result_is_near_the_minimum():
    """With the noise of a usual graph, a descent from it ends in the least squares solution."""
    graph, _, _ = walk(40, 20)
    found = chordal(graph, first_only(40))
    assert found is not None
    best = minimise(graph, Settings("none", tolerance=1e-12)).graph
    assert np.abs(se3.log(se3.inverse(best.poses) @ found) / SIGMA).max() < 3
    again = minimise(graph.with_poses(found), Settings("none", tolerance=1e-12)).graph
    np.testing.assert_allclose(again.poses, best.poses, atol=1e-6)


def test_undetermined_poses_give_none():
    graph, _, _ = walk(10, 4)
    information = graph.information.copy()
    information[(graph.edges == 5).any(1)] = 0.0
    poses, edges = graph.poses, graph.edges
    assert chordal_poses(poses, edges, graph.measurements, information, first_only(10)) is None


def test_optimiser_finds_the_minimum_where_descent_from_odometry_does_not():
    graph, truth = drifting_laps(30, 12, 60.0)
    n = len(truth)
    problem = Problem(graph.edges, graph.measurements, graph.information, first_only(n), None)
    alone = GraduatedNonConvexity(problem, graph.poses, graph.loop, Settings())
    assert not alone.fits_all()
    alone.select()
    assert np.linalg.norm((alone.descent.poses - truth)[:, :3, 3], axis=1).max() > 1

    done = LevenbergMarquardt().optimise(graph)
    assert done.converged
    assert done.weights is not None
    assert (done.weights == 1).all()
    assert np.linalg.norm((done.graph.poses - truth)[:, :3, 3], axis=1).max() < 0.05
    best = LevenbergMarquardt().optimise(graph.with_poses(truth))
    assert done.objective[-1] == pytest.approx(best.objective[-1], rel=1e-6)


def test_loops_are_rejected_if_the_given_poses_are_better():
    """Two loops contradict odometry, and each other: the poses stay, without both."""
    graph, truth, _ = walk(12, 0)
    wrong = se3.exp(np.array([[0.8, 0, 0, 0, 0, 0], [-0.8, 0, 0, 0, 0, 0]]))
    loops = np.array([[0, 8], [1, 9]])
    measured = se3.inverse(truth[loops[:, 0]]) @ truth[loops[:, 1]] @ wrong
    graph = PoseGraph(
        graph.ids,
        graph.poses,
        np.concatenate([graph.edges, loops]),
        np.concatenate([graph.measurements, measured]),
        np.concatenate([graph.information, np.tile(np.eye(6) * 1e4, (2, 1, 1))]),
        np.append(graph.loop, [True, True]),
    )
    done = LevenbergMarquardt().optimise(graph)
    np.testing.assert_array_equal(done.graph.poses, graph.poses)
    assert done.weights is not None
    np.testing.assert_array_equal(done.weights[-2:], 0)
