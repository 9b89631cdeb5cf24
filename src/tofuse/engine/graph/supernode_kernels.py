"""Supernodal factorisation of sparse symmetric matrices of k x k blocks, and selected inversion.

Adjacent columns with similar patterns form a supernode, a dense panel of rows, so that nearly all
arithmetic consists of products of dense matrices (Ng and Peyton, "Block sparse Cholesky algorithms
on advanced uniprocessor computers", 1993). The factorisation A = L S L^T with signs S is not
pivoted; all signs are positive if A is positive definite. The entries of the inverse on the pattern
of the factor follow by the recursion of Takahashi et al. (1973), panel by panel.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tofuse.engine.arrays import Float64, Int64
from tofuse.engine.compute import kernel

# Maximum width of a panel, in blocks, as its diagonal triangle is factorised without BLAS.
_MAX_WIDTH = 32
# Columns are added to a supernode while at most this fraction of its blocks is zero.
_MAX_ZERO_FRACTION = 0.25


class Panels(NamedTuple):
    """Layout of the panels of a factor with n block columns in S supernodes.

    Attributes
    ----------
    size
        k, of the blocks.
    first
        (S + 1,) first column of each supernode.
    row_start
        (S + 1,) where the rows of each begin in `rows`.
    rows
        Block rows of each panel, ascending, beginning with those of its own columns.
    value_start
        (S + 1,) where the values of each begin: (rows k) x (columns k).
    """

    size: int
    first: Int64
    row_start: Int64
    rows: Int64
    value_start: Int64


@kernel
def add_rows(rows: Int64, values: Float64, sums: Float64) -> None:
    """Add values (m, s) to their rows of `sums` (n, s), in order; none to rows below 0."""
    for k in range(len(rows)):
        row = rows[k]
        if row >= 0:
            for c in range(values.shape[1]):
                sums[row, c] += values[k, c]


@kernel
def fill_in(start: Int64, rows: Int64) -> tuple[Int64, Int64]:
    """Return the pattern of the factor, (n + 1,) starts and rows, given that of the matrix.

    A pattern is that of the lower triangle in compressed columns: the rows of column k are
    ``rows[start[k] : start[k + 1]]``, in ascending order, the diagonal first.
    """
    n = len(start) - 1
    # Column k inherits the rows of the columns whose first row below the diagonal is k.
    first_child = np.full(n, -1, np.int64)
    next_sibling = np.full(n, -1, np.int64)
    mark = np.full(n, -1, np.int64)
    out_start = np.zeros(n + 1, np.int64)
    out = np.empty(max(2 * len(rows), 1), np.int64)
    column_rows = np.empty(n, np.int64)
    for k in range(n):
        count = 0
        mark[k] = k
        for index in range(start[k], start[k + 1]):
            if mark[rows[index]] != k:
                mark[rows[index]] = k
                column_rows[count] = rows[index]
                count += 1
        child = first_child[k]
        while child >= 0:
            for index in range(out_start[child], out_start[child + 1]):
                row = out[index]
                if row > k and mark[row] != k:
                    mark[row] = k
                    column_rows[count] = row
                    count += 1
            child = next_sibling[child]
        below = np.sort(column_rows[:count])
        if out_start[k] + count + 1 > len(out):
            larger = np.empty(2 * len(out) + count + 1, np.int64)
            for index in range(out_start[k]):
                larger[index] = out[index]
            out = larger
        out[out_start[k]] = k
        for index in range(count):
            out[out_start[k] + 1 + index] = below[index]
        out_start[k + 1] = out_start[k] + count + 1
        if count:
            parent = below[0]
            next_sibling[k] = first_child[parent]
            first_child[parent] = k
    return out_start, out[: out_start[n]].copy()


@kernel
def layout(start: Int64, rows: Int64, size: int) -> Panels:
    """Divide the columns of a factor's pattern, see `fill_in`, into supernodes."""
    n = len(start) - 1
    first = np.empty(n + 1, np.int64)
    count = 0
    column = 0
    while column < n:
        first[count] = column
        end, nonzeros = column, start[column + 1] - start[column]
        while end + 1 < n and end + 1 - column < _MAX_WIDTH:
            # The pattern of a column is contained in that of its parent, its first row below the
            # diagonal.
            if start[end + 1] - start[end] < 2 or rows[start[end] + 1] != end + 1:
                break
            next_nonzeros = start[end + 2] - start[end + 1]
            width = end + 2 - column
            full = width * next_nonzeros + width * (width - 1) // 2
            if nonzeros + next_nonzeros < (1 - _MAX_ZERO_FRACTION) * full:
                break
            nonzeros += next_nonzeros
            end += 1
        column = end + 1
        count += 1
    first[count] = n
    first = first[: count + 1].copy()
    row_start = np.zeros(count + 1, np.int64)
    value_start = np.zeros(count + 1, np.int64)
    for s in range(count):
        last = first[s + 1] - 1
        width = first[s + 1] - first[s]
        height = width - 1 + start[last + 1] - start[last]
        row_start[s + 1] = row_start[s] + height
        value_start[s + 1] = value_start[s] + height * width * size * size
    panel_rows = np.empty(row_start[count], np.int64)
    for s in range(count):
        last, index = first[s + 1] - 1, row_start[s]
        for row in range(first[s], last):
            panel_rows[index] = row
            index += 1
        for k in range(start[last], start[last + 1]):
            panel_rows[index] = rows[k]
            index += 1
    return Panels(size, first, row_start, panel_rows, value_start)


