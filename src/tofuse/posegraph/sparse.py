"""Normal equations of pairwise constraints between poses, and their sparse solution.

A pair (i, j) has a relative pose T_i_j = T_i^-1 T_j. Its constraint is a quadratic in the right
perturbation, ``T_i_j exp(xi)``: half ``xi^T H xi + 2 g^T xi`` with a (6, 6) H and a (6,) g.
Perturbations of the poses themselves, ``T_k exp(d_k)``, perturb the relative pose by::

    xi = d_j - Ad(T_j_i) d_i

so H, g and T_i_j determine four blocks and two gradients of the whole system.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from tofuse.arrays import Bool, Float64, Intp
from tofuse.geometry import se3

# Maximum size of a dense right-hand side, in numbers.
_AT_ONCE = 4_000_000
_FLAT = 1e-12  # minimum scale of the damping, relative to the largest diagonal entry


class PairSystem:
    """The sparse system of n poses and m pairs; its pattern and ordering are computed once.

    Parameters
    ----------
    n
        Number of poses.
    pairs
        (m, 2) positions i (target) and j (source), i != j.
    fixed
        (n,) mask of fixed poses; by default the first of each connected part.
    size
        Unknowns of each pose; 6 wherever H and g are those of a relative pose.
    """

    def __init__(self, n: int, pairs: Intp, fixed: Bool | None = None, *, size: int = 6) -> None:
        self.n, self.size = n, size
        self.pairs = np.asarray(pairs, np.intp).reshape(-1, 2)
        self.fixed = first_of_parts(n, self.pairs) if fixed is None else np.asarray(fixed, bool)
        i, j = self.pairs.T
        self.free = np.flatnonzero(~self.fixed)
        both = np.flatnonzero(~(self.fixed[i] | self.fixed[j]))
        number = np.full(n, -1)
        number[self.free] = np.arange(len(self.free))
        order = _elimination_order(len(self.free), number[i[both]], number[j[both]])
        # `free` in the order of elimination: block k of the system is pose free[k].
        self.free = self.free[order]
        number[self.free] = np.arange(len(self.free))
        self.number = number
        self._sums(i, j, both)
        self._layout()

    def _sums(self, i: Intp, j: Intp, both: Intp) -> None:
        """Make the matrices that sum the contributions of pairs to each block."""
        n, m = len(self.free), len(self.pairs)
        self._sum_i = _indicator(self.number[i], n, m)
        self._sum_j = _indicator(self.number[j], n, m)
        a, b = self.number[i[both]], self.number[j[both]]
        self.both, self.swapped = both, a > b
        lower, upper = np.maximum(a, b), np.minimum(a, b)
        keys, where = np.unique(upper * max(n, 1) + lower, return_inverse=True)
        self.columns, self.rows = np.divmod(keys, max(n, 1))
        self.block_of_both = where
        self._sum_off = _indicator(where, len(keys), len(both))

    def _layout(self) -> None:
        """Compute the position of each entry of each block in the data of the CSC matrix."""
        n, k, off = len(self.free), self.size, len(self.rows)
        rows = np.concatenate([np.arange(n), self.rows, self.columns])
        columns = np.concatenate([np.arange(n), self.columns, self.rows])
        order = np.lexsort((rows, columns))
        height = np.bincount(columns, minlength=n)
        start = np.concatenate([[0], np.cumsum(height)])
        rank = np.empty(len(rows), np.intp)
        rank[order] = np.arange(len(rows))
        within = rank - start[columns]
        first = k * k * start[columns] + k * within
        # Entry (a, b) of a block lies b columns on, each k * height long, and a rows down.
        place = first[:, None, None] + (
            np.arange(k)[:, None] + (k * height[columns])[:, None, None] * np.arange(k)
        )
        self._place = place[:n], place[n : n + off], place[n + off :]
        self._indptr = np.concatenate([[0], np.cumsum(np.repeat(k * height, k))]).astype(np.int32)
        indices = np.empty(k * k * len(rows), np.int32)
        indices[place] = (k * rows[:, None, None] + np.arange(k)[:, None]).astype(np.int32)
        self._indices = indices

    def assemble(
        self,
        ii: Float64,
        ij: Float64,
        jj: Float64,
        g_i: Float64,
        g_j: Float64,
        single: tuple[Float64, Float64] | None = None,
    ) -> tuple[Any, Float64]:
        """Return the matrix (CSC) and the gradient (free poses x size) of the whole system.

        Parameters
        ----------
        ii, ij, jj
            (m, k, k) blocks of each pair, rows by the first index.
        g_i, g_j
            (m, k) gradients of each pair.
        single
            (n, k, k) blocks and (n, k) gradients of unary terms.
        """
        n, k = len(self.free), self.size
        diagonal = self._sum_i @ ii.reshape(-1, k * k) + self._sum_j @ jj.reshape(-1, k * k)
        diagonal = diagonal.reshape(n, k, k)
        gradient = self._sum_i @ g_i + self._sum_j @ g_j
        if single is not None:
            diagonal = diagonal + single[0][self.free]
            gradient = gradient + single[1][self.free]
        # Blocks below the diagonal: rows belong to the pose that is eliminated later.
        blocks = ij[self.both]
        low = np.where(self.swapped[:, None, None], blocks, np.swapaxes(blocks, 1, 2))
        low = (self._sum_off @ low.reshape(-1, k * k)).reshape(-1, k, k)
        data = np.empty(len(self._indices))
        for place, values in zip(self._place, (diagonal, low, np.swapaxes(low, 1, 2)), strict=True):
            data[place] = values
        shape = (k * n, k * n)
        return sparse.csc_matrix((data, self._indices, self._indptr), shape=shape), gradient

    def relative(
        self,
        H: Float64,
        g: Float64,
        T_i_j: Float64,
        single: tuple[Float64, Float64] | None = None,
    ) -> tuple[Any, Float64]:
        """Assemble from (m, 6, 6) H and (m, 6) g of the right perturbations of (m, 4, 4) T_i_j."""
        A = se3.adjoint(se3.inverse(T_i_j))
        At = np.swapaxes(A, 1, 2)
        AtH = At @ H
        return self.assemble(AtH @ A, -AtH, H, -(At @ g[..., None])[..., 0], g, single)

    def gradient(self, g: Float64, T_i_j: Float64) -> Float64:
        """Return only the gradient (free poses x 6) of (m, 6) g, as in `relative`."""
        At = np.swapaxes(se3.adjoint(se3.inverse(T_i_j)), 1, 2)
        g_i = -(At @ g[..., None])[..., 0]
        return np.asarray(self._sum_i @ g_i + self._sum_j @ g, np.float64)

    def blocks(self, matrix: Any) -> tuple[Float64, Float64]:
        """Return the blocks of a matrix on the diagonal, and below it at `rows`, `columns`."""
        data = matrix.data
        return data[self._place[0]], data[self._place[1]]

    def solve(
        self,
        H: Float64,
        g: Float64,
        T_i_j: Float64,
        damping: float = 0.0,
        single: tuple[Float64, Float64] | None = None,
    ) -> Float64 | None:
        """Compute a damped Gauss-Newton step.

        Parameters
        ----------
        H, g
            (m, 6, 6) ``J^T W J`` and (m, 6) ``J^T W r`` of each pair, by the right perturbation of
            its relative pose.
        T_i_j
            (m, 4, 4) relative poses at the linearisation point.
        damping
            Fraction of the diagonal that is added to it (Levenberg-Marquardt).
        single
            Blocks and gradients of unary terms, see `assemble`.

        Returns
        -------
        (n, 6) steps d, to be applied as ``T_k exp(d_k)``; zero for fixed poses. None where the
        system is singular.
        """
        factor = self.factor(*self.relative(H, g, T_i_j, single), damping)
        return None if factor is None else factor.step()

    def factor(self, matrix: Any, gradient: Float64, damping: float = 0.0) -> Factor | None:
        """Factorise an assembled system; None where it is singular."""
        if matrix.shape[0] and damping:
            diagonal = matrix.diagonal()
            added = damping * np.maximum(diagonal, _FLAT * diagonal.max())
            matrix = matrix.copy()
            ends = self._place[0].diagonal(axis1=1, axis2=2).ravel()
            matrix.data[ends] += added
        try:
            return Factor(self, matrix, gradient)
        except RuntimeError:
            return None


class Factor:
    """A factorised system. Raises RuntimeError where it is singular."""

    def __init__(self, system: PairSystem, matrix: Any, gradient: Float64) -> None:
        self.system, self.gradient, self._matrix = system, gradient, matrix
        # The blocks are in elimination order; the matrix is symmetric, so no pivoting.
        options = {"SymmetricMode": True}
        self._lu = (
            splu(matrix, permc_spec="NATURAL", diag_pivot_thresh=0.0, options=options)
            if matrix.shape[0]
            else None
        )

    def step(self) -> Float64 | None:
        """Return the (n, k) solution of ``matrix x = -gradient``; None if not finite."""
        return self.solve(self.gradient)

    def solve(self, gradient: Float64) -> Float64 | None:
        """As `step`, with another gradient (free poses x k)."""
        system = self.system
        out = np.zeros((system.n, system.size))
        if self._lu is not None:
            x = self._lu.solve(-gradient.ravel())
            if not np.isfinite(x).all():
                return None
            out[system.free] = x.reshape(-1, system.size)
        return out

    def joint_covariance(self, vertices: Intp) -> Float64:
        """Return the (v k, v k) joint covariance of some poses; zero for fixed ones."""
        system, k = self.system, self.system.size
        vertices = np.asarray(vertices, np.intp)
        out = np.zeros((len(vertices), k, len(vertices), k))
        moving = np.flatnonzero(~system.fixed[vertices])
        if self._lu is None or not len(moving):
            return out.reshape(len(vertices) * k, -1)
        at = (k * system.number[vertices[moving]][:, None] + np.arange(k)).ravel()
        # In batches, so that memory does not grow with the graph.
        some = max(1, min(64, _AT_ONCE // (k * k * len(system.free))))
        for start in range(0, len(moving), some):
            these = moving[start : start + some]
            columns = at[k * start : k * (start + some)]
            unit = np.zeros((k * len(system.free), len(columns)))
            unit[columns, np.arange(len(columns))] = 1
            found = self._lu.solve(unit)[at].reshape(len(moving), k, len(these), k)
            out[moving[:, None], :, these, :] = np.swapaxes(found, 1, 2)
        C = out.reshape(len(vertices) * k, -1)
        return (C + C.T) / 2

    def covariances(self) -> Float64:
        """Return the (n, 6, 6) marginal covariances of the poses; zero for fixed ones.

        Raises RuntimeError where the system is not positive definite.
        """
        system = self.system
        out = np.zeros((system.n, system.size, system.size))
        out[system.free] = self._inverse()[0]
        return out

    def relative_covariances(self, T_i_j: Float64) -> Float64:
        """Return the (m, 6, 6) covariances of the pairs' relative poses; see `covariances`.

        `T_i_j` (m, 4, 4) are the relative poses at the linearisation point; covariances are of
        their right perturbations.
        """
        system = self.system
        diagonal, low = self._inverse()
        i, j = system.pairs.T
        blocks = np.concatenate([diagonal, np.zeros((1, 6, 6))])  # the last for fixed poses
        A = se3.adjoint(se3.inverse(T_i_j))
        At = np.swapaxes(A, 1, 2)
        C = blocks[system.number[j]] + A @ blocks[system.number[i]] @ At
        both = system.both
        cross = low[system.block_of_both]
        # Blocks lie below the diagonal: (j, i) where i is eliminated first.
        ji = np.where(system.swapped[:, None, None], np.swapaxes(cross, 1, 2), cross)
        AC = A[both] @ np.swapaxes(ji, 1, 2)
        C[both] -= AC + np.swapaxes(AC, 1, 2)
        return C

    def _inverse(self) -> tuple[Float64, Float64]:
        """Return the blocks of the inverse: diagonal (free, 6, 6), and those of the pairs."""
        # Imported here: importing Numba is slow, and few callers need covariances.
        from tofuse.kernels.selected_inverse import factorise, fill_in, invert

        system = self.system
        n = len(system.free)
        diagonal, low = system.blocks(self._matrix)
        if n == 0:
            return diagonal, low
        rows = np.concatenate([np.arange(n), system.rows]).astype(np.int64)
        columns = np.concatenate([np.arange(n), system.columns]).astype(np.int64)
        order = np.lexsort((rows, columns))
        start = np.searchsorted(columns[order], np.arange(n + 1)).astype(np.int64)
        full_start, full_rows = fill_in(start, rows[order])
        # Positions of the matrix's blocks in the pattern of its factor, which is denser.
        of_full = np.repeat(np.arange(n), np.diff(full_start))
        place = np.searchsorted(of_full * n + full_rows, columns * n + rows)
        values = np.zeros((len(full_rows), 6, 6))
        values[place] = np.concatenate([diagonal, low])
        if not factorise(full_start, full_rows, values):
            raise RuntimeError("the system is not positive definite")
        invert(full_start, full_rows, values)
        return values[place[:n]], values[place[n:]]


def parts_of(n: int, pairs: Intp) -> Intp:
    """Return the (n,) connected part of each vertex, numbered in the order of first vertices."""
    i, j = np.asarray(pairs, np.intp).reshape(-1, 2).T
    adjacency = sparse.coo_matrix((np.ones(len(i)), (i, j)), shape=(n, n))
    _, label = connected_components(adjacency, directed=False)
    _, first, where = np.unique(label, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[where]


def first_of_parts(n: int, pairs: Intp) -> Bool:
    """Return the (n,) mask of the first vertex of each connected part."""
    first = np.zeros(n, bool)
    if n:
        first[np.unique(parts_of(n, pairs), return_index=True)[1]] = True
    return first


def _indicator(rows: Intp, n: int, m: int) -> Any:
    """Make an (n, m) matrix that adds column k to row rows[k]; rows below 0 are ignored."""
    used = np.flatnonzero(rows >= 0)
    ones = np.ones(len(used))
    return sparse.csr_matrix((ones, (rows[used], used)), shape=(n, m))


def _elimination_order(n: int, i: Intp, j: Intp) -> Intp:
    """Return an elimination order with little fill-in: minimum degree on the pose graph."""
    if n < 2:
        return np.arange(n)
    links = sparse.coo_matrix((np.ones(len(i)), (i, j)), shape=(n, n)).tocsr()
    links = links + links.T
    degree = np.asarray(links.sum(axis=1)).ravel()
    laplacian = (sparse.diags(degree + 1) - links).tocsc()
    options = {"SymmetricMode": True}
    found = splu(laplacian, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
    return np.argsort(found.perm_c)
