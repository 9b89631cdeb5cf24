"""Normal equations of pairwise constraints between poses, and their sparse solution.

A pair (i, j) has a relative pose T_i_j = T_i^-1 T_j. Its constraint is a quadratic in the right
perturbation, ``T_i_j exp(xi)``: half ``xi^T H xi + 2 g^T xi`` with a (6, 6) H and a (6,) g.
Perturbations of the poses themselves, ``T_k exp(d_k)``, perturb the relative pose by::

    xi = d_j - Ad(T_j_i) d_i

so H, g and T_i_j determine four blocks and two gradients of the whole system.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.sparse.linalg import splu

from tofuse.engine.arrays import Bool, Float64, Intp
from tofuse.engine.compute import one_blas_thread
from tofuse.engine.connections import parts_of
from tofuse.engine.geometry import se3
from tofuse.engine.graph import edge_kernels
from tofuse.engine.graph import supernode_kernels as kernels

# Maximum size of a dense right-hand side, in numbers.
_MAX_RHS = 4_000_000
# Maximum size of a factor, in numbers (160 MB), see `sparsify`.
MAX_FACTOR = 20_000_000
# Poses whose factor is laid out at once, without trying fewer pairs first.
_FEW_POSES = 5000
_MIN_SCALE = 1e-12  # minimum scale of the damping, relative to the largest diagonal entry


def equations(
    e: Float64, information: Float64, weights: Float64 | None = None
) -> tuple[Float64, Float64]:
    """Return H (m, 6, 6) and g (m, 6) of measured relative poses.

    Parameters
    ----------
    e, information
        (m, 6) errors log(Z^-1 T_i_j) and (m, 6, 6) information of the measurements Z.
    weights
        (m,) factors of the information; by default 1.
    """
    weights = np.ones(len(e)) if weights is None else weights
    H, g = np.empty((len(e), 6, 6)), np.empty((len(e), 6))
    edge_kernels.normal_equations(e, information, weights, H, g)
    return H, g


class Blocks(NamedTuple):
    """A symmetric matrix of k x k blocks, in the order of a system's free poses.

    Attributes
    ----------
    diagonal
        (n, k, k) blocks on the diagonal.
    below
        (b, k, k) blocks below it, at the `rows` and `columns` of the system.
    """

    diagonal: Float64
    below: Float64


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
        both_free = np.flatnonzero(~(self.fixed[i] | self.fixed[j]))
        block_of_pose = np.full(n, -1)
        block_of_pose[self.free] = np.arange(len(self.free))
        order = _elimination_order(
            len(self.free), block_of_pose[i[both_free]], block_of_pose[j[both_free]]
        )
        # `free` in the order of elimination: block k of the system is pose free[k].
        self.free = self.free[order]
        block_of_pose[self.free] = np.arange(len(self.free))
        self.block_of_pose = block_of_pose
        self._build_sums(i, j, both_free)

    def _build_sums(self, i: Intp, j: Intp, both_free: Intp) -> None:
        """Find the block that each contribution of a pair is added to."""
        n = len(self.free)
        self._block_i, self._block_j = self.block_of_pose[i], self.block_of_pose[j]
        a, b = self.block_of_pose[i[both_free]], self.block_of_pose[j[both_free]]
        self.both_free, self.swapped = both_free, a > b
        lower, upper = np.maximum(a, b), np.minimum(a, b)
        keys, block_of_pair = np.unique(upper * max(n, 1) + lower, return_inverse=True)
        self.columns, self.rows = np.divmod(keys, max(n, 1))
        self.block_of_pair = block_of_pair

    @cached_property
    def panels(self) -> tuple[kernels.Panels, Intp]:
        """Layout of the factor, and positions of the entries of the matrix's blocks in it."""
        n = len(self.free)
        rows = np.concatenate([np.arange(n), self.rows])
        columns = np.concatenate([np.arange(n), self.columns])
        panels = _panels(n, rows, columns, self.size)
        return panels, kernels.entry_indices(panels, rows, columns)

    def assemble(
        self,
        ii: Float64,
        ij: Float64,
        jj: Float64,
        g_i: Float64,
        g_j: Float64,
        unary: tuple[Float64, Float64] | None = None,
    ) -> tuple[Blocks, Float64]:
        """Return the matrix and the gradient (free poses x size) of the whole system.

        Parameters
        ----------
        ii, ij, jj
            (m, k, k) blocks of each pair, rows by the first index.
        g_i, g_j
            (m, k) gradients of each pair.
        unary
            (n, k, k) blocks and (n, k) gradients of unary terms.
        """
        n = len(self.free)
        diagonal = _summed(self._block_i, ii, n) + _summed(self._block_j, jj, n)
        gradient = self.summed(g_i, g_j)
        if unary is not None:
            diagonal = diagonal + unary[0][self.free]
            gradient = gradient + unary[1][self.free]
        # Blocks below the diagonal: rows belong to the pose that is eliminated later.
        blocks = ij[self.both_free]
        below_blocks = np.where(self.swapped[:, None, None], blocks, np.swapaxes(blocks, 1, 2))
        below = _summed(self.block_of_pair, below_blocks, len(self.rows))
        return Blocks(diagonal, below), gradient

    def relative(
        self, H: Float64, g: Float64, T_i_j: Float64, unary: tuple[Float64, Float64] | None = None
    ) -> tuple[Blocks, Float64]:
        """Assemble from (m, 6, 6) H and (m, 6) g of the right perturbations of (m, 4, 4) T_i_j."""
        A = se3.adjoint(se3.inverse(T_i_j))
        At = np.swapaxes(A, 1, 2)
        AtH = At @ H
        return self.assemble(AtH @ A, -AtH, H, -(At @ g[..., None])[..., 0], g, unary)

    def gradient(self, g: Float64, T_i_j: Float64) -> Float64:
        """Return only the gradient (free poses x 6) of (m, 6) g, as in `relative`."""
        At = np.swapaxes(se3.adjoint(se3.inverse(T_i_j)), 1, 2)
        return self.summed(-(At @ g[..., None])[..., 0], g)

    def summed(self, g_i: Float64, g_j: Float64) -> Float64:
        """Return only the gradient (free poses x k) of (m, k) g_i and g_j, as in `assemble`."""
        n = len(self.free)
        return _summed(self._block_i, g_i, n) + _summed(self._block_j, g_j, n)

    def solve(
        self,
        H: Float64,
        g: Float64,
        T_i_j: Float64,
        damping: float = 0.0,
        unary: tuple[Float64, Float64] | None = None,
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
        unary
            Blocks and gradients of unary terms, see `assemble`.

        Returns
        -------
        (n, 6) steps d, to be applied as ``T_k exp(d_k)``; zero for fixed poses. None where the
        system is singular.
        """
        factor = self.factor(*self.relative(H, g, T_i_j, unary), damping)
        return None if factor is None else factor.step()

    def factor(self, matrix: Blocks, gradient: Float64, damping: float = 0.0) -> Factor | None:
        """Factorise an assembled system; None where it is singular."""
        if len(matrix.diagonal) and damping:
            entries = np.diagonal(matrix.diagonal, axis1=1, axis2=2)
            added = damping * np.maximum(entries, _MIN_SCALE * entries.max())
            diagonal = matrix.diagonal + added[..., None] * np.eye(self.size)
            matrix = matrix._replace(diagonal=diagonal)
        try:
            return Factor(self, matrix, gradient)
        except RuntimeError:
            return None


class Factor:
    """A factorised system. Raises RuntimeError where it is singular.

    Its values are kept until covariances overwrite them, and computed again if needed: those of a
    long trajectory need much memory.
    """

    def __init__(self, system: PairSystem, matrix: Blocks, gradient: Float64) -> None:
        self.system, self.gradient, self._matrix = system, gradient, matrix
        self._signs = np.empty(system.size * len(system.free))
        self._values: Float64 | None = self._factorised()

    def _factorised(self) -> Float64:
        panels, places = self.system.panels
        values = np.zeros(panels.value_start[-1])
        values[places] = np.concatenate(self._matrix)
        with one_blas_thread():
            if not kernels.factorise(panels, values, self._signs):
                raise RuntimeError("the system is singular")
        return values

    @property
    def positive_definite(self) -> bool:
        """Whether the matrix is positive definite."""
        return not (self._signs < 0).any()

    def step(self) -> Float64 | None:
        """Return the (n, k) solution of ``matrix x = -gradient``; None if not finite."""
        return self.solve(self.gradient)

    def solve(self, gradient: Float64) -> Float64 | None:
        """As `step`, with another gradient (free poses x k)."""
        system = self.system
        out = np.zeros((system.n, system.size))
        x = self.solve_columns(-gradient.reshape(-1, 1))
        if not np.isfinite(x).all():
            return None
        out[system.free] = x.reshape(-1, system.size)
        return out

    def solve_columns(self, rhs: Float64) -> Float64:
        """Return the solutions of the system for right-hand sides (free poses * k, q)."""
        if self._values is None:
            self._values = self._factorised()
        x = np.array(rhs, order="C")
        with one_blas_thread():
            kernels.solve(self.system.panels[0], self._values, self._signs, x)
        return x

    def joint_covariance(self, vertices: Intp) -> Float64:
        """Return the (v k, v k) joint covariance of some poses; zero for fixed ones."""
        system, k = self.system, self.system.size
        vertices = np.asarray(vertices, np.intp)
        out = np.zeros((len(vertices), k, len(vertices), k))
        free = np.flatnonzero(~system.fixed[vertices])
        if not len(free):
            return out.reshape(len(vertices) * k, -1)
        rows = (k * system.block_of_pose[vertices[free]][:, None] + np.arange(k)).ravel()
        # In batches, so that memory does not grow with the graph.
        batch_size = max(1, min(64, _MAX_RHS // (k * k * len(system.free))))
        for start in range(0, len(free), batch_size):
            batch = free[start : start + batch_size]
            columns = rows[k * start : k * (start + batch_size)]
            unit = np.zeros((k * len(system.free), len(columns)))
            unit[columns, np.arange(len(columns))] = 1
            covariances = self.solve_columns(unit)[rows].reshape(len(free), k, len(batch), k)
            out[free[:, None], :, batch, :] = np.swapaxes(covariances, 1, 2)
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
        diagonal, below = self._inverse()
        i, j = system.pairs.T
        blocks = np.concatenate([diagonal, np.zeros((1, 6, 6))])  # the last for fixed poses
        A = se3.adjoint(se3.inverse(T_i_j))
        At = np.swapaxes(A, 1, 2)
        C = blocks[system.block_of_pose[j]] + A @ blocks[system.block_of_pose[i]] @ At
        both_free = system.both_free
        pair_blocks = below[system.block_of_pair]
        # Blocks lie below the diagonal: (j, i) where i is eliminated first.
        C_j_i = np.where(system.swapped[:, None, None], np.swapaxes(pair_blocks, 1, 2), pair_blocks)
        AC = A[both_free] @ np.swapaxes(C_j_i, 1, 2)
        C[both_free] -= AC + np.swapaxes(AC, 1, 2)
        return C

    def _inverse(self) -> tuple[Float64, Float64]:
        """Return the blocks of the inverse: diagonal (free, 6, 6), and those of the pairs."""
        if not self.positive_definite:
            raise RuntimeError("the system is not positive definite")
        panels, places = self.system.panels
        values = self._factorised() if self._values is None else self._values
        self._values = None
        with one_blas_thread():
            kernels.invert(panels, values)
        blocks = values[places]
        n = len(self.system.free)
        return blocks[:n], blocks[n:]


def first_of_parts(n: int, pairs: Intp) -> Bool:
    """Return the (n,) mask of the first vertex of each connected part."""
    first = np.zeros(n, bool)
    if n:
        first[np.unique(parts_of(n, pairs), return_index=True)[1]] = True
    return first


def _summed(rows: Intp, values: Float64, count: int) -> Float64:
    """Return sums (count, ...) of values (m, ...), each added to its row; none to rows below 0."""
    width = int(np.prod(values.shape[1:]))
    sums = np.zeros((count, width))
    kernels.add_rows(rows, np.ascontiguousarray(values).reshape(len(values), width), sums)
    return sums.reshape(count, *values.shape[1:])


def _panels(n: int, rows: Intp, columns: Intp, size: int) -> kernels.Panels:
    """Return the layout of the factor of a matrix with blocks (b,) on and below its diagonal."""
    order = np.lexsort((rows, columns))
    start = np.searchsorted(columns[order], np.arange(n + 1))
    return kernels.layout(*kernels.fill_in(start, rows[order]), size)


def factor_size(n: int, pairs: Intp) -> int:
    """Return the number of values of the factor of n poses and their pairs (m, 2)."""
    i, j = pairs.T
    number = np.empty(n, np.intp)
    number[_elimination_order(n, i, j)] = np.arange(n)
    a, b = number[i], number[j]
    rows = np.concatenate([np.arange(n), np.maximum(a, b)])
    columns = np.concatenate([np.arange(n), np.minimum(a, b)])
    return int(_panels(n, rows, columns, 6).value_start[-1])


def sparsify(n: int, pairs: Intp) -> Bool:
    """Select pairs (m, 2) of n poses so that their factor is not larger than `MAX_FACTOR`.

    The factor of a camera that visits the same places repeatedly grows with the square of
    time, but few of its loops matter. If all pairs are too many, those within a band of poses are
    chosen, a tree that spans the graph, and as many of the others as fit: those of the most linked
    poses first. Removing these poses splits the graph into parts that are eliminated independently.

    Returns
    -------
    (m,) mask of the pairs.
    """
    max_blocks = MAX_FACTOR // 36
    if n * n <= max_blocks or not len(pairs):
        return np.ones(len(pairs), np.bool_)
    low, high = np.sort(pairs, axis=1).T
    edges, of_pair = np.unique(low * n + high, return_inverse=True)
    low, high = np.divmod(edges, n)
    # Poses with a single edge cause no fill-in.
    degree = np.bincount(np.concatenate([low, high]), minlength=n)
    core = degree > 1
    rank = np.cumsum(core)
    band = max_blocks // (2 * max(int(core.sum()), 1))
    long_range = np.greater(rank[high] - rank[low], band) & core[low] & core[high]
    # The tree prefers short-range edges.
    cost = sparse.coo_matrix((1.0 + long_range, (low, high)), shape=(n, n))
    tree = minimum_spanning_tree(cost.tocsr()).tocoo()
    chosen = ~long_range | np.isin(edges, tree.row.astype(np.int64) * n + tree.col)
    others = np.flatnonzero(~chosen)
    if not len(others):
        return np.ones(len(pairs), np.bool_)
    max_degree = np.maximum(degree[low], degree[high])[others]
    others = others[np.lexsort((low[others], -max_degree))]

    def fits(count: int) -> bool:
        kept = chosen.copy()
        kept[others[:count]] = True
        return factor_size(n, np.stack([low[kept], high[kept]], 1)) <= MAX_FACTOR

    # All at once, if a dense factor of one end of each would fit, or takes little time to reject.
    at_once = len(others) ** 2 <= 2 * max_blocks or n <= _FEW_POSES
    chosen[others[: _largest(len(others), fits, len(others) if at_once else 0)]] = True
    return np.asarray(chosen[of_pair], np.bool_)


def _largest(count: int, fits: Callable[[int], bool], first: int) -> int:
    """Return nearly the largest number up to `count` that fits: within a 64th of `count`.

    Numbers that don't fit take longest, so they grow from `first`, or a 16th of `count`.
    """
    low, high = 0, count + 1
    trial = first or max(count // 16, 1)
    while high - low > max(count // 64, 1):
        if fits(trial):
            low = trial
        else:
            high = trial
        trial = min(2 * low, count) if high > count else (low + high) // 2
    return count if high > count and fits(count) else low


def _elimination_order(n: int, i: Intp, j: Intp) -> Intp:
    """Return an elimination order with little fill-in: minimum degree on the pose graph."""
    if n < 2:
        return np.arange(n)
    links = sparse.coo_matrix((np.ones(len(i)), (i, j)), shape=(n, n)).tocsr()
    links = links + links.T
    degree = np.asarray(links.sum(axis=1)).ravel()
    laplacian = (sparse.diags(degree + 1) - links).tocsc()
    options = {"SymmetricMode": True}
    factor = splu(laplacian, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
    return np.argsort(factor.perm_c)
