"""Castellani's optimisation: the objective of eq 2.10, and claims of the paper."""

from __future__ import annotations

import numpy as np
import pytest

from tofuse.engine.arrays import Float64
from tofuse.engine.geometry import quaternion, se3
from tofuse.engine.graph.castellani import Castellani, Problem
from tofuse.engine.graph.graph import Measured, PoseGraph, build_graph
from tofuse.formats.poses.g2o import read_g2o
from tofuse.lab.experiments.peaks import chain


def turn(axis: int, angle: float) -> Float64:
    """Pure rotation about one axis."""
    w = np.zeros(6)
    w[3 + axis] = angle
    return se3.exp(w)


def circle(n: int, noise: float, seed: int = 0) -> tuple[PoseGraph, Float64]:
    """A camera on a circle, measured with noise; and the true poses."""
    rng = np.random.default_rng(seed)
    step = se3.exp([0.2, 0.0, 0.03, 0.01, 2 * np.pi / n, 0.0])
    truth = np.array([np.linalg.matrix_power(step, k) for k in range(n)])
    relative = se3.inverse(truth[:-1]) @ truth[1:] @ se3.exp(noise * rng.normal(size=(n - 1, 6)))
    closing = se3.inverse(truth[0]) @ truth[-1]
    return chain(relative, [Measured(0, n - 1, closing, np.eye(6))]), truth


def random_graph(rng: np.random.Generator, n: int = 6) -> PoseGraph:
    """Edges between many pairs, all inconsistent."""
    pairs = [(i, j) for i in range(n) for j in range(n) if i != j and rng.random() < 0.4]
    edges = [Measured(i, j, se3.exp(rng.normal(size=6)), np.eye(6)) for i, j in pairs]
    poses = se3.exp(0.7 * rng.normal(size=(n, 6)))
    return build_graph(range(n), poses, edges[::2], edges[1::2])


def literal_objective(graph: PoseGraph) -> float:
    """Eqs 2.10 and 3.5's normalisation, evaluated one edge at a time."""
    T = graph.measurements
    sequential = [k for k in range(len(T)) if not graph.loop[k]]

    def screw(R: Float64) -> float:
        return float(np.arccos(np.clip((np.trace(R) - 1) / 2, -1, 1)))

    angles = [screw(T[k][:3, :3]) for k in sequential]
    lengths = [np.linalg.norm(T[k][:3, 3]) for k in sequential]
    total = 0.0
    for k, (i, j) in enumerate(graph.edges):
        R_i, R_j, R_ij = graph.poses[i, :3, :3], graph.poses[j, :3, :3], T[k, :3, :3]
        t_i, t_j, t_ij = graph.poses[i, :3, 3], graph.poses[j, :3, 3], T[k, :3, 3]
        sigma_a = np.sqrt(np.mean(np.square(angles)))
        sigma_t = np.sqrt(np.mean(np.square(lengths)))
        total += (screw(R_i @ R_ij @ R_j.T) / sigma_a) ** 2
        total += (np.linalg.norm(R_i @ t_ij + t_i - t_j) / sigma_t) ** 2
    return total


def test_squared_residuals_sum_to_equation_2_10():
    rng = np.random.default_rng(1)
    for _ in range(10):
        graph = random_graph(rng)
        problem = Problem.of(graph)
        q = quaternion.from_matrix(graph.poses[:, :3, :3])
        value = problem.objective(q, graph.poses[:, :3, 3])
        assert value == pytest.approx(literal_objective(graph), rel=1e-9)
        # Eq 2.11: norm and sign of a quaternion are irrelevant.
        other = problem.objective(q * rng.uniform(-2, 2, (len(q), 1)), graph.poses[:, :3, 3])
        assert other == pytest.approx(value, rel=1e-9)


def test_result_minimises_literal_objective():
    graph, _ = circle(12, 0.03)
    optimised = Castellani().optimise(graph).graph
    best = literal_objective(optimised)
    rng = np.random.default_rng(3)
    for _ in range(200):
        xi = rng.normal(size=(12, 6)) * 10 ** rng.uniform(-4, -1)
        xi[0] = 0
        assert literal_objective(optimised.with_poses(optimised.poses @ se3.exp(xi))) > best


def test_objective_is_logged_and_never_rises():
    graph, _ = circle(30, 0.05)
    result = Castellani().optimise(graph)
    log = np.array(result.objective)
    assert result.converged
    assert log[0] == pytest.approx(literal_objective(graph))
    assert log[-1] == pytest.approx(literal_objective(result.graph))
    assert (np.diff(log) <= 0).all()
    assert log[-1] < 0.2 * log[0]


def test_loop_error_is_spread_evenly():
    """Castellani's claim: the gap of a loop is shared by all its edges."""
    n = 20
    angle = 2 * np.pi / n
    # Every step rotates 1 degree too far: the sequence misses its start by 20 degrees.
    graph = chain(
        np.repeat(turn(1, angle + np.radians(1))[None], n - 1, axis=0),
        [Measured(n - 1, 0, turn(1, angle + np.radians(1)), np.eye(6))],
    )
    before = np.degrees(se3.angle(se3.exp(graph.residuals())))
    after = np.degrees(se3.angle(se3.exp(Castellani().optimise(graph).graph.residuals())))
    assert before[-1] == pytest.approx(20)
    np.testing.assert_allclose(before[:-1], 0, atol=1e-6)
    np.testing.assert_allclose(after, 1, rtol=1e-6)


def test_rotation_only_or_static_camera_is_handled():
    for step in (turn(1, 0.1), np.eye(4)):
        graph = chain(np.repeat(step[None], 5, axis=0), [Measured(0, 5, turn(1, 0.4), np.eye(6))])
        result = Castellani().optimise(graph)
        assert np.isfinite(result.graph.poses).all()
        assert result.objective[-1] < result.objective[0]


def test_benchmark_graph_is_optimised(shared_data):
    result = Castellani().optimise(read_g2o(shared_data / "pose_graphs" / "parking-garage.g2o"))
    assert result.converged
    assert result.objective[-1] < 2e-4 * result.objective[0]
    # The squared error weighted by the information, which the optimiser does not use,
    # falls from 16727 as well.
    assert result.graph.chi2() < 1.5
