"""Supernodal factorisation of sparse symmetric matrices of k x k blocks, and selected inversion.

Neighbouring columns with similar patterns form a supernode, a dense panel of rows, so that nearly
all arithmetic is products of dense matrices (Ng and Peyton, "Block sparse Cholesky algorithms on
advanced uniprocessor computers", 1993). The factorisation A = L S L^T with signs S is not pivoted;
all signs are positive if A is positive definite. Entries of the inverse follow on the pattern of
the factor by the recursion of Takahashi et al. (1973), panel by panel.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tofuse.arrays import Float64, Int64
from tofuse.kernels.jit import kernel

# Maximum width of a panel, in blocks: its triangle on the diagonal is factorised without BLAS.
_WIDEST = 32
# Columns join a supernode while at most this fraction of its blocks is zero.
_ZEROS = 0.25


class Panels(NamedTuple):
    """Layout of the panels of a factor with n block columns in S supernodes.

    Attributes
    ----------
    size
        k, of the blocks.
    first
        (S + 1,) first column of each supernode.
    row_start
        (S + 1,) where its rows begin in `rows`.
    rows
        Block rows of each panel, ascending; its own columns first.
    value_start
        (S + 1,) where its values begin: rows * k times columns * k of them.
    """

    size: int
    first: Int64
    row_start: Int64
    rows: Int64
    value_start: Int64


@kernel
def fill_in(start: Int64, rows: Int64) -> tuple[Int64, Int64]:
    """Return the factor's pattern, (n + 1,) starts and rows, given that of the matrix.

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
def layout(start: Int64, rows: Int64, size: int) -> Panels:
    """Divide the columns of a factor's pattern, see `fill_in`, into supernodes."""
    n = len(start) - 1
    first = np.empty(n + 1, np.int64)
    count = 0
    column = 0
    while column < n:
        first[count] = column
        end, filled = column, start[column + 1] - start[column]
        while end + 1 < n and end + 1 - column < _WIDEST:
            # The pattern of a column is in that of its parent, the first row below the diagonal.
            if start[end + 1] - start[end] < 2 or rows[start[end] + 1] != end + 1:
                break
            following = start[end + 2] - start[end + 1]
            wide = end + 2 - column
            whole = wide * following + wide * (wide - 1) // 2
            if filled + following < (1 - _ZEROS) * whole:
                break
            filled += following
            end += 1
        column = end + 1
        count += 1
    first[count] = n
    first = first[: count + 1].copy()
    row_start = np.zeros(count + 1, np.int64)
    values = np.zeros(count + 1, np.int64)
    for s in range(count):
        last = first[s + 1] - 1
        wide = first[s + 1] - first[s]
        high = wide - 1 + start[last + 1] - start[last]
        row_start[s + 1] = row_start[s] + high
        values[s + 1] = values[s] + high * wide * size * size
    panel_rows = np.empty(row_start[count], np.int64)
    for s in range(count):
        last, at = first[s + 1] - 1, row_start[s]
        for row in range(first[s], last):
            panel_rows[at] = row
            at += 1
        for k in range(start[last], start[last + 1]):
            panel_rows[at] = rows[k]
            at += 1
    return Panels(size, first, row_start, panel_rows, values)


@kernel
def _owners(panels: Panels) -> Int64:
    """Return the (n,) supernode of each column."""
    owner = np.empty(panels.first[-1], np.int64)
    for s in range(len(panels.first) - 1):
        owner[panels.first[s] : panels.first[s + 1]] = s
    return owner


@kernel
def _panel(panels: Panels, values: Float64, s: int) -> tuple[Int64, Float64]:
    """Return the m rows of supernode s, and the (m k, w k) values of its w columns."""
    rows = panels.rows[panels.row_start[s] : panels.row_start[s + 1]]
    width = (panels.first[s + 1] - panels.first[s]) * panels.size
    own = values[panels.value_start[s] : panels.value_start[s + 1]]
    return rows, own.reshape(len(rows) * panels.size, width)


