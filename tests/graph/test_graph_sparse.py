"""Pose graphs whose factor would be too large: which pairs are left out, and what that costs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from threadpoolctl import ThreadpoolController

from tofuse.engine.arrays import Float64, Intp
from tofuse.engine.connections import parts_of
from tofuse.engine.geometry import se3
from tofuse.engine.graph import sparse
from tofuse.engine.graph.graph import PoseGraph
from tofuse.engine.graph.graph_covariances import GraphCovariances
from tofuse.engine.graph.levenberg import LevenbergMarquardt
from tofuse.engine.graph.sparse import factor_size, sparsify

PLACES, ROUNDS = 30, 20
LIMIT = 400_000  # the factor of all pairs has about twice as many values


def rounds(links: int, seed: int) -> Intp:
    """Edges (m, 2) of a camera that passes the same places round after round."""
    rng = np.random.default_rng(seed)
    n = PLACES * ROUNDS
    chain = np.stack([np.arange(n - 1), np.arange(1, n)], 1)
    place = rng.integers(0, PLACES, links)
    a, b = np.sort(rng.integers(0, ROUNDS, (links, 2)), 1).T
    far = np.stack([PLACES * a + place, PLACES * b + place], 1)[a < b]
    return np.unique(np.concatenate([chain, far]), axis=0).astype(np.intp)


def graph_of(edges: Intp, seed: int) -> tuple[PoseGraph, Float64]:
    """A graph of these edges with noise of 1 cm and 0.5 degrees, and its true poses."""
    rng = np.random.default_rng(seed)
    place = np.arange(PLACES * ROUNDS) % PLACES
    xi = np.zeros((len(place), 6))
    xi[:, 4] = 2 * np.pi * place / PLACES - np.pi
    truth = np.asarray(se3.exp(xi))
    truth[:, :3, 3] = 2 * truth[:, :3, 2]
    truth = se3.inverse(truth[0]) @ truth
    sigma = np.array([0.01] * 3 + [np.radians(0.5)] * 3)
    i, j = edges.T
    measured = se3.inverse(truth[i]) @ truth[j] @ se3.exp(rng.normal(size=(len(i), 6)) * sigma)
    information = np.tile(np.diag(sigma**-2), (len(i), 1, 1))
    start = truth @ se3.exp(rng.normal(size=(len(truth), 6)) * 0.003)
    start[0] = np.eye(4)
    loop = j - i > 1
    return PoseGraph(np.arange(len(truth)), start, edges, measured, information, loop), truth


def test_all_pairs_are_used_if_they_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    for limit in (36 * 600 * 600, 36 * 60_000):  # without and with analysis
        monkeypatch.setattr(sparse, "MAX_FACTOR", limit)
        assert sparsify(PLACES * ROUNDS, rounds(600, 1)).all()


@pytest.mark.parametrize("seed", range(3))
def test_factor_is_bounded_and_everything_remains_connected(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    edges = rounds(3000, seed)
    n = PLACES * ROUNDS
    assert factor_size(n, edges) > 1.5 * LIMIT
    monkeypatch.setattr(sparse, "MAX_FACTOR", LIMIT)
    chosen = sparsify(n, edges)
    assert LIMIT / 2 < factor_size(n, edges[chosen]) <= LIMIT
    i, j = edges.T
    assert chosen[j - i == 1].all()
    # Two chains that only a single far pair joins; in both directions, and twice.
    apart = edges[(i < n // 2) == (j < n // 2)]
    edges = np.concatenate([apart, [[3, n - 5], [n - 5, 3]], apart[:50]])
    monkeypatch.setattr(sparse, "MAX_FACTOR", LIMIT // 2)
    chosen = sparsify(n, edges)
    assert not chosen.all()
    np.testing.assert_array_equal(chosen[:50], chosen[-50:])
    assert (parts_of(n, edges[chosen]) == 0).all()


def test_false_loops_are_rejected_even_if_they_are_left_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    graph, _ = graph_of(rounds(3000, 6), 6)
    monkeypatch.setattr(sparse, "MAX_FACTOR", LIMIT)
    chosen = sparsify(len(graph.ids), graph.edges)
    assert (~chosen).sum() > 500
    false = np.flatnonzero(~chosen)[::20]
    measured = graph.measurements.copy()
    measured[false] = measured[false] @ se3.exp(np.array([0.5, 0, 0, 0, 0.5, 0]))
    done = LevenbergMarquardt().optimise(replace(graph, measurements=measured))
    assert done.weights is not None
    np.testing.assert_array_equal(np.flatnonzero(done.weights < 0.5), false)


def test_poses_and_covariances_are_nearly_as_good(monkeypatch: pytest.MonkeyPatch) -> None:
    graph, truth = graph_of(rounds(3000, 4), 4)
    whole = LevenbergMarquardt().optimise(graph).graph
    known = GraphCovariances(whole).of_poses
    monkeypatch.setattr(sparse, "MAX_FACTOR", LIMIT)
    assert (~sparsify(len(truth), graph.edges)).sum() > 500
    part = LevenbergMarquardt().optimise(graph).graph
    stated = GraphCovariances(part).of_poses
    # Fewer measurements: larger in every direction, but little.
    assert np.linalg.eigvalsh(stated - known).min() > -1e-12
    sigma, more = (np.sqrt(np.trace(C[1:, :3, :3], axis1=1, axis2=2)) for C in (known, stated))
    assert np.median(more / sigma) < 1.3
    # The poses differ by as much as that, and their errors are as stated.
    errors = [np.linalg.norm((g.poses - truth)[:, :3, 3], axis=1) for g in (whole, part)]
    assert np.median(errors[1]) < 1.4 * np.median(errors[0])
    e = se3.log(se3.inverse(part.poses[1:]) @ truth[1:])
    assert 4 < np.median(np.einsum("ni,nij,nj->n", e, np.linalg.inv(stated[1:]), e)) < 8


def test_result_is_independent_of_blas_threads() -> None:
    """Products of large panels would differ."""
    edges = rounds(3000, 5)
    controller = ThreadpoolController()
    found = []
    for threads in (1, 2):
        with controller.limit(limits=threads, user_api="blas"):
            graph, _ = graph_of(edges, 5)
            found.append(GraphCovariances(LevenbergMarquardt().optimise(graph).graph).of_poses)
    np.testing.assert_array_equal(*found)
