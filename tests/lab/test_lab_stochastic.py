"""Stochastic gradient descent over a pose graph: claims of Olson's paper."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tofuse.engine.geometry import se3
from tofuse.engine.graph.graph import Measured, PoseGraph, build_graph
from tofuse.engine.graph.levenberg import LevenbergMarquardt
from tofuse.lab.methods.stochastic import Stochastic


def grid(side: int, noise: float, seed: int) -> PoseGraph:
    """A camera on a boustrophedon path over a square, with a loop to the previous lane per step."""
    rng = np.random.default_rng(seed)
    truth = []
    for row in range(side):
        lane = range(side) if row % 2 == 0 else range(side - 1, -1, -1)
        for column in lane:
            T = se3.pose(
                se3.so3_exp([0.0, 0.0 if row % 2 == 0 else np.pi - 0.01, 0.0]),
                [column, 0.1 * np.sin(column), row],
            )
            truth.append(T)
    n = side * side
    place = {(round(T[0, 3]), round(T[2, 3])): k for k, T in enumerate(truth)}

    def edge(i: int, j: int) -> Measured:
        T = se3.inverse(truth[i]) @ truth[j] @ se3.exp(rng.normal(size=6) * noise)
        return Measured(i, j, T, np.eye(6) / noise**2)

    steps = [edge(k, k + 1) for k in range(n - 1)]
    loops = [
        edge(place[c, r], place[c, r + 1])
        for r in range(side - 1)
        for c in range(side)
        if abs(place[c, r] - place[c, r + 1]) > 1
    ]
    poses = [np.eye(4)]
    for step in steps:
        poses.append(poses[-1] @ step.T_i_j)
    return build_graph(range(n), np.array(poses), steps, loops)


@pytest.mark.nightly
def test_sgd_approaches_least_squares_from_odometry():
    graph = grid(6, 0.03, 0)
    least = LevenbergMarquardt().optimise(graph).graph.chi2()
    found = Stochastic().optimise(graph)
    assert found.graph.chi2() < 0.15 * graph.chi2()
    assert found.graph.chi2() < 1.5 * least
    np.testing.assert_array_equal(found.graph.poses[0], graph.poses[0])


def test_sgd_converges_from_random_poses():
    """A few rounds remove most of the error, and least squares converges from there."""
    for seed in range(3):
        graph = grid(5, 0.05, seed)
        rng = np.random.default_rng(100 + seed)
        lost = se3.exp(np.concatenate([rng.normal(0, 5, (25, 3)), rng.normal(0, 1.5, (25, 3))], 1))
        lost[0] = graph.poses[0]
        bad = graph.with_poses(lost)
        least = LevenbergMarquardt().optimise(graph).graph.chi2()
        near = Stochastic(30).optimise(bad).graph
        assert near.chi2() < 0.02 * bad.chi2()
        assert LevenbergMarquardt().optimise(near).graph.chi2() < 1.05 * least


def test_exact_edges_are_satisfied_in_either_direction():
    graph = grid(4, 1e-9, 1)
    edges = graph.edges[:, ::-1].copy()
    turned = replace(graph, edges=edges, measurements=se3.inverse(graph.measurements))
    slips = se3.exp(np.random.default_rng(0).normal(0, 0.2, (16, 6)))
    slips[0] = np.eye(4)
    found = Stochastic().optimise(turned.with_poses(turned.poses @ slips))
    np.testing.assert_allclose(found.graph.poses, graph.poses, atol=0.1)


def test_sgd_solves_connected_parts_separately():
    """Also if their vertices alternate; the first of each stays."""
    a, b = grid(4, 0.03, 0), grid(4, 0.03, 1)
    n, places = len(a.ids), [np.arange(0, 32, 2), np.arange(1, 32, 2)]
    poses = np.empty((2 * n, 4, 4))
    for of_part, graph in zip(places, (a, b), strict=True):
        poses[of_part] = graph.poses
    both = replace(
        a,
        ids=np.arange(2 * n),
        poses=poses,
        edges=np.concatenate([places[0][a.edges], places[1][b.edges]]),
        measurements=np.concatenate([a.measurements, b.measurements]),
        information=np.concatenate([a.information, b.information]),
        loop=np.concatenate([a.loop, b.loop]),
    )
    found = Stochastic(20).optimise(both).graph.poses
    for of_part, graph in zip(places, (a, b), strict=True):
        np.testing.assert_array_equal(found[of_part[0]], graph.poses[0])
        part = graph.with_poses(found[of_part])
        assert part.chi2() < 0.2 * graph.chi2()


def test_sgd_moves_nothing_by_edges_without_information():
    graph = grid(4, 0.03, 0)
    of_rotation = graph.information.copy()
    of_rotation[:, :3] = of_rotation[:, :, :3] = 0
    turned = Stochastic(20).optimise(replace(graph, information=of_rotation)).graph
    assert turned.chi2() < 0.2 * replace(graph, information=of_rotation).chi2()
    none = Stochastic(3).optimise(replace(graph, information=0 * of_rotation))
    np.testing.assert_array_equal(none.graph.poses, graph.poses)
    assert none.objective[-1] == 0
    apart = build_graph([3, 5], graph.poses[:2], [])
    np.testing.assert_array_equal(Stochastic().optimise(apart).graph.poses, apart.poses)
