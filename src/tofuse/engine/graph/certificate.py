"""Certificate of global optimality of a pose graph's solution, by the dual of SE-Sync.

A descent finds a local minimum. The dual problem of Rosen, Carlone, Bandeira and Leonard
("SE-Sync", IJRR 2019) bounds the objective of all poses from below. It holds for isotropic weights
and chordal distances::

    f(R, t) = sum kappa |R_j - R_i Z|^2 + tau |t_j - t_i - R_i z|^2

Here f bounds the squared error F from below, edge by edge: kappa and tau are the largest such that
``diag(tau, 2 kappa)`` is not above the information, angles are not below their chords, and the
translation of a logarithm is not shorter than that of its transformation. So, for all poses::

    F >= f >= tr(Lambda) + 3 n min(0, lambda)

with any symmetric 3 x 3 matrices Lambda, one for each of the n poses, and the smallest eigenvalue
lambda of ``S = Q - Lambda``, where Q is the matrix of f without the translations, which are
eliminated. At a minimum of f Lambda follows from the poses, and tr(Lambda) is f; lambda is zero if
the minimum is global and the noise moderate. What remains between F and the bound is due to
anisotropic information and large angles: the bound is then true, but says less. Where it says too
little, there is a weaker statement: the minimum of f is global (that is what SE-Sync certifies),
and the descent of F from there ends in the same minimum as from the given poses.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse.linalg import LinearOperator, eigsh

from tofuse.engine.arrays import Float64, Intp
from tofuse.engine.geometry import quaternion, se3
from tofuse.engine.graph.graph import ROUNDING, PoseGraph
from tofuse.engine.graph.levenberg import check_graph
from tofuse.engine.graph.minimisation import Descent, Problem
from tofuse.engine.graph.sparse import MAX_FACTOR, Factor, PairSystem, factor_size, first_of_parts

# Largest fraction by which other poses could lower the squared error of certified ones; and f at a
# certified minimum.
_MAX_GAP, _MAX_ISOTROPIC_GAP = 0.05, 2e-3
# Largest difference of two objectives, as a fraction, at the same minimum.
_SAME = 1e-4
# What the first shift of S costs of the bound, as a fraction of f.
_SHIFT = 1e-4
_MIN_SHIFT = 1e-11  # of the largest entry of S: rounding


@dataclass(frozen=True)
class Certificate:
    """What is known about other poses: a lower bound on their squared error.

    Attributes
    ----------
    squared_error
        Of the given poses.
    lower_bound
        No poses have a smaller squared error.
    eigenvalue
        The smallest of the dual matrix at the nearest minimum of the isotropic problem. It is below
        zero if that is not the global one, or if the noise is too large; None if the weights leave
        poses undetermined.
    isotropic
        Whether this minimum is proven to be the global one of the isotropic problem, and descents
        of the squared error from there and from the given poses end in the same minimum.
    """

    squared_error: float
    lower_bound: float
    eigenvalue: float | None
    isotropic: bool

    @property
    def gap(self) -> float:
        """The largest fraction by which other poses could lower the squared error."""
        return 1 - self.lower_bound / self.squared_error if self.squared_error else 0.0

    @property
    def optimal(self) -> bool:
        """Whether no other poses lower the squared error by more than five per cent."""
        return self.gap <= _MAX_GAP

    def to_dict(self) -> dict[str, float | bool | None]:
        """Return the fields and what follows from them, as in `run.json`."""
        return {**vars(self), "gap": self.gap, "optimal": self.optimal}

    @property
    def text(self) -> str:
        """A sentence on what is certified; empty if nothing is."""
        if self.optimal:
            return (
                "No other poses fit these measurements better: none has a squared error that is "
                f"smaller by more than {100 * self.gap:.2g} % (certified)."
            )
        if self.isotropic:
            return (
                "If every measurement counts alike in all directions, no other poses fit better "
                "(certified), and from there the optimisation ends in the same minimum."
            )
        return ""


def certify(graph: PoseGraph, max_factor: int = MAX_FACTOR) -> Certificate | None:
    """Bound the squared error of a graph's poses; None if a factor has over `max_factor` values.

    The poses should be a solution. Gravity and robust kernels are not part of the squared error.

    Raises
    ------
    InputError
        If a pose, a measurement or information is invalid.
    """
    check_graph(graph)
    squared_error = graph.chi2()
    if squared_error <= ROUNDING * len(graph.edges):
        return Certificate(squared_error, squared_error, 0.0, True)
    if factor_size(len(graph.ids), graph.edges) > max_factor:
        return None
    problem = _Isotropic(graph)
    descent = Descent(problem, graph.poses)
    descent.run(_unchanged, np.ones_like, 1e-8, 50)
    dual, least = Dual(problem, descent.poses), float(descent.chi2.sum())
    eigenvalue, shift = dual.smallest_eigenvalue(_SHIFT * least)
    bound = float(np.trace(dual.multipliers, axis1=1, axis2=2).sum()) - 3 * len(graph.ids) * shift
    isotropic = bound >= (1 - _MAX_ISOTROPIC_GAP) * least and _same_minimum(graph, descent.poses)
    bound = float(np.clip(bound, 0, squared_error))
    return Certificate(squared_error, bound, eigenvalue, isotropic)


def _same_minimum(graph: PoseGraph, other: Float64) -> bool:
    """Whether descents from the graph's poses and from others end in the same minimum of F."""
    fixed = first_of_parts(len(graph.ids), graph.edges)
    problem = Problem(graph.edges, graph.measurements, graph.information, fixed, graph.gravity)
    ends = []
    for poses in (graph.poses, other):
        descent = Descent(problem, problem.start(poses))
        descent.run(_unchanged, np.ones_like, _SAME / 100, 50)
        ends.append(descent.value(_unchanged))
    return abs(ends[1] - ends[0]) <= _SAME * ends[0]


