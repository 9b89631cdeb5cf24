"""Parametrisations of rotations in pose graphs: quaternions and direction cosines (chapter 8).

A chart defines the number of parameters of a pose, the derivative of the pose by them, and the
retraction after a step. All treat the position alike. The optimiser's own unknowns are right
perturbations of the poses.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.geometry import quaternion, se3
from tofuse.engine.graph import PoseGraph, solver, sparse


class Chart(Protocol):
    """A parametrisation of poses by `size` numbers."""

    size: int

    def basis(self, poses: Float64) -> tuple[Float64, Float64]:
        """Return the derivatives of a pose's right perturbation by its parameters.

        (n, 6, size), and the (n, size, size) projectors on directions that leave the manifold.
        """
        ...

    def retract(self, poses: Float64, step: Float64) -> Float64:
        """Return the poses after (n, size) steps, projected onto SE(3)."""
        ...


class Quaternion:
    """A translation and a quaternion, normalised after every step (eq 2.11)."""

    size = 7

    def basis(self, poses: Float64) -> tuple[Float64, Float64]:
        """See `Chart.basis`: a change dq rotates by twice the vector part of q* dq."""
        q = quaternion.from_matrix(poses[:, :3, :3])
        v, s = q[:, :3], q[:, 3]
        P = np.zeros((len(q), 6, 7))
        P[:, :3, :3] = np.eye(3)
        P[:, 3:, 3:6] = 2 * (s[:, None, None] * np.eye(3) - se3.hat(v))
        P[:, 3:, 6] = -2 * v
        normal_projector = np.zeros((len(q), 7, 7))
        normal_projector[:, 3:, 3:] = q[:, :, None] * q[:, None]
        return P, normal_projector

    def retract(self, poses: Float64, step: Float64) -> Float64:
        """See `Chart.retract`."""
        q = quaternion.from_matrix(poses[:, :3, :3]) + step[:, 3:]
        q /= np.linalg.norm(q, axis=1, keepdims=True)
        return _retracted(poses, step[:, :3], quaternion.to_matrix(q))


class Cosines:
    """A translation and the nine direction cosines, orthonormalised after every step."""

    size = 12

    def basis(self, poses: Float64) -> tuple[Float64, Float64]:
        """See `Chart.basis`: a change dR rotates by the antisymmetric part of R^T dR."""
        n = len(poses)
        P = np.zeros((n, 6, 12))
        P[:, :3, :3] = np.eye(3)
        turned = np.zeros((n, 3, 3, 9))  # R^T dR as a function of the nine numbers of dR
        for k in range(9):
            unit = np.zeros((3, 3))
            unit.flat[k] = 1
            turned[..., k] = np.swapaxes(poses[:, :3, :3], 1, 2) @ unit
        for axis, (a, b) in enumerate(((2, 1), (0, 2), (1, 0))):
            P[:, 3 + axis, 3:] = (turned[:, a, b] - turned[:, b, a]) / 2
        symmetric = ((turned + np.swapaxes(turned, 1, 2)) / 2).reshape(n, 9, 9)
        normal_projector = np.zeros((n, 12, 12))
        normal_projector[:, 3:, 3:] = np.swapaxes(symmetric, 1, 2) @ symmetric
        return P, normal_projector

    def retract(self, poses: Float64, step: Float64) -> Float64:
        """See `Chart.retract`."""
        out = poses.copy()
        out[:, :3, :3] += step[:, 3:].reshape(-1, 3, 3)
        return _retracted(poses, step[:, :3], se3.orthonormalise(out)[:, :3, :3])


def _retracted(poses: Float64, slide: Float64, R: Float64) -> Float64:
    """Return poses with rotations R, translated along the screw motion, as by `se3.exp`."""
    out = poses.copy()
    turn = se3.so3_log(np.swapaxes(poses[:, :3, :3], 1, 2) @ R)
    along = se3.left_jacobian(turn) @ slide[..., None]
    out[:, :3, 3] += (poses[:, :3, :3] @ along)[..., 0]
    out[:, :3, :3] = R
    return out


class ChartProblem(solver.Problem):
    """The least squares problem of a pose graph, in the parameters of a chart.

    The first vertex of each connected part is fixed.
    """

    def __init__(self, graph: PoseGraph, chart: Chart) -> None:
        fixed = sparse.first_of_parts(len(graph.ids), graph.edges)
        super().__init__(graph.edges, graph.measurements, graph.information, fixed, graph.gravity)
        self.chart = chart
        fixed = self.system.fixed
        self.system = sparse.PairSystem(len(fixed), self.all_pairs, fixed, size=chart.size)

    def assembled(
        self, poses: Float64, T_i_j: Float64, H: Float64, g: Float64
    ) -> tuple[Any, Float64]:
        """See `Problem.assembled`."""
        P, normal_projector = self.chart.basis(poses)
        i, j = self.all_pairs.T
        A = se3.adjoint(se3.inverse(T_i_j)) @ P[i]
        At, Pt = np.swapaxes(A, 1, 2), np.swapaxes(P, 1, 2)
        HA, HP = H @ A, H @ P[j]
        scale = float(np.mean(np.diagonal(H, axis1=1, axis2=2)))
        block = scale * normal_projector
        if self.unary is not None:
            block = block + Pt @ self.unary[0] @ P
        unary = block, np.zeros(block.shape[:2])
        column = g[..., None]
        return self.system.assemble(
            At @ HA, -At @ HP, Pt[j] @ HP, -(At @ column)[..., 0], (Pt[j] @ column)[..., 0], unary
        )

    def retract(self, poses: Float64, step: Float64) -> Float64:
        """See `Problem.retract`."""
        return self.chart.retract(poses, step)


def descend(graph: PoseGraph, chart: Chart, tolerance: float) -> solver.Descent:
    """Minimise the squared errors of all edges and of gravity in the parameters of a chart.

    Parameters
    ----------
    graph
        With the initial poses.
    chart
        The parametrisation.
    tolerance
        See `Descent.run`.
    """
    problem = ChartProblem(graph, chart)
    descent = solver.Descent(problem, problem.start(graph.poses))
    descent.run(lambda x: x, np.ones_like, tolerance, 100)
    return descent