@kernel
def _supernode_of_columns(panels: Panels) -> Int64:
    """Return the (n,) supernode of each column."""
    supernode = np.empty(panels.first[-1], np.int64)
    for s in range(len(panels.first) - 1):
        supernode[panels.first[s] : panels.first[s + 1]] = s
    return supernode


@kernel
def _panel(panels: Panels, values: Float64, s: int) -> tuple[Int64, Float64]:
    """Return the m rows of supernode s, and the (m k, w k) values of its w columns."""
    rows = panels.rows[panels.row_start[s] : panels.row_start[s + 1]]
    width = (panels.first[s + 1] - panels.first[s]) * panels.size
    panel_values = values[panels.value_start[s] : panels.value_start[s + 1]]
    return rows, panel_values.reshape(len(rows) * panels.size, width)


@kernel
def entry_indices(panels: Panels, rows: Int64, columns: Int64) -> Int64:
    """Return the indices (N, k, k) in the values of the entries of N blocks.

    The blocks, given by `rows` and `columns` (N,), are on or below the diagonal.
    """
    k, supernode = panels.size, _supernode_of_columns(panels)
    out = np.empty((len(rows), k, k), np.int64)
    for m in range(len(rows)):
        s = supernode[columns[m]]
        panel_rows = panels.rows[panels.row_start[s] : panels.row_start[s + 1]]
        row = k * np.searchsorted(panel_rows, rows[m])
        column = k * (columns[m] - panels.first[s])
        width = k * (panels.first[s + 1] - panels.first[s])
        for r in range(k):
            for c in range(k):
                out[m, r, c] = panels.value_start[s] + (row + r) * width + column + c
    return out


@kernel
def _factorise_triangle(A: Float64, signs: Float64) -> bool:
    """Replace the lower triangle of A (n, n) by L with A = L S L^T; False if it is singular."""
    n = len(A)
    for i in range(n):
        for j in range(i + 1):
            total = A[i, j]
            for k in range(j):
                total -= signs[k] * A[i, k] * A[j, k]
            if i > j:
                A[i, j] = total * signs[j] / A[j, j]
            else:
                if not abs(total) > 0.0 or not np.isfinite(total):
                    return False
                signs[i] = 1.0 if total > 0 else -1.0
                A[i, i] = np.sqrt(abs(total))
        for j in range(i + 1, n):
            A[i, j] = 0.0
    return True


@kernel
def _invert_triangle(L: Float64, out: Float64) -> None:
    """Invert a lower triangular matrix (n, n)."""
    n = len(L)
    out[:] = 0.0
    for i in range(n):
        out[i, i] = 1.0 / L[i, i]
        for k in range(i):
            factor = -L[i, k] * out[i, i]
            for j in range(k + 1):
                out[i, j] += factor * out[k, j]


@kernel
def _copy(target: Float64, source: Float64) -> None:
    """Copy a matrix. The assignment to a slice takes the compiler a hundred times as long."""
    for i in range(source.shape[0]):
        for j in range(source.shape[1]):
            target[i, j] = source[i, j]