def _unchanged(x: Float64) -> Float64:
    return x


class _Isotropic(Problem):
    """The isotropic, chordal problem below that of a graph; its objective is f."""

    def __init__(self, graph: PoseGraph) -> None:
        self.tau, double_kappa = isotropic_weights(graph.information)
        self.kappa = double_kappa / 2
        information = np.zeros_like(graph.information)
        information[:, range(6), range(6)] = np.repeat(
            np.stack([self.tau, double_kappa], axis=1), 3, axis=1
        )
        fixed = first_of_parts(len(graph.ids), graph.edges)
        super().__init__(graph.edges, graph.measurements, information, fixed, None)

    def errors(self, poses: Float64) -> tuple[Float64, Float64]:
        """See `Problem.errors`. Rotations: twice the vector part of the quaternion."""
        E = self._error_motions(poses)
        q = quaternion.from_matrix(E[:, :3, :3])
        chord = 2 * np.where(q[:, 3:] < 0, -1.0, 1.0) * q[:, :3]
        return np.concatenate([E[:, :3, 3], chord], axis=1), np.zeros((0, 3))

    def linearised(
        self, poses: Float64, e: Float64, down: Float64, weights: Float64
    ) -> tuple[Any, Float64]:
        """See `Problem.linearised`."""
        i, j = self.pairs.T
        Rt = np.swapaxes(self._error_motions(poses)[:, :3, :3], 1, 2)
        cosine = np.sqrt(np.maximum(1 - (e[:, 3:] ** 2).sum(1) / 4, 0))
        g = np.concatenate(
            [
                self.tau[:, None] * (Rt @ e[:, :3, None])[..., 0],
                (2 * self.kappa * cosine)[:, None] * e[:, 3:],
            ],
            axis=1,
        )
        return self.assembled(poses, se3.inverse(poses[i]) @ poses[j], self.information, g)

    def _error_motions(self, poses: Float64) -> Float64:
        i, j = self.pairs.T
        return np.asarray(
            se3.inverse(self.measurements) @ (se3.inverse(poses[i]) @ poses[j]), np.float64
        )


def isotropic_weights(information: Float64) -> tuple[Float64, Float64]:
    """Return (m,) weights a, b such that ``diag(a I, b I)`` is not above the information.

    They are the largest in the ratio of the smallest information of translation and of rotation.
    """
    a = np.linalg.eigvalsh(information[:, :3, :3])[:, 0]
    b = np.linalg.eigvalsh(information[:, 3:, 3:])[:, 0]
    scale = np.repeat(np.stack([a, b], axis=1), 3, axis=1)
    usable = scale.min(axis=1) > 0
    root = np.sqrt(np.where(usable[:, None], scale, 1.0))
    scaled = information / (root[:, :, None] * root[:, None, :])
    common = np.where(usable, np.clip(np.linalg.eigvalsh(scaled)[:, 0], 0, 1), 0.0)
    return common * a, common * b


