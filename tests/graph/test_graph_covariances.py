"""Covariances of a graph agree with the errors over repeated solutions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tofuse.engine.geometry import se3
from tofuse.engine.graph.graph import Gravity, Measured, Optimisation, PoseGraph, build_graph
from tofuse.engine.graph.graph_covariances import (
    MIN_WEIGHT,
    Branches,
    GraphCovariances,
    accepted_only,
    loop_errors,
    relative_covariance,
)
from tofuse.engine.graph.levenberg import LevenbergMarquardt
from tofuse.engine.graph.solver import solve
from walks import round_walk, step_of, true_poses

N = 12
STEP = step_of(N)
TRUE = true_poses(N)


def walk(rng: np.random.Generator | None = None, *, loops=((0, N - 1), (2, 9))) -> PoseGraph:
    return round_walk(N, rng, loops)


@pytest.fixture(scope="module")
def drawn() -> list[PoseGraph]:
    rng = np.random.default_rng(4)
    return [walk(rng) for _ in range(120)]


@pytest.fixture(scope="module")
def solved(drawn) -> list[PoseGraph]:
    return [LevenbergMarquardt(robust="none").optimise(graph).graph for graph in drawn]


def test_covariances_match_repeated_solutions(solved) -> None:
    C = GraphCovariances(walk()).of_poses
    np.testing.assert_array_equal(C[0], 0)
    errors = np.stack([se3.log(se3.inverse(TRUE) @ g.poses) for g in solved])
    seen = np.einsum("tna,tnb->nab", errors, errors) / len(errors)
    for k in (1, 5, N - 1):
        ratio = np.linalg.eigvalsh(np.linalg.solve(np.linalg.cholesky(C[k]), seen[k]) @ (
            np.linalg.inv(np.linalg.cholesky(C[k])).T
        ))  # fmt: skip
        assert ratio.min() > 0.4
        assert ratio.max() < 1.9
        assert ratio.mean() == pytest.approx(1, abs=0.2)


def test_loop_errors_are_chi_square_distributed(drawn) -> None:
    d = np.stack([loop_errors(g, g.poses) for g in drawn])
    assert d.shape == (len(drawn), 2)
    assert d.mean(0) == pytest.approx(6, abs=1.2)
    assert 0.84 < np.mean(d < 10.64) < 0.96  # nine in ten
    # A systematic error is no noise.
    graph = drawn[0]
    bent = graph.measurements.copy()
    bent[graph.loop] = bent[graph.loop] @ se3.exp(np.array([0.1, 0, 0, 0, 0, 0]))
    assert (loop_errors(replace(graph, measurements=bent), graph.poses) > 30).all()
    # Gravity is not odometry.
    down = np.swapaxes(graph.poses[:, :3, :3], 1, 2) @ [0, 0, 1]
    gravity = Gravity(np.arange(N), down, np.full(N, 0.01), 25.0)
    np.testing.assert_array_equal(loop_errors(replace(graph, gravity=gravity), graph.poses), d[0])


def test_loops_between_parts_without_odometry_have_no_error() -> None:
    graph = walk()
    keep = np.arange(len(graph.edges)) != 4
    torn = replace(
        graph,
        edges=graph.edges[keep],
        measurements=graph.measurements[keep],
        information=graph.information[keep],
        loop=graph.loop[keep],
    )
    assert np.isnan(loop_errors(torn, torn.poses)).all()
    assert np.isfinite(GraphCovariances(torn).of_poses).all()  # the loops connect them
    alone = replace(torn, information=torn.information * ~torn.loop[:, None, None])
    assert np.isnan(GraphCovariances(alone).of_poses[1:]).all()


def test_disconnected_parts_have_no_covariance() -> None:
    steps = [Measured(k, k + 1, STEP, np.eye(6)) for k in (0, 1, 3, 4)]
    C = GraphCovariances(build_graph(range(6), TRUE[:6], steps)).of_poses
    assert np.isfinite(C[:3]).all()
    assert np.isnan(C[3:]).all()
    one = build_graph([7], TRUE[:1], [])
    np.testing.assert_array_equal(GraphCovariances(one).of_poses, np.zeros((1, 6, 6)))


def test_left_out_edges_are_removed() -> None:
    graph = walk()
    weights = np.ones(len(graph.edges))
    assert accepted_only(Optimisation(graph, (), True)).graph is graph
    weights[-2:] = MIN_WEIGHT / 2, 2 * MIN_WEIGHT
    kept = accepted_only(Optimisation(graph, (), True, weights))
    assert kept.graph.loop.sum() == 1
    assert kept.graph.edges[-1].tolist() == [2, 9]
    assert kept.weights is not None
    assert kept.weights[-1] == 2 * MIN_WEIGHT


def test_relative_covariance_of_chain_is_that_of_edges_between() -> None:
    rng = np.random.default_rng(3)
    motions = se3.exp(0.3 * rng.standard_normal((6, 6)))
    poses = [np.eye(4)]
    for motion in motions:
        poses.append(poses[-1] @ motion)
    sigmas = rng.uniform(0.5, 2, (6, 6)) * [0.01, 0.01, 0.01, 0.005, 0.005, 0.005]
    edges = [Measured(k, k + 1, motions[k], np.diag(1 / sigmas[k] ** 2)) for k in range(6)]
    C = GraphCovariances(build_graph(range(7), np.stack(poses), edges, ())).of_poses
    between = relative_covariance(se3.inverse(poses[2]) @ poses[3], C[2], C[3])
    np.testing.assert_allclose(between, np.diag(sigmas[2] ** 2), atol=1e-12)
    far = relative_covariance(se3.inverse(poses[2]) @ poses[6], C[2], C[6])
    assert np.linalg.eigvalsh(far - np.diag(sigmas[5] ** 2)).min() > 0
    assert not relative_covariance(np.eye(4), np.full((6, 6), np.nan), C[3]).any()
    # An uncertain branch does not give an indefinite covariance.
    assert np.linalg.eigvalsh(relative_covariance(np.eye(4), C[6], C[1])).min() > -1e-15


def with_branches(graph: PoseGraph) -> PoseGraph:
    """Add a branch of two poses to the fourth pose, and another edge's reverse to the sixth."""
    n = len(graph.ids)
    rng = np.random.default_rng(3)
    ends = [(3, n), (n, n + 1), (n + 2, 5)]
    Z = se3.exp(0.1 * rng.normal(size=(3, 6)))
    J = rng.normal(size=(3, 6, 6)) * 20
    T = graph.poses
    poses = [T[3] @ Z[0], T[3] @ Z[0] @ Z[1], T[5] @ se3.inverse(Z[2])]
    return PoseGraph(
        np.arange(n + 3),
        np.concatenate([T, poses]),
        np.concatenate([graph.edges, ends]),
        np.concatenate([graph.measurements, Z]),
        np.concatenate([graph.information, J @ np.swapaxes(J, 1, 2)]),
        np.append(graph.loop, np.zeros(3, bool)),
    )