@kernel
def places(panels: Panels, rows: Int64, columns: Int64) -> Int64:
    """Return where in the values the entries of blocks (N,) on or below the diagonal are.

    (N, k, k) indices.
    """
    k, owner = panels.size, _owners(panels)
    out = np.empty((len(rows), k, k), np.int64)
    for m in range(len(rows)):
        s = owner[columns[m]]
        own = panels.rows[panels.row_start[s] : panels.row_start[s + 1]]
        row = k * np.searchsorted(own, rows[m])
        column = k * (columns[m] - panels.first[s])
        width = k * (panels.first[s + 1] - panels.first[s])
        for r in range(k):
            for c in range(k):
                out[m, r, c] = panels.value_start[s] + (row + r) * width + column + c
    return out


@kernel
def _triangle(A: Float64, signs: Float64) -> bool:
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
def _inverse_triangle(L: Float64, out: Float64) -> None:
    """Invert a lower triangle (n, n)."""
    n = len(L)
    out[:] = 0.0
    for i in range(n):
        out[i, i] = 1.0 / L[i, i]
        for k in range(i):
            factor = -L[i, k] * out[i, i]
            for j in range(k + 1):
                out[i, j] += factor * out[k, j]


@kernel
def _largest(panels: Panels) -> tuple[int, int]:
    """Largest number of rows of a panel, and of its columns: numbers, not blocks."""
    high = wide = 1
    for s in range(len(panels.first) - 1):
        high = max(high, panels.row_start[s + 1] - panels.row_start[s])
        wide = max(wide, panels.first[s + 1] - panels.first[s])
    return high * panels.size, wide * panels.size


@kernel
def factorise(panels: Panels, values: Float64, signs: Float64) -> bool:
    """Replace the values of a matrix by those of its factor L.

    Parameters
    ----------
    panels
        Layout of the values.
    values
        The lower triangle of the matrix; zero where it has no blocks.
    signs
        (n k,) diagonal of S, overwritten.

    Returns
    -------
    Whether the matrix is regular.
    """
    k, first = panels.size, panels.first
    count, owner = len(first) - 1, _owners(panels)
    high, wide = _largest(panels)
    product, scaled = np.empty(high * wide), np.empty(wide * wide)
    inverse = np.empty(wide * wide)
    where = np.empty(first[-1], np.int64)
    # For each supernode, a list of those whose next row, at `place`, is among its columns.
    waiting, after = np.full(count, -1, np.int64), np.full(count, -1, np.int64)
    place = np.zeros(count, np.int64)
    for s in range(count):
        own, P = _panel(panels, values, s)
        m, w = len(own), first[s + 1] - first[s]
        for a in range(m):
            where[own[a]] = a
        d = waiting[s]
        while d >= 0:
            following = after[d]
            of_d, D = _panel(panels, values, d)
            a, m_d, w_d = place[d], len(of_d), first[d + 1] - first[d]
            b = a
            while b < m_d and of_d[b] < first[s + 1]:
                b += 1
            low, columns = (m_d - a) * k, (b - a) * k
            right = scaled[: columns * w_d * k].reshape(columns, w_d * k)
            for r in range(columns):
                for c in range(w_d * k):
                    right[r, c] = D[a * k + r, c] * signs[first[d] * k + c]
            U = product[: low * columns].reshape(low, columns)
            np.dot(D[a * k :], right.T, U)
            for r in range(m_d - a):
                to = where[of_d[a + r]] * k
                for c in range(min(b - a, r + 1)):
                    column = (of_d[a + c] - first[s]) * k
                    for x in range(k):
                        for y in range(k):
                            P[to + x, column + y] -= U[r * k + x, c * k + y]
            place[d] = b
            if b < m_d:
                t = owner[of_d[b]]
                after[d] = waiting[t]
                waiting[t] = d
            d = following
        own_signs = signs[first[s] * k : first[s + 1] * k]
        if not _triangle(P[: w * k], own_signs):
            return False
        if m > w:
            Li = inverse[: w * k * w * k].reshape(w * k, w * k)
            _inverse_triangle(P[: w * k], Li)
            for r in range(w * k):
                for c in range(w * k):
                    Li[r, c] *= own_signs[r]
            low = (m - w) * k
            U = product[: low * w * k].reshape(low, w * k)
            np.dot(P[w * k :], Li.T, U)
            P[w * k :] = U
            place[s] = w
            t = owner[own[w]]
            after[s] = waiting[t]
            waiting[t] = s
    return True


