"""Selected inversion of a sparse symmetric matrix of 6 x 6 blocks, on the pattern of its factor.

Cholesky factorisation and the recursion of Takahashi et al. (1973), block by block. A matrix is
given by its lower triangle in compressed columns: the rows of column k are ``rows[start[k] :
start[k + 1]]``, in ascending order, the diagonal first.
"""

from __future__ import annotations

import numpy as np

from tofuse.arrays import Float64, Int64
from tofuse.kernels.jit import kernel

B = 6


@kernel
def fill_in(start: Int64, rows: Int64) -> tuple[Int64, Int64]:
    """Return the factor's pattern, (n + 1,) starts and rows, given that of the matrix."""
    n = len(start) - 1
    # Column k inherits the rows of the columns whose first row below the diagonal is k.
    first_child = np.full(n, -1, np.int64)
    next_sibling = np.full(n, -1, np.int64)
    mark = np.full(n, -1, np.int64)
    out_start = np.zeros(n + 1, np.int64)
    out = np.empty(max(2 * len(rows), 1), np.int64)
    here = np.empty(n, np.int64)
    for k in range(n):
        count = 0
        mark[k] = k
        for at in range(start[k], start[k + 1]):
            if mark[rows[at]] != k:
                mark[rows[at]] = k
                here[count] = rows[at]
                count += 1
        child = first_child[k]
        while child >= 0:
            for at in range(out_start[child], out_start[child + 1]):
                row = out[at]
                if row > k and mark[row] != k:
                    mark[row] = k
                    here[count] = row
                    count += 1
            child = next_sibling[child]
        below = np.sort(here[:count])
        if out_start[k] + count + 1 > len(out):
            larger = np.empty(2 * len(out) + count + 1, np.int64)
            larger[: out_start[k]] = out[: out_start[k]]
            out = larger
        out[out_start[k]] = k
        out[out_start[k] + 1 : out_start[k] + 1 + count] = below
        out_start[k + 1] = out_start[k] + count + 1
        if count:
            parent = below[0]
            next_sibling[k] = first_child[parent]
            first_child[parent] = k
    return out_start, out[: out_start[n]].copy()


@kernel
def _subtract_outer(target: Float64, a: Float64, b: Float64) -> None:
    """Subtract a @ b^T from the target, all (6, 6)."""
    for r in range(B):
        for c in range(B):
            total = 0.0
            for k in range(B):
                total += a[r, k] * b[c, k]
            target[r, c] -= total


@kernel
def _cholesky(block: Float64) -> bool:
    """Replace a (6, 6) block by its lower Cholesky factor; False if it is not positive."""
    for c in range(B):
        pivot = block[c, c]
        for k in range(c):
            pivot -= block[c, k] * block[c, k]
        if not pivot > 0.0:
            return False
        pivot = np.sqrt(pivot)
        block[c, c] = pivot
        for r in range(c + 1, B):
            total = block[r, c]
            for k in range(c):
                total -= block[r, k] * block[c, k]
            block[r, c] = total / pivot
        for r in range(c):
            block[r, c] = 0.0
    return True


@kernel
def _divide(block: Float64, lower: Float64) -> None:
    """Replace a (6, 6) block X by X L^-T."""
    for r in range(B):
        for c in range(B):
            total = block[r, c]
            for k in range(c):
                total -= block[r, k] * lower[c, k]
            block[r, c] = total / lower[c, c]


@kernel
def factorise(start: Int64, rows: Int64, values: Float64) -> bool:
    """Replace the blocks (nnz, 6, 6) of a matrix by those of its factor, in the factor's pattern.

    Blocks that the matrix does not have are zero. Returns False if it is not positive definite.
    """
    n = len(start) - 1
    work = np.zeros((n, B, B))
    waiting = np.full(n, -1, np.int64)  # first of the columns whose next row is this one
    after = np.full(n, -1, np.int64)
    place = start[:n].copy()
    for j in range(n):
        for at in range(start[j], start[j + 1]):
            work[rows[at]] = values[at]
        k = waiting[j]
        while k >= 0:
            following = after[k]
            at = place[k]
            for below in range(at, start[k + 1]):
                _subtract_outer(work[rows[below]], values[below], values[at])
            place[k] = at + 1
            if at + 1 < start[k + 1]:
                row = rows[at + 1]
                after[k] = waiting[row]
                waiting[row] = k
            k = following
        if not _cholesky(work[j]):
            return False
        values[start[j]] = work[j]
        for at in range(start[j] + 1, start[j + 1]):
            _divide(work[rows[at]], work[j])
            values[at] = work[rows[at]]
        place[j] = start[j] + 1
        if start[j] + 1 < start[j + 1]:
            row = rows[start[j] + 1]
            after[j] = waiting[row]
            waiting[row] = j
    return True


@kernel
def invert(start: Int64, rows: Int64, values: Float64) -> None:
    """Replace the blocks of a factor by those of the inverse of the matrix, at the same places.

    Z_ij = -sum_k Z_ik M_kj and Z_jj = (L_jj L_jj^T)^-1 - sum_k M_kj^T Z_kj with
    M_kj = L_kj L_jj^-1, from the last column to the first.
    """
    n = len(start) - 1
    where = np.full(n, -1, np.int64)
    most = 0
    for j in range(n):
        most = max(most, start[j + 1] - start[j])
    M = np.empty((most, B, B))
    Z = np.empty((most, B, B))
    inverse = np.empty((B, B))
    for j in range(n - 1, -1, -1):
        first, count = start[j], start[j + 1] - start[j] - 1
        # The inverse of the lower triangle on the diagonal.
        lower = values[first]
        inverse[:] = 0.0
        for c in range(B):
            inverse[c, c] = 1.0 / lower[c, c]
            for r in range(c + 1, B):
                total = 0.0
                for k in range(c, r):
                    total -= lower[r, k] * inverse[k, c]
                inverse[r, c] = total / lower[r, r]
        for a in range(count):
            where[rows[first + 1 + a]] = a
            Z[a] = 0.0
            for r in range(B):
                for c in range(B):
                    total = 0.0
                    for k in range(c, B):
                        total += values[first + 1 + a, r, k] * inverse[k, c]
                    M[a, r, c] = total
        for a in range(count):
            column = rows[first + 1 + a]
            for at in range(start[column], start[column + 1]):
                b = where[rows[at]]
                if b < 0:
                    continue
                for r in range(B):
                    for c in range(B):
                        total = 0.0
                        for k in range(B):
                            total += values[at, r, k] * M[a, k, c]
                        Z[b, r, c] -= total
                if b != a:
                    for r in range(B):
                        for c in range(B):
                            total = 0.0
                            for k in range(B):
                                total += values[at, k, r] * M[b, k, c]
                            Z[a, r, c] -= total
        for r in range(B):
            for c in range(B):
                total = 0.0
                for k in range(max(r, c), B):
                    total += inverse[k, r] * inverse[k, c]
                values[first, r, c] = total
        for a in range(count):
            for r in range(B):
                for c in range(B):
                    total = 0.0
                    for k in range(B):
                        total += M[a, k, r] * Z[a, k, c]
                    values[first, r, c] -= total
            values[first + 1 + a] = Z[a]
            where[rows[first + 1 + a]] = -1