@kernel
def _subtract(target: Float64, source: Float64) -> None:
    for i in range(source.shape[0]):
        for j in range(source.shape[1]):
            target[i, j] -= source[i, j]


@kernel
def _max_panel_shape(panels: Panels) -> tuple[int, int]:
    """Return the largest numbers of scalar rows and of scalar columns of a panel."""
    height = width = 1
    for s in range(len(panels.first) - 1):
        height = max(height, panels.row_start[s + 1] - panels.row_start[s])
        width = max(width, panels.first[s + 1] - panels.first[s])
    return height * panels.size, width * panels.size


@kernel
def factorise(panels: Panels, values: Float64, signs: Float64) -> bool:
    """Replace the values of a matrix by those of its factor L.

    Parameters
    ----------
    panels
        Layout of the values.
    values
        Lower triangle of the matrix; zero where it has no blocks.
    signs
        (n k,) diagonal of S, overwritten.

    Returns
    -------
    Whether the matrix is regular.
    """
    k, first = panels.size, panels.first
    count, supernode = len(first) - 1, _supernode_of_columns(panels)
    max_height, max_width = _max_panel_shape(panels)
    product, scaled = np.empty(max_height * max_width), np.empty(max_width * max_width)
    inverse = np.empty(max_width * max_width)
    local_row = np.empty(first[-1], np.int64)
    # Per supernode, a linked list of those whose next row, at `next_row`, is among its columns.
    first_pending, next_pending = np.full(count, -1, np.int64), np.full(count, -1, np.int64)
    next_row = np.zeros(count, np.int64)
    for s in range(count):
        panel_rows, P = _panel(panels, values, s)
        m, w = len(panel_rows), first[s + 1] - first[s]
        for a in range(m):
            local_row[panel_rows[a]] = a
        d = first_pending[s]
        while d >= 0:
            following = next_pending[d]
            rows_d, D = _panel(panels, values, d)
            a, m_d, w_d = next_row[d], len(rows_d), first[d + 1] - first[d]
            b = a
            while b < m_d and rows_d[b] < first[s + 1]:
                b += 1
            row_count, columns = (m_d - a) * k, (b - a) * k
            scaled_D = scaled[: columns * w_d * k].reshape(columns, w_d * k)
            for r in range(columns):
                for c in range(w_d * k):
                    scaled_D[r, c] = D[a * k + r, c] * signs[first[d] * k + c]
            U = product[: row_count * columns].reshape(row_count, columns)
            np.dot(D[a * k :], scaled_D.T, U)
            for r in range(m_d - a):
                target_row = local_row[rows_d[a + r]] * k
                for c in range(min(b - a, r + 1)):
                    column = (rows_d[a + c] - first[s]) * k
                    for x in range(k):
                        for y in range(k):
                            P[target_row + x, column + y] -= U[r * k + x, c * k + y]
            next_row[d] = b
            if b < m_d:
                t = supernode[rows_d[b]]
                next_pending[d] = first_pending[t]
                first_pending[t] = d
            d = following
        panel_signs = signs[first[s] * k : first[s + 1] * k]
        if not _factorise_triangle(P[: w * k], panel_signs):
            return False
        if m > w:
            Li = inverse[: w * k * w * k].reshape(w * k, w * k)
            _invert_triangle(P[: w * k], Li)
            for r in range(w * k):
                for c in range(w * k):
                    Li[r, c] *= panel_signs[r]
            row_count = (m - w) * k
            U = product[: row_count * w * k].reshape(row_count, w * k)
            np.dot(P[w * k :], Li.T, U)
            _copy(P[w * k :], U)
            next_row[s] = w
            t = supernode[panel_rows[w]]
            next_pending[s] = first_pending[t]
            first_pending[t] = s
    return True