def test_covariances_of_branches_are_those_of_the_whole_system() -> None:
    graph = with_branches(LevenbergMarquardt().optimise(walk()).graph)
    some = np.array([2, 3, N, N + 1, N + 2])
    known = GraphCovariances(graph)
    # The solver itself removes no branches.
    factor = solve(graph.poses, graph.edges, graph.measurements, graph.information).factor()
    assert factor is not None
    np.testing.assert_allclose(known.of_poses, factor.covariances(), atol=1e-9)
    np.testing.assert_allclose(known.joint(some), factor.joint_covariance(some), atol=1e-9)


def test_branches_follow_the_optimised_poses() -> None:
    graph = with_branches(walk(np.random.default_rng(5)))
    found = LevenbergMarquardt().optimise(graph)
    whole = solve(graph.poses, graph.edges, graph.measurements, graph.information).poses
    np.testing.assert_allclose(found.graph.poses, whole, atol=1e-5)
    np.testing.assert_allclose(found.graph.residuals()[-3:], 0, atol=1e-12)


def test_branches_with_error_are_corrected() -> None:
    graph = with_branches(LevenbergMarquardt().optimise(walk()).graph)
    poses = graph.poses.copy()
    poses[-1, 0, 3] += 0.1
    found = LevenbergMarquardt().optimise(graph.with_poses(poses))
    assert found.improved
    assert (np.diff(found.objective) <= 0).all()
    np.testing.assert_allclose(found.graph.poses, graph.poses, atol=1e-6)


def test_degenerate_edges_are_in_no_branch() -> None:
    graph = with_branches(walk())
    information = graph.information.copy()
    information[-1, 2], information[-1, :, 2] = 0, 0
    found = Branches(replace(graph, information=information), np.zeros(N + 3, bool))
    np.testing.assert_array_equal(np.flatnonzero(found.vertices), [N, N + 1])
