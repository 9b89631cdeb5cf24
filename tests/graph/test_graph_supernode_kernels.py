"""The supernodal factorisation and selected inversion against dense linear algebra."""

from __future__ import annotations

import numpy as np
import pytest

from tofuse.engine.arrays import Float64
from tofuse.engine.graph import supernode_kernels as kernels


class Sparse:
    """A sparse symmetric matrix of n x n random blocks of size k, and the same as a dense one."""

    def __init__(self, n: int, links: int, k: int = 6, shift: float = 1.0) -> None:
        rng = np.random.default_rng(n)
        present = np.eye(n, dtype=bool)
        self.k, self.dense = k, shift * np.eye(k * n)
        for _ in range(links):
            i, j = rng.choice(n, 2, replace=False)
            present[i, j] = present[j, i] = True
            J = np.zeros((k, k * n))
            J[:, k * i : k * i + k], J[:, k * j : k * j + k] = rng.normal(size=(2, k, k))
            self.dense += J.T @ J
        columns = [np.flatnonzero(present[c:, c]) + c for c in range(n)]
        self.start = np.concatenate([[0], np.cumsum([len(c) for c in columns])]).astype(np.int64)
        self.rows = np.concatenate(columns).astype(np.int64)
        self.columns = np.repeat(np.arange(n), np.diff(self.start))
        self.panels = kernels.layout(*kernels.fill_in(self.start, self.rows), k)
        self.places = kernels.entry_indices(self.panels, self.rows, self.columns)

    def blocks(self, dense: Float64) -> Float64:
        k = self.k
        places = zip(self.rows, self.columns, strict=True)
        return np.array([dense[k * i : k * i + k, k * j : k * j + k] for i, j in places])

    def factor(self) -> tuple[Float64, Float64] | None:
        values = np.zeros(self.panels.value_start[-1])
        values[self.places] = self.blocks(self.dense)
        signs = np.empty(len(self.dense))
        return (values, signs) if kernels.factorise(self.panels, values, signs) else None


SIZES = [(1, 0, 6), (2, 1, 6), (9, 12, 6), (30, 45, 6), (12, 60, 6), (90, 900, 6), (40, 60, 7)]


@pytest.mark.parametrize(("n", "links"), [(1, 0), (2, 1), (9, 12), (30, 45), (12, 60)])
def test_pattern_is_that_of_the_factor(n: int, links: int) -> None:
    A = Sparse(n, links)
    start, rows = kernels.fill_in(A.start, A.rows)
    L = np.linalg.cholesky(A.dense).reshape(n, 6, n, 6)
    assert {(i, k) for k in range(n) for i in rows[start[k] : start[k + 1]]} == {
        (i, k) for k in range(n) for i in range(k, n) if np.abs(L[i, :, k]).max() > 0
    }
    assert all((np.diff(rows[start[k] : start[k + 1]]) > 0).all() for k in range(n))


@pytest.mark.parametrize(("n", "links", "k"), SIZES)
def test_solution_and_inverse_are_those_of_the_dense_matrix(n: int, links: int, k: int) -> None:
    A = Sparse(n, links, k)
    factor = A.factor()
    assert factor is not None
    values, signs = factor
    assert (signs == 1).all()
    right = np.random.default_rng(0).normal(size=(n * k, 3))
    x = right.copy()
    kernels.solve(A.panels, values, signs, x)
    np.testing.assert_allclose(A.dense @ x, right, atol=1e-11)
    kernels.invert(A.panels, values)
    np.testing.assert_allclose(values[A.places], A.blocks(np.linalg.inv(A.dense)), atol=1e-12)


def test_indefinite_matrices_are_solved_and_their_signs_are_known() -> None:
    A = Sparse(30, 45, shift=-0.5)
    factor = A.factor()
    assert factor is not None
    negative = (np.linalg.eigvalsh(A.dense) < 0).sum()  # as many, by Sylvester's law of inertia
    assert (factor[1] < 0).sum() == negative > 0
    x = np.ones((180, 1))
    kernels.solve(A.panels, *factor, x)
    np.testing.assert_allclose(A.dense @ x, 1, atol=1e-8)


@pytest.mark.parametrize("value", [0.0, np.nan])
def test_singular_matrices_are_rejected(value: float) -> None:
    A = Sparse(5, 6)
    A.dense[26], A.dense[:, 26] = 0, 0
    A.dense[26, 26] = value
    assert A.factor() is None