class Dual:
    """The matrix S of the dual at some poses, and its smallest eigenvalue.

    Its translations are not eliminated but kept as one more row of each pose: S plus a multiple of
    the identity is positive definite exactly if the whole matrix is, which is sparse.
    """

    def __init__(self, problem: _Isotropic, poses: Float64) -> None:
        n, pairs = len(poses), problem.pairs
        self._first = problem.fixed
        self._system = PairSystem(n, pairs, np.zeros(n, bool), size=4)
        kappa, tau = problem.kappa, problem.tau
        Z, z = problem.measurements[:, :3, :3], problem.measurements[:, :3, 3]
        rotation = np.diag([0.0, 1.0, 1.0, 1.0])
        arm = np.concatenate([np.ones((len(z), 1)), z], axis=1)
        self._jj = kappa[:, None, None] * rotation
        self._ii = self._jj + tau[:, None, None] * arm[:, :, None] * arm[:, None, :]
        self._jj[:, 0, 0] = tau
        self._ij = np.zeros_like(self._ii)
        self._ij[:, 1:, 1:] = -kappa[:, None, None] * Z
        self._ij[:, :, 0] = -tau[:, None] * arm
        self.multipliers = _multipliers(pairs, poses, Z, z, kappa, tau)

    def smallest_eigenvalue(self, loss: float) -> tuple[float | None, float]:
        """Return the smallest eigenvalue of S, and a shift that makes S positive definite.

        The first shift that is tried costs `loss` of the bound. A factor with positive signs proves
        that it suffices (Sylvester's law of inertia); the eigenvalue is by Lanczos iterations.
        """
        n = len(self.multipliers)
        largest = float(self._ii.max())
        shift = max(loss / (3 * n), _MIN_SHIFT * largest)
        factor = self._factor(shift)
        while factor is None and shift < 1e3 * largest * n:
            shift *= 10
            factor = self._factor(shift)
        if factor is None:
            return None, np.inf

        def solved(x: Float64) -> Float64:
            g = np.zeros((n, 4))
            g[:, 1:] = -x.reshape(n, 3)
            solution = factor.solve(g[self._system.free].ravel())
            assert solution is not None
            return solution[:, 1:].ravel()

        inverse = LinearOperator((3 * n, 3 * n), solved, dtype=np.float64)
        start = np.random.default_rng(0).normal(size=3 * n)
        value = eigsh(inverse, 1, which="LA", v0=start, return_eigenvectors=False, tol=1e-6)
        return 1 / float(value[0]) - shift, shift

    def _factor(self, shift: float) -> Factor | None:
        """Factorise S plus a multiple of the identity; None if it is not positive definite."""
        diagonal = np.zeros((len(self.multipliers), 4, 4))
        diagonal[:, 1:, 1:] = shift * np.eye(3) - self.multipliers
        diagonal[self._first, 0, 0] = self._jj[:, 0, 0].mean()  # holds the first translation
        zero = np.zeros((len(self._ii), 4))
        unary = diagonal, np.zeros((len(diagonal), 4))
        blocks = self._system.assemble(self._ii, self._ij, self._jj, zero, zero, unary)
        factor = self._system.factor(*blocks)
        return factor if factor is not None and factor.positive_definite else None


def _multipliers(
    pairs: Intp, poses: Float64, Z: Float64, z: Float64, kappa: Float64, tau: Float64
) -> Float64:
    """Return the (n, 3, 3) Lambda, the symmetric parts of the gradients times the rotations."""
    i, j = pairs.T
    R, t = poses[:, :3, :3], poses[:, :3, 3]
    chord = kappa[:, None, None] * np.swapaxes(R[j] - R[i] @ Z, 1, 2)
    offset = tau[:, None] * (t[j] - t[i] - (R[i] @ z[..., None])[..., 0])
    gradient = np.zeros((len(poses), 3, 3))
    np.add.at(gradient, j, chord)
    np.add.at(gradient, i, -Z @ chord - z[:, :, None] * offset[:, None, :])
    product = gradient @ R
    return (product + np.swapaxes(product, 1, 2)) / 2
