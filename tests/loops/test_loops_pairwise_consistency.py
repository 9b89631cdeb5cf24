"""The maximum set of pairwise consistent measurements, compared with all subsets."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tofuse.engine.loops.joining import maximum_consistent_set


def is_consistent(consistent, some):
    return all(consistent[i, j] for i, j in itertools.combinations(some, 2))


def brute_force(consistent, weights):
    """Weight of the heaviest pairwise consistent subset."""
    n = len(consistent)
    return max(
        sum(weights[k] for k in some)
        for size in range(n + 1)
        for some in itertools.combinations(range(n), size)
        if is_consistent(consistent, some)
    )


@st.composite
def graphs(draw):
    n = draw(st.integers(0, 9))
    upper = draw(st.lists(st.booleans(), min_size=n * n, max_size=n * n))
    consistent = np.triu(np.array(upper, bool).reshape(n, n), 1)
    weights = draw(st.lists(st.integers(1, 9), min_size=n, max_size=n))
    return consistent | consistent.T, weights


@given(graphs())
def test_result_is_heaviest_consistent_subset(graph) -> None:
    consistent, weights = graph
    found = maximum_consistent_set(consistent, weights)
    assert found == sorted(set(found))
    assert is_consistent(consistent, found)
    assert sum(weights[k] for k in found) == brute_force(consistent, weights)


@pytest.mark.parametrize("diagonal", [True, False])
def test_diagonal_is_ignored(diagonal) -> None:
    consistent = np.array([[0, 1, 0], [1, 0, 0], [0, 0, 0]], bool)
    np.fill_diagonal(consistent, diagonal)
    assert maximum_consistent_set(consistent) == [0, 1]
    assert maximum_consistent_set(consistent, [1, 1, 3]) == [2]
    assert maximum_consistent_set(consistent, [1, 1, 1.5]) == [0, 1]


def test_first_of_equal_sets_is_returned() -> None:
    consistent = np.zeros((4, 4), bool)
    consistent[0, 1] = consistent[1, 0] = consistent[2, 3] = consistent[3, 2] = True
    assert maximum_consistent_set(consistent) == [0, 1]
    assert maximum_consistent_set(np.zeros((3, 3), bool)) == [0]
    assert maximum_consistent_set(np.zeros((0, 0), bool)) == []