@kernel
def solve(panels: Panels, values: Float64, signs: Float64, x: Float64) -> None:
    """Replace right-hand sides x (n k, q) by the solutions of A x = b."""
    k, first = panels.size, panels.first
    count, q = len(first) - 1, x.shape[1]
    max_height, _ = _max_panel_shape(panels)
    buffer = np.empty(max_height * q)
    for s in range(count):
        panel_rows, P = _panel(panels, values, s)
        m, w = len(panel_rows), first[s + 1] - first[s]
        y = x[first[s] * k : first[s + 1] * k]
        for i in range(w * k):
            for j in range(i):
                for c in range(q):
                    y[i, c] -= P[i, j] * y[j, c]
            for c in range(q):
                y[i, c] /= P[i, i]
        if m > w:
            below = buffer[: (m - w) * k * q].reshape((m - w) * k, q)
            np.dot(P[w * k :], y, below)
            for a in range(w, m):
                for r in range(k):
                    for c in range(q):
                        x[panel_rows[a] * k + r, c] -= below[(a - w) * k + r, c]
    for i in range(len(x)):
        for c in range(q):
            x[i, c] *= signs[i]
    for s in range(count - 1, -1, -1):
        panel_rows, P = _panel(panels, values, s)
        m, w = len(panel_rows), first[s + 1] - first[s]
        y = x[first[s] * k : first[s + 1] * k]
        if m > w:
            below = buffer[: (m - w) * k * q].reshape((m - w) * k, q)
            for a in range(w, m):
                for r in range(k):
                    for c in range(q):
                        below[(a - w) * k + r, c] = x[panel_rows[a] * k + r, c]
            y -= np.dot(P[w * k :].T, below)
        for i in range(w * k - 1, -1, -1):
            for c in range(q):
                y[i, c] /= P[i, i]
            for j in range(i):
                for c in range(q):
                    y[j, c] -= P[i, j] * y[i, c]


@kernel
def invert(panels: Panels, values: Float64) -> None:
    """Replace the values of a factor with positive signs by those of the inverse of the matrix.

    Z_RJ = -Z_RR M and Z_JJ = (L_JJ L_JJ^T)^-1 - M^T Z_RJ with M = L_RJ L_JJ^-1, for the columns J
    and the rows R below them, from the last supernode to the first.
    """
    k, first = panels.size, panels.first
    count, supernode = len(first) - 1, _supernode_of_columns(panels)
    max_height, max_width = _max_panel_shape(panels)
    M_buffer, Z_buffer = np.empty(max_height * max_width), np.empty(max_height * max_width)
    G_buffer, product = np.empty(max_height * max_width), np.empty(max_height * max_width)
    inverse, square = np.empty(max_width * max_width), np.empty(max_width * max_width)
    for s in range(count - 1, -1, -1):
        all_rows, P = _panel(panels, values, s)
        m, w = len(all_rows), first[s + 1] - first[s]
        wk, below = w * k, (m - w) * k
        rows_below = all_rows[w:]
        Li = inverse[: wk * wk].reshape(wk, wk)
        _invert_triangle(P[:wk], Li)
        M, Z = M_buffer[: below * wk].reshape(below, wk), Z_buffer[: below * wk].reshape(below, wk)
        np.dot(P[wk:], Li, M)
        Z[:] = 0.0
        a = 0
        while a < m - w:
            t = supernode[rows_below[a]]
            b = a
            while b < m - w and rows_below[b] < first[t + 1]:
                b += 1
            rows_t, T = _panel(panels, values, t)
            index = 0
            row_count, columns = (m - w - a) * k, (b - a) * k
            G = G_buffer[: row_count * columns].reshape(row_count, columns)
            for r in range(a, m - w):
                while rows_t[index] < rows_below[r]:
                    index += 1
                for c in range(a, b):
                    column = (rows_below[c] - first[t]) * k
                    for x in range(k):
                        for y in range(k):
                            G[(r - a) * k + x, (c - a) * k + y] = T[index * k + x, column + y]
            U = product[: row_count * wk].reshape(row_count, wk)
            np.dot(G, M[a * k : b * k], U)
            _subtract(Z[a * k :], U)
            if b < m - w:
                V = product[: columns * wk].reshape(columns, wk)
                np.dot(G[columns:].T, M[b * k :], V)
                _subtract(Z[a * k : b * k], V)
            a = b
        panel_square = square[: wk * wk].reshape(wk, wk)
        np.dot(Li.T, Li, panel_square)
        _copy(P[:wk], panel_square)
        if below:
            np.dot(M.T, Z, panel_square)
            _subtract(P[:wk], panel_square)
            _copy(P[wk:], Z)
        for r in range(wk):
            for c in range(r):
                mean = 0.5 * (P[r, c] + P[c, r])
                P[r, c] = mean
                P[c, r] = mean
