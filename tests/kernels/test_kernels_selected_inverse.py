"""The kernels of the selected inverse against dense linear algebra."""

from __future__ import annotations

import numpy as np
import pytest

from tofuse.arrays import Float64, Int64
from tofuse.kernels.selected_inverse import factorise, fill_in, invert


def some_matrix(n: int, links: int, seed: int) -> tuple[Float64, Int64, Int64]:
    """A dense (6n, 6n) positive matrix of sparse blocks, and the pattern of its lower triangle."""
    rng = np.random.default_rng(seed)
    present = np.eye(n, dtype=bool)
    A = np.zeros((6 * n, 6 * n))
    for _ in range(links):
        i, j = rng.choice(n, 2, replace=False)
        present[i, j] = present[j, i] = True
        J = np.zeros((6, 6 * n))
        J[:, 6 * i : 6 * i + 6], J[:, 6 * j : 6 * j + 6] = rng.normal(size=(2, 6, 6))
        A += J.T @ J
    A += np.eye(6 * n)
    columns = [np.flatnonzero(present[k:, k]) + k for k in range(n)]
    start = np.concatenate([[0], np.cumsum([len(c) for c in columns])]).astype(np.int64)
    return A, start, np.concatenate(columns).astype(np.int64)


def block(A: Float64, i: int, j: int) -> Float64:
    return A[6 * i : 6 * i + 6, 6 * j : 6 * j + 6]


@pytest.mark.parametrize(("n", "links"), [(1, 0), (2, 1), (9, 12), (30, 45), (12, 60)])
def test_entries_match_dense_inverse(n, links):
    A, start, rows = some_matrix(n, links, seed=n)
    L, inverse = np.linalg.cholesky(A), np.linalg.inv(A)
    full_start, full_rows = fill_in(start, rows)
    places = [(i, k) for k in range(n) for i in full_rows[full_start[k] : full_start[k + 1]]]
    # The pattern holds exactly the non-zero blocks of the factor.
    expected = {(i, k) for k in range(n) for i in range(k, n) if np.abs(block(L, i, k)).max() > 0}
    assert len(places) == len(set(places))
    assert set(places) == expected
    assert all((np.diff(full_rows[full_start[k] : full_start[k + 1]]) > 0).all() for k in range(n))
    values = np.array([block(A, i, k) for i, k in places])
    assert factorise(full_start, full_rows, values)
    np.testing.assert_allclose(values, [block(L, i, k) for i, k in places], atol=1e-10)
    invert(full_start, full_rows, values)
    np.testing.assert_allclose(values, [block(inverse, i, k) for i, k in places], atol=1e-10)


def test_indefinite_matrix_is_detected():
    A, start, rows = some_matrix(5, 6, seed=1)
    A[26, 26] = -1
    full_start, full_rows = fill_in(start, rows)
    places = [(i, k) for k in range(5) for i in full_rows[full_start[k] : full_start[k + 1]]]
    assert not factorise(full_start, full_rows, np.array([block(A, i, k) for i, k in places]))
