"""Global relaxation in six dimensions, after Lu and Milios (1997) and Borrmann et al. (2008).

Each edge measures the relative correction of its two poses: D_ij, a small motion in the world's
frame (v, w), p -> p + v + w x p, with the inverse covariance C_ij^-1 of the pair. To first order
the motions X_i of the poses then minimise::

    sum (X_j - X_i - D_ij)^T C_ij^-1 (X_j - X_i - D_ij)

which is linear, G X = B, and solved exactly in one step (Borrmann et al. 2008, eqs 3 to 8). The
poses, as a position and Euler angles, move by H_i^-1 X_i, with H the derivative of the motion by
the six parameters (their eq 17); then D and C are recomputed, until convergence.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from tofuse.engine.arrays import Float64
from tofuse.engine.geometry import se3
from tofuse.engine.graph import Optimisation, Optimiser, PoseGraph, levenberg, sparse
from tofuse.engine.parts import part

# Heading, pitch, roll of a camera (y down): singular only where it looks straight up or down.
_EULER = "YXZ"
_ROUNDING = 1e-12  # squared error of an edge that counts as none
_RELATIVE_ROUNDING = 1e-6  # relative increase that counts as rounding error


@part("optimiser", "lu-milios", label="validated")
@dataclass(frozen=True)
class LuMilios(Optimiser):
    """Solve the linearised graph iteratively (Borrmann et al. 2008).

    Edges are weighted by their information, without damping or robust kernel. The first vertex of
    each connected component is fixed. Returns the best poses of all iterations; the input if no
    step lowers the error. Gravity is not used.

    Attributes
    ----------
    max_iterations
        Maximum number of linear systems to solve.
    tolerance
        Minimum relative decrease of the sum of weighted squared errors.
    """

    max_iterations: int = 50
    tolerance: float = 1e-6

    def optimise(self, graph: PoseGraph) -> Optimisation:
        """See `Optimiser.optimise`. Raises InputError for non-finite or non-positive input."""
        levenberg.check_graph(graph)
        system = sparse.PairSystem(len(graph.ids), graph.edges)
        best, history = graph, [graph.chi2()]
        converged = bool(system.fixed.all()) or history[0] <= _ROUNDING * len(graph.edges)
        current = graph
        for _ in range(0 if converged else self.max_iterations):
            motion = solve_linear(current, system)
            if motion is None:
                break
            updated = _apply_motion(current.poses, motion)
            updated[system.fixed] = graph.poses[system.fixed]
            current = graph.with_poses(updated)
            previous = min(history)
            history.append(current.chi2())
            if history[-1] < previous:
                best = current
            if previous - history[-1] <= self.tolerance * previous:
                # Converged, or diverging.
                converged = history[-1] <= (1 + _RELATIVE_ROUNDING) * previous
                break
        if history[-1] > min(history):
            history.append(min(history))  # return to the best
        return Optimisation(best, tuple(history), converged)


def solve_linear(graph: PoseGraph, system: sparse.PairSystem) -> Float64 | None:
    """(N, 6) motions X of the poses in the world's frame that solve G X = B; None if singular."""
    j = graph.edges[:, 1]
    e = graph.residuals()
    adjoint_camera_world = se3.adjoint(se3.inverse(graph.poses[j]))
    D = -(se3.adjoint(graph.poses[j]) @ e[..., None])[..., 0]
    C_inverse = np.swapaxes(adjoint_camera_world, 1, 2) @ graph.information @ adjoint_camera_world
    weighted_D = (C_inverse @ D[..., None])[..., 0]
    matrix, gradient = system.assemble(C_inverse, -C_inverse, C_inverse, weighted_D, -weighted_D)
    factor = system.factor(matrix, gradient)
    return None if factor is None else factor.step()


def _apply_motion(poses: Float64, motion: Float64) -> Float64:
    """Poses (N, 4, 4) after motions X in the world's frame, via position and Euler angles."""
    angles = Rotation.from_matrix(poses[:, :3, :3]).as_euler(_EULER)
    E = np.zeros((len(poses), 3, 3))  # w = E @ change of the angles
    first_axis = np.eye(3)["XYZ".index(_EULER[0])]
    R_first = Rotation.from_euler(_EULER[:1], angles[:, :1])
    R_first_two = Rotation.from_euler(_EULER[:2], angles[:, :2])
    E[:, :, 0] = first_axis
    E[:, :, 1] = R_first.apply(np.eye(3)["XYZ".index(_EULER[1])])
    E[:, :, 2] = R_first_two.apply(np.eye(3)["XYZ".index(_EULER[2])])
    v, w = motion[:, :3], motion[:, 3:]
    out = poses.copy()
    # H^-1: the position moves with the frame, the angles follow from w.
    out[:, :3, 3] += v + np.cross(w, poses[:, :3, 3])
    angle_change = (np.linalg.pinv(E) @ w[..., None])[..., 0]
    out[:, :3, :3] = Rotation.from_euler(_EULER, angles + angle_change).as_matrix()
    return out