@kernel
def solve(panels: Panels, values: Float64, signs: Float64, x: Float64) -> None:
    """Replace right-hand sides x (n k, q) by the solutions of A x = b."""
    k, first = panels.size, panels.first
    count, q = len(first) - 1, x.shape[1]
    high, _ = _largest(panels)
    part = np.empty(high * q)
    for s in range(count):
        own, P = _panel(panels, values, s)
        m, w = len(own), first[s + 1] - first[s]
        y = x[first[s] * k : first[s + 1] * k]
        for i in range(w * k):
            for j in range(i):
                for c in range(q):
                    y[i, c] -= P[i, j] * y[j, c]
            for c in range(q):
                y[i, c] /= P[i, i]
        if m > w:
            below = part[: (m - w) * k * q].reshape((m - w) * k, q)
            np.dot(P[w * k :], y, below)
            for a in range(w, m):
                for r in range(k):
                    for c in range(q):
                        x[own[a] * k + r, c] -= below[(a - w) * k + r, c]
    for i in range(len(x)):
        for c in range(q):
            x[i, c] *= signs[i]
    for s in range(count - 1, -1, -1):
        own, P = _panel(panels, values, s)
        m, w = len(own), first[s + 1] - first[s]
        y = x[first[s] * k : first[s + 1] * k]
        if m > w:
            below = part[: (m - w) * k * q].reshape((m - w) * k, q)
            for a in range(w, m):
                for r in range(k):
                    for c in range(q):
                        below[(a - w) * k + r, c] = x[own[a] * k + r, c]
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
    count, owner = len(first) - 1, _owners(panels)
    high, wide = _largest(panels)
    moved, found = np.empty(high * wide), np.empty(high * wide)
    part, product = np.empty(high * wide), np.empty(high * wide)
    inverse, square = np.empty(wide * wide), np.empty(wide * wide)
    for s in range(count - 1, -1, -1):
        all_rows, P = _panel(panels, values, s)
        m, w = len(all_rows), first[s + 1] - first[s]
        wk, low = w * k, (m - w) * k
        own = all_rows[w:]
        Li = inverse[: wk * wk].reshape(wk, wk)
        _inverse_triangle(P[:wk], Li)
        M, Z = moved[: low * wk].reshape(low, wk), found[: low * wk].reshape(low, wk)
        np.dot(P[wk:], Li, M)
        Z[:] = 0.0
        a = 0
        while a < m - w:
            t = owner[own[a]]
            b = a
            while b < m - w and own[b] < first[t + 1]:
                b += 1
            of_t, T = _panel(panels, values, t)
            at = 0
            left, columns = (m - w - a) * k, (b - a) * k
            G = part[: left * columns].reshape(left, columns)
            for r in range(a, m - w):
                while of_t[at] < own[r]:
                    at += 1
                for c in range(a, b):
                    column = (own[c] - first[t]) * k
                    for x in range(k):
                        for y in range(k):
                            G[(r - a) * k + x, (c - a) * k + y] = T[at * k + x, column + y]
            U = product[: left * wk].reshape(left, wk)
            np.dot(G, M[a * k : b * k], U)
            Z[a * k :] -= U
            if b < m - w:
                V = product[: columns * wk].reshape(columns, wk)
                np.dot(G[columns:].T, M[b * k :], V)
                Z[a * k : b * k] -= V
            a = b
        own_square = square[: wk * wk].reshape(wk, wk)
        np.dot(Li.T, Li, own_square)
        P[:wk] = own_square
        if low:
            np.dot(M.T, Z, own_square)
            P[:wk] -= own_square
            P[wk:] = Z
        for r in range(wk):
            for c in range(r):
                mean = 0.5 * (P[r, c] + P[c, r])
                P[r, c] = mean
                P[c, r] = mean
