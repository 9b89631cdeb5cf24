"""Levenberg-Marquardt over edges and gravity: residuals, normal equations, and steps."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from tofuse.engine.arrays import Bool, Float64, Intp
from tofuse.engine.geometry import se3, tangents
from tofuse.engine.graph import edge_kernels, robust
from tofuse.engine.graph.graph import ROUNDING, Gravity
from tofuse.engine.graph.sparse import Factor, PairSystem, equations

_MAX_ANGLE = 3.0  # rad, of errors by the kernel


class Problem:
    """Edges and gravity, evaluated and linearised.

    The direction of gravity in the world is an additional pose with only two observable directions;
    a prior of unit information constrains the others.
    """

    def __init__(
        self,
        pairs: Intp,
        measurements: Float64,
        information: Float64,
        fixed: Bool,
        gravity: Gravity | None,
    ) -> None:
        self.fixed, self.information, self.gravity = fixed, information, gravity
        self.pairs, self.measurements = pairs, measurements
        n = len(fixed)
        all_pairs, all_fixed = pairs, fixed
        self.unary: tuple[Float64, Float64] | None = None
        if gravity is not None:
            world = np.full(len(gravity.vertices), n)
            all_pairs = np.concatenate([pairs, np.stack([world, gravity.vertices], axis=1)])
            all_fixed = np.append(fixed, False)
            block = np.zeros((n + 1, 6, 6))
            block[n] = np.eye(6)
            self.unary = block, np.zeros((n + 1, 6))
        self.all_pairs = all_pairs
        self.system = PairSystem(len(all_fixed), all_pairs, all_fixed)

    def start(self, poses: Float64) -> Float64:
        """Return the initial poses, followed by that of the vertical if there is gravity."""
        poses = np.array(poses, float)
        if self.gravity is None:
            return poses
        R = poses[self.gravity.vertices, :3, :3]
        down = self.gravity.vertical((R @ self.gravity.directions[..., None])[..., 0])
        # A rotation with down as its third axis; the other two are arbitrary.
        down = down / np.linalg.norm(down)
        return np.concatenate([poses, se3.pose(np.stack([*tangents(down), down], axis=1))[None]])

    def errors(self, poses: Float64) -> tuple[Float64, Float64]:
        """Return the errors of the edges (m, 6), and those of gravity (g, 3) over their sigma."""
        e = np.empty((len(self.pairs), 6))
        edge_kernels.errors(self.measurements, poses, self.pairs, e)
        # Near half a turn only the logarithm by quaternions is exact.
        turned = np.flatnonzero((e[:, 3:] ** 2).sum(1) > _MAX_ANGLE**2)
        i, j = self.pairs[turned].T
        Z_inverse = se3.inverse(self.measurements[turned])
        e[turned] = se3.log(Z_inverse @ (se3.inverse(poses[i]) @ poses[j]))
        if self.gravity is None:
            return e, np.zeros((0, 3))
        return e, (self._observed_down(poses) - [0, 0, 1]) / self.gravity.sigma[:, None]

    def _observed_down(self, poses: Float64) -> Float64:
        assert self.gravity is not None
        world, R = poses[-1, :3, :3], poses[self.gravity.vertices, :3, :3]
        return (world.T @ R @ self.gravity.directions[..., None])[..., 0]

    def gravity_cost(self, down: Float64) -> float:
        """Return the contribution of gravity's errors (g, 3) to the objective."""
        if self.gravity is None:
            return 0.0
        return float(robust.cost("geman-mcclure", (down**2).sum(-1), self.gravity.gate).sum())

    def linearised(
        self, poses: Float64, e: Float64, down: Float64, weights: Float64
    ) -> tuple[Any, Float64]:
        """Return the normal equations (matrix, gradient) at the poses of the given errors."""
        H, g = equations(e, self.information, weights)
        i, j = self.all_pairs.T
        T_i_j = se3.inverse(poses[i]) @ poses[j]
        if self.gravity is not None:
            J = np.zeros((len(down), 3, 6))
            R = T_i_j[len(self.pairs) :, :3, :3]
            J[:, :, 3:] = (
                -(R @ se3.hat(self.gravity.directions)) / self.gravity.sigma[:, None, None]
            )
            weight = robust.weight("geman-mcclure", (down**2).sum(-1), self.gravity.gate)
            Jt = np.swapaxes(J, 1, 2) * weight[:, None, None]
            H = np.concatenate([H, Jt @ J])
            g = np.concatenate([g, (Jt @ down[..., None])[..., 0]])
        return self.assembled(poses, T_i_j, H, g)

    def assembled(
        self, poses: Float64, T_i_j: Float64, H: Float64, g: Float64
    ) -> tuple[Any, Float64]:
        """Return the normal equations (matrix, gradient) of the unknowns of `retract`.

        Parameters
        ----------
        poses
            (n, 4, 4), the linearisation point.
        T_i_j, H, g
            (m, 4, 4) relative poses, (m, 6, 6) matrix and (m, 6) gradient of each edge.
        """
        return self.system.relative(H, g, T_i_j, self.unary)

    def retract(self, poses: Float64, step: Float64) -> Float64:
        """Return the poses after (n, 6) steps."""
        return poses @ se3.exp(step)

    def factor(self, poses: Float64, weights: Float64) -> Factor | None:
        """Factorise the undamped normal equations; None if singular."""
        all_poses = poses if len(poses) == len(self.system.fixed) else self.start(poses)
        matrix, gradient = self.linearised(all_poses, *self.errors(all_poses), weights)
        return self.system.factor(matrix, gradient)


