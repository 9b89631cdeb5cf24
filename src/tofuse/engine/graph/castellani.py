"""Global optimisation of Castellani et al. (2002), as in sections 2.10 and 3.5 of the thesis.

Over all edges (i, j) with measurement G_ij = (R_ij, t_ij) the objective (eq 2.10) is::

    sum (angle(R_i R_ij R_j^T) / sigma_a)^2 + (|R_i t_ij + t_i - t_j| / sigma_t)^2

All edges have equal weight: their information is not used. Unknowns are a unit quaternion and a
translation of every view but the first. The thesis uses a general solver; here the objective is
the sum of squares of six residuals per edge, minimised by Levenberg-Marquardt with sparse
Jacobians.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from tofuse.engine.arrays import Bool, Float64, Intp
from tofuse.engine.geometry import quaternion, se3
from tofuse.engine.graph.graph import Optimisation, Optimiser, PoseGraph
from tofuse.engine.graph.levenberg import check_motions
from tofuse.engine.graph.sparse import first_of_parts
from tofuse.engine.parts import part

_ZERO = 1e-9  # m or rad: smaller lengths and angles are no normalisation factors


@dataclass(frozen=True, eq=False)
class Problem:
    """Eq 2.10 for one graph, as a function of quaternions and translations.

    Attributes
    ----------
    edges
        (M, 2) positions of the vertices i, j of each edge.
    R, t
        (M, 3, 3) and (M, 3): the measured T_i_j.
    sigma_angle, sigma_translation
        (M,) normalisation factors, rad and m.
    """

    edges: Intp
    R: Float64
    t: Float64
    sigma_angle: Float64
    sigma_translation: Float64

    @classmethod
    def of(cls, graph: PoseGraph) -> Problem:
        """Return the problem of a graph; see `normalisation_factors`."""
        sigma_angle, sigma_translation = normalisation_factors(graph)
        R, t = graph.measurements[:, :3, :3], graph.measurements[:, :3, 3]
        return cls(graph.edges, R, t, sigma_angle, sigma_translation)

    def residuals(self, q: Float64, t: Float64) -> Float64:
        """(M, 6) residuals: three of the rotation, three of the translation.

        The first three are the rotation vector of R_i R_ij R_j^T, whose norm is its screw angle.
        `q` is (N, 4), of any norm but zero (eq 2.11), `t` is (N, 3).
        """
        rotation, translation, _ = self._errors(q, t)
        return np.concatenate(
            [rotation / self.sigma_angle[:, None], translation / self.sigma_translation[:, None]],
            axis=1,
        )

    def objective(self, q: Float64, t: Float64) -> float:
        """Value of eq 2.10."""
        r = self.residuals(q, t)
        return float((r * r).sum())

    def jacobian(self, q: Float64, t: Float64) -> tuple[Float64, Float64]:
        """Return the (M, 6, 6) derivatives of the residuals by the vertices i and j.

        A vertex is perturbed by (d, p): t + d, and exp(p) R, that is, the quaternion (p / 2, 1) on
        the left to first order.
        """
        rotation, _, arm = self._errors(q, t)
        # log(exp(p) E) and log(E exp(-p)): left Jacobian inverse, and its transpose.
        J_left = se3.left_jacobian_inverse(rotation)
        J_i = np.zeros((len(arm), 6, 6))
        J_j = np.zeros((len(arm), 6, 6))
        by_angle = 1 / self.sigma_angle[:, None, None]
        by_length = 1 / self.sigma_translation[:, None, None]
        J_i[:, :3, 3:] = J_left * by_angle
        J_j[:, :3, 3:] = -np.swapaxes(J_left, 1, 2) * by_angle
        J_i[:, 3:, :3] = np.eye(3) * by_length
        J_j[:, 3:, :3] = -np.eye(3) * by_length
        J_i[:, 3:, 3:] = -se3.hat(arm) * by_length
        return J_i, J_j

    def _errors(self, q: Float64, t: Float64) -> tuple[Float64, Float64, Float64]:
        i, j = self.edges.T
        R = quaternion.to_matrix(q)
        arm = (R[i] @ self.t[..., None])[..., 0]
        rotation = se3.so3_log(R[i] @ self.R @ np.swapaxes(R[j], 1, 2))
        return rotation, arm + t[i] - t[j], arm


def normalisation_factors(graph: PoseGraph) -> tuple[Float64, Float64]:
    """Return sigma_a (rad) and sigma_t (m), (M,) each, as section 3.5 of the thesis.

    Root mean square of the screw angles, and of the lengths, of the sequential relative
    transformations; of all edges where none is sequential. A factor that would be zero, as for pure
    rotation or pure translation, is 1 (rad or m).
    """
    m = len(graph.edges)
    length = np.linalg.norm(graph.measurements[:, :3, 3], axis=1)
    used = ~graph.loop if (~graph.loop).any() else np.ones(m, bool)
    angle = se3.angle(graph.measurements)
    factors = [
        float(np.sqrt(np.mean(values[used] ** 2))) if m else 0.0 for values in (angle, length)
    ]
    sigma_angle, sigma_translation = (f if f > _ZERO else 1.0 for f in factors)
    return np.full(m, sigma_angle), np.full(m, sigma_translation)


@part("optimiser", "castellani", label="validated")
@dataclass(frozen=True)
class Castellani(Optimiser):
    """Distribute the error of the loops evenly over all edges (eq 2.10).

    The initial estimate is the poses of the graph. Connected parts of the graph are optimised
    separately; the first vertex of each is fixed.

    Attributes
    ----------
    max_iterations
        Maximum number of steps.
    tolerance
        Iterations stop when a step lowers the objective by a smaller fraction.
    """

    max_iterations: int = 200
    tolerance: float = 1e-9

    def optimise(self, graph: PoseGraph) -> Optimisation:
        """See `Optimiser.optimise`. The objective is logged after every step, and never rises.

        Raises InputError if a pose or a measurement is not a rigid motion.
        """
        check_motions(graph)
        problem = Problem.of(graph)
        q = quaternion.from_matrix(graph.poses[:, :3, :3])
        t = graph.poses[:, :3, 3].copy()
        free = free_vertices(graph)
        history = [problem.objective(q, t)]
        converged = not free.any() or history[0] == 0.0
        step = _Step(problem, free)
        for _ in range(self.max_iterations if not converged else 0):
            q_new, t_new, value = step.take(q, t, history[-1])
            if value is None:
                # Not even the shortest step lowers the objective.
                converged = True
                break
            q, t = q_new, t_new
            history.append(value)
            if history[-2] - value <= self.tolerance * history[-2] or value == 0.0:
                converged = True
                break
        poses = graph.poses.copy()
        poses[free, :3, :3] = quaternion.to_matrix(q[free])
        poses[free, :3, 3] = t[free]
        return Optimisation(graph.with_poses(poses), tuple(history), converged)


def free_vertices(graph: PoseGraph) -> Bool:
    """Return the (N,) mask of the free vertices: all but the first of each connected part."""
    return ~first_of_parts(len(graph.ids), graph.edges)


class _Step:
    """Levenberg-Marquardt steps; the damping is kept between them."""

    def __init__(self, problem: Problem, free: Bool) -> None:
        self.problem = problem
        self.free = free
        self.damping = 1e-6
        self._assemble = normal_equations(problem.edges, free)

    def take(self, q: Float64, t: Float64, value: float) -> tuple[Float64, Float64, float | None]:
        """Return q, t and the objective after one step; None if no step lowers it."""
        H, g = self._assemble(*self.problem.jacobian(q, t), self.problem.residuals(q, t))
        diagonal = H.diagonal()
        # Every direction is damped, even one in which the objective is flat.
        scale = np.maximum(diagonal, 1e-12 * diagonal.max())
        while self.damping < 1e12:
            x = _solve(H + sparse.diags(self.damping * scale, format="csc"), g)
            if x is None:
                self.damping *= 10
                continue
            q_new, t_new = q.copy(), t.copy()
            d = x.reshape(-1, 6)
            half = np.concatenate([d[:, 3:] / 2, np.ones((len(d), 1))], axis=1)
            rotated = quaternion.multiply(half, q[self.free])
            # Normalised after every step: the constraint |q| = 1.
            q_new[self.free] = rotated / np.linalg.norm(rotated, axis=1, keepdims=True)
            t_new[self.free] += d[:, :3]
            value_new = self.problem.objective(q_new, t_new)
            if value_new < value:
                self.damping = max(self.damping / 10, 1e-12)
                return q_new, t_new, value_new
            self.damping *= 10
        return q, t, None


def normal_equations(
    edges: Intp, free: Bool
) -> Callable[[Float64, Float64, Float64], tuple[Any, Float64]]:
    """Prepare the assembly of ``H = J^T J`` (sparse) and ``g = -J^T r`` of the free vertices.

    Returns a function of the edges' Jacobians J_i and J_j (M, k, 6) and residuals (M, k). The
    sparsity pattern is the same at every step, and computed once.
    """
    number = np.cumsum(free) - 1
    size = 6 * int(free.sum())
    i, j = edges.T
    rows, cols, masks = [], [], []
    for a, b in ((i, i), (j, j), (i, j), (j, i)):
        both_free = free[a] & free[b]
        block_rows = 6 * number[a[both_free]][:, None, None] + np.arange(6)[:, None]
        block_cols = 6 * number[b[both_free]][:, None, None] + np.arange(6)
        shape = (int(both_free.sum()), 6, 6)
        rows.append(np.broadcast_to(block_rows, shape).ravel())
        cols.append(np.broadcast_to(block_cols, shape).ravel())
        masks.append(both_free)
    indices = (np.concatenate(rows), np.concatenate(cols))

    def assemble(J_i: Float64, J_j: Float64, r: Float64) -> tuple[Any, Float64]:
        pairs = ((J_i, J_i), (J_j, J_j), (J_i, J_j), (J_j, J_i))
        blocks = [
            (np.swapaxes(A[both_free], 1, 2) @ B[both_free]).ravel()
            for (A, B), both_free in zip(pairs, masks, strict=True)
        ]
        H = sparse.csc_matrix((np.concatenate(blocks), indices), shape=(size, size))
        g = np.zeros((len(free), 6))
        np.add.at(g, i, -np.einsum("mki,mk->mi", J_i, r))
        np.add.at(g, j, -np.einsum("mki,mk->mi", J_j, r))
        return H, g[free].ravel()

    return assemble


def _solve(H: Any, g: Float64) -> Float64 | None:
    """Solve for a symmetric positive definite sparse matrix; None if it is singular."""
    try:
        factor = splu(
            H, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )
    except RuntimeError:
        return None
    return factor.solve(g)
