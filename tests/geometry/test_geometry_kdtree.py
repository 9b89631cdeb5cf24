"""The kd-tree against brute-force search."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tofuse.engine.compute.thread_pool import threads
from tofuse.engine.errors import InputError
from tofuse.engine.geometry.kdtree import KdTree


def all_distances(points, queries):
    """Squared distances (M, N), summed in the order in which the kernel sums."""
    p = np.asarray(points, float).reshape(-1, 3)
    q = np.asarray(queries, float).reshape(-1, 3)
    d = q[:, None, :] - p[None, :, :]
    return d[..., 0] * d[..., 0] + d[..., 1] * d[..., 1] + d[..., 2] * d[..., 2]


def brute_neighbours(points, queries, k):
    d2 = all_distances(points, queries)
    order = np.argsort(d2, axis=1, kind="stable")[:, :k]
    missing = max(0, k - d2.shape[1])
    index = np.pad(order, ((0, 0), (0, missing)), constant_values=-1)
    distance2 = np.take_along_axis(d2, order, 1)
    return index, np.pad(distance2, ((0, 0), (0, missing)), constant_values=np.inf)


def brute_nearest(points, queries, max_distance):
    index, distance2 = brute_neighbours(points, queries, 1)
    index, distance2 = index[:, 0], distance2[:, 0]
    far = ~(distance2 <= max_distance**2) | (index < 0)
    return np.where(far, -1, index), np.where(far, np.inf, distance2)


def clouds(seed, n, kind):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (n, 3))
    if kind == "grid":  # many exact ties
        points = np.round(points * 2) / 2
    elif kind == "line":
        points = np.outer(points[:, 0], [1.0, 2.0, -0.5])
    elif kind == "same":
        points[:] = 0.25
    elif kind == "plane":
        points[:, 2] = 3.0
    return points


KINDS = ["random", "grid", "line", "same", "plane"]


@settings(max_examples=60)
@given(
    seed=st.integers(0, 2**32 - 1),
    n=st.integers(0, 300),
    kind=st.sampled_from(KINDS),
    k=st.integers(1, 7),
    limit=st.sampled_from([0.0, 0.1, 0.5, 1.0, np.inf]),
)
def test_search_matches_brute_force(seed, n, kind, k, limit):
    points = clouds(seed, n, kind)
    rng = np.random.default_rng(seed + 1)
    queries = np.concatenate([points[:20], clouds(seed + 1, 20, kind), rng.uniform(-3, 3, (5, 3))])
    tree = KdTree(points)
    d2 = all_distances(points, queries)
    index, distance2 = tree.nearest(queries, limit)
    np.testing.assert_array_equal(distance2, brute_nearest(points, queries, limit)[1])
    assert_at_distance(d2, index[:, None], distance2[:, None])
    index, distance2 = tree.neighbours(queries, k)
    np.testing.assert_array_equal(distance2, brute_neighbours(points, queries, k)[1])
    assert_at_distance(d2, index, distance2)


def assert_at_distance(d2, index, distance2):
    """Each point found is at its distance, and none is found twice; of ties any may be found."""
    for row, found, distances in zip(d2, index, distance2, strict=True):
        found = found[found >= 0]
        assert len(set(found)) == len(found) == np.isfinite(distances).sum()
        np.testing.assert_array_equal(row[found], distances[: len(found)])


def test_distance_bound_is_inclusive():
    tree = KdTree([[0.0, 0, 0]])
    query = np.array([[0.5, 0, 0]])
    assert tree.nearest(query, 0.5)[0][0] == 0
    assert tree.nearest(query, np.nextafter(0.5, 0))[0][0] == -1


def test_empty_points_or_queries():
    empty = KdTree(np.zeros((0, 3)))
    assert len(empty) == 0
    index, distance2 = empty.nearest(np.zeros((4, 3)))
    np.testing.assert_array_equal(index, -1)
    assert np.isinf(distance2).all()
    index, distance2 = empty.neighbours(np.zeros((4, 3)), 2)
    np.testing.assert_array_equal(index, -1)
    assert np.isinf(distance2).all()
    index, distance2 = KdTree(np.zeros((3, 3))).neighbours(np.zeros((0, 3)), 2)
    assert index.shape == distance2.shape == (0, 2)
    assert index.dtype == np.int64


def test_non_finite_query_has_no_neighbour():
    tree = KdTree(np.random.default_rng(0).normal(size=(100, 3)))
    queries = np.array([[np.nan, 0, 0], [np.inf, 0, 0], [0, 0, 0]])
    assert (tree.nearest(queries)[0] >= 0).tolist() == [False, False, True]
    assert (tree.neighbours(queries, 2)[0] >= 0).all(1).tolist() == [False, False, True]


@pytest.mark.parametrize("bad", [np.zeros((3, 2)), np.zeros(3), [[np.nan, 0, 0]]])
def test_bad_points_are_rejected(bad):
    with pytest.raises(InputError):
        KdTree(bad)


def test_search_is_independent_of_threads():
    rng = np.random.default_rng(8)
    tree = KdTree(np.round(rng.normal(size=(9_000, 3)), 1))
    queries = rng.normal(size=(9_000, 3))
    answers = []
    for count in (1, 2, 3):
        with threads(count):
            answers.append(tree.nearest(queries, 0.2) + tree.neighbours(queries, 3))
    for other in answers[1:]:
        for a, b in zip(answers[0], other, strict=True):
            np.testing.assert_array_equal(a, b)