Cost = Callable[[Float64], Float64]


class Descent:
    """Levenberg-Marquardt steps; the damping is kept between runs."""

    def __init__(self, problem: Problem, poses: Float64) -> None:
        self.problem, self.poses = problem, poses
        self.damping = 1e-7
        self.log: list[tuple[Float64, float]] = []
        self._evaluate()
        self._record()

    def _evaluate(self) -> None:
        self.e, self.down = self.problem.errors(self.poses)
        self.chi2 = np.einsum("mi,mij,mj->m", self.e, self.problem.information, self.e)

    def state(self) -> tuple[Float64, Float64, Float64, Float64]:
        """Return the state that `restore` takes."""
        return self.poses, self.e, self.down, self.chi2

    def restore(self, state: tuple[Float64, Float64, Float64, Float64]) -> None:
        """Restore a state, and log it."""
        self.poses, self.e, self.down, self.chi2 = state
        self._record()

    def _record(self) -> None:
        self.log.append((self.chi2, self.problem.gravity_cost(self.down)))

    def run(self, total: Cost, weights: Cost, tolerance: float, iterations: int) -> bool:
        """Iterate until a step lowers the objective by less than `tolerance` of it.

        Returns whether that was reached within the iterations.
        """
        problem = self.problem
        if problem.fixed.all():
            return True
        value = self.value(total)
        for _ in range(iterations):
            if value <= ROUNDING * len(problem.pairs):
                return True
            matrix, gradient = problem.linearised(self.poses, self.e, self.down, weights(self.chi2))
            before = value
            while True:
                lowered = self._try_step(matrix, gradient, total, value)
                if lowered is not None:
                    break
                self.damping = max(self.damping * 10, 1e-7)
                if self.damping > 1e8:
                    # Not even the shortest step lowers the objective.
                    self.damping = 1e-7
                    return True
            value = lowered
            self.damping = max(self.damping / 10, 1e-12)
            self._record()
            if before - value <= tolerance * before:
                return True
        return False

    def _try_step(self, matrix: Any, gradient: Float64, total: Cost, value: float) -> float | None:
        """Take a step if it lowers the objective; returns the new one, or None if rejected."""
        factor = self.problem.system.factor(matrix, gradient, self.damping)
        step = None if factor is None else factor.step()
        if step is None:
            return None
        previous = self.state()
        fixed = self.problem.system.fixed
        stepped = self.problem.retract(self.poses, step)
        self.poses = np.where(fixed[:, None, None], self.poses, stepped)
        self._evaluate()
        new_value = self.value(total)
        if new_value < value:
            return new_value
        self.poses, self.e, self.down, self.chi2 = previous
        return None

    def value(self, total: Cost) -> float:
        """Return the objective."""
        return float(total(self.chi2).sum()) + self.problem.gravity_cost(self.down)
