"""The kd-tree against brute-force search."""

from __future__ import annotations

import numpy as np
import pytest

from tofuse.engine.errors import InputError
from tofuse.engine.geometry.kdtree import KdTree


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


def test_all_points_within_a_distance_are_found():
    rng = np.random.default_rng(3)
    points, queries = rng.normal(size=(300, 3)), rng.normal(size=(40, 3))
    queries[7] = 50.0  # has none
    first, index, distance = KdTree(points).within(queries, 0.8)
    apart = np.linalg.norm(queries[:, None] - points, axis=2)
    assert len(first) == 41
    for k in range(40):
        found = index[first[k] : first[k + 1]]
        assert sorted(found) == np.flatnonzero(apart[k] <= 0.8).tolist()
        np.testing.assert_allclose(distance[first[k] : first[k + 1]], apart[k, found])
