"""Pose graphs whose factor would be too large: which pairs are left out, and what that costs."""

from __future__ import annotations

import numpy as np
import pytest
from threadpoolctl import ThreadpoolController

from tofuse.arrays import Float64, Intp
from tofuse.geometry import se3
from tofuse.posegraph import sparse
from tofuse.posegraph.covariances import GraphCovariances
from tofuse.posegraph.graph import PoseGraph
from tofuse.posegraph.levenberg import LevenbergMarquardt
from tofuse.posegraph.sparse import PairSystem, bounded_elimination, factor_blocks, parts_of

PLACES, ROUNDS = 30, 20
LIMIT = 6000  # blocks; the factor of all links has about three times as many


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


def test_all_links_are_used_if_they_fit() -> None:
    i, j = rounds(600, 1).T
    n = PLACES * ROUNDS
    for limit in (n * n, 60_000):  # without and with analysis
        chosen, order = bounded_elimination(n, i, j, limit)
        assert chosen.all()
        assert sorted(order) == list(range(n))


@pytest.mark.parametrize("seed", range(3))
def test_factor_is_bounded_and_everything_remains_connected(seed: int) -> None:
    edges = rounds(3000, seed)
    n = PLACES * ROUNDS
    i, j = edges.T
    _, order = bounded_elimination(n, i, j, n * n)
    assert factor_blocks(i, j, order) > 2 * LIMIT
    chosen, order = bounded_elimination(n, i, j, LIMIT)
    assert LIMIT / 2 < factor_blocks(i[chosen], j[chosen], order) <= LIMIT
    assert chosen[j - i == 1].all()
    # Two chains that only a single far link joins.
    apart = (i < n // 2) == (j < n // 2)
    apart |= (i == 3) & (j == n - 5)
    i, j = np.append(i[apart], 3), np.append(j[apart], n - 5)
    chosen, _ = bounded_elimination(n, i, j, LIMIT // 2)
    assert not chosen.all()
    assert (parts_of(n, np.stack([i[chosen], j[chosen]], 1)) == 0).all()


def test_poses_and_covariances_are_nearly_as_good(monkeypatch: pytest.MonkeyPatch) -> None:
    graph, truth = graph_of(rounds(3000, 4), 4)
    whole = LevenbergMarquardt().optimise(graph).graph
    known = GraphCovariances(whole).of_poses
    monkeypatch.setattr(sparse, "MAX_FACTOR", 36 * LIMIT)
    assert len(PairSystem(len(truth), graph.edges).left_out) > 500
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
