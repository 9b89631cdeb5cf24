"""Least squares over a pose graph, on plain arrays: sparse Levenberg-Marquardt on SE(3).

The objective is the sum over all edges of ``e^T Omega e`` with ``e = log(Z^-1 T_i^-1 T_j)``, in
which edges that close loops may be judged by a robust kernel (`tofuse.posegraph.robust`), and of
what gravity says of single poses. Poses are perturbed on the right. With ``E = exp(e)``::

    log(E exp(xi)) = e + J_r^-1(e) xi,    xi = d_j - Ad(T_j_i) d_i

so the Jacobians are the inverse right Jacobian of SE(3), and that times an adjoint.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tofuse.geometry import se3
from tofuse.posegraph import robust
from tofuse.posegraph.charts import CHARTS, Chart, Rotation
from tofuse.posegraph.graph import Gravity
from tofuse.posegraph.robust import Robust
from tofuse.posegraph.sparse import Factor, PairSystem, first_of_parts

Float64 = NDArray[np.float64]
Integers = NDArray[np.intp]
Bool = NDArray[np.bool_]

_MEDIAN = 5.348  # of a chi-square variable with six degrees of freedom
_NOTHING = 1e-12  # mean squared error of an edge, in units of its information: rounding
_ROUNDS = 20  # at most so many times edges are taken in or left out at the end


@dataclass(frozen=True)
class Settings:
    """How to minimise.

    Attributes
    ----------
    robust
        Kernel of the loop edges.
    gate
        Threshold on an edge's squared error in units of its information: at 100, ten standard
        deviations. (That of a good edge is a chi-square variable with six degrees of freedom,
        above 40 only once in two million; but few are so good.)
    slack
        The information may overstate what the loops are worth: by so much, as a ratio of standard
        deviations, the threshold may grow, if the median error of the accepted loops asks for
        it. Of "truncated" alone.
    rotation
        Numbers that stand for a rotation, see `tofuse.posegraph.charts`.
    tolerance
        Stop when a step lowers the objective by less than this share of it.
    max_iterations
        At most so many steps, in each of the stages of "truncated".
    """

    robust: Robust = "truncated"
    gate: float = 100.0
    slack: float = 3.0
    rotation: Rotation = "tangent"
    tolerance: float = 1e-6
    max_iterations: int = 100


@dataclass(frozen=True, eq=False)
class Solution:
    """What came out.

    Attributes
    ----------
    poses
        (n, 4, 4).
    chi2
        (m,) squared errors of the edges, weighted by their full information.
    weights
        (m,) share of its information with which each edge counted in the end.
    history
        The objective at the start and after every step. It falls at every step, unless
        "truncated" had to choose among the edges: it is that of the edges chosen in the end, those
        that it left out counting as much as an edge at the threshold.
    converged
        Whether the stopping rule was met.
    """

    poses: Float64
    chi2: Float64
    weights: Float64
    history: tuple[float, ...]
    converged: bool
    _problem: _Problem = field(repr=False)

    def factor(self) -> Factor | None:
        """Factorise the normal equations at the solution, for covariances; None if singular."""
        return self._problem.factor(self.poses, self.weights)


def solve(
    poses: Float64,
    pairs: Integers,
    measurements: Float64,
    information: Float64,
    *,
    loop: Bool | None = None,
    fixed: Bool | None = None,
    gravity: Gravity | None = None,
    settings: Settings | None = None,
) -> Solution:
    """Find the poses that fit the measured relative poses best, starting from those given.

    Parameters
    ----------
    poses
        (n, 4, 4) T_world_k.
    pairs
        (m, 2) positions i, j.
    measurements, information
        (m, 4, 4) measured T_i_j and (m, 6, 6) information of ``log(Z^-1 T_i^-1 T_j)``.
    loop
        (m,) mask of the edges that the robust kernel judges; none unless given.
    fixed
        (n,) mask of poses that don't move; the first of each connected part unless given.
    gravity
        Directions measured by single cameras.
    settings
        Kernel, thresholds and stopping rule.
    """
    settings = settings or Settings()
    pairs = np.asarray(pairs, np.intp).reshape(-1, 2)
    loop = np.zeros(len(pairs), bool) if loop is None else np.asarray(loop, bool)
    fixed = first_of_parts(len(poses), pairs) if fixed is None else np.asarray(fixed, bool)
    problem = _Problem(pairs, measurements, information, fixed, gravity, settings.rotation)
    if settings.robust == "truncated" and loop.any():
        return _Truncated(problem, poses, loop, settings).run()
    kernel = settings.robust if settings.robust != "truncated" else "none"

    def total(x: Float64) -> Float64:
        return np.where(loop, robust.cost(kernel, x, settings.gate), x)

    def weights(x: Float64) -> Float64:
        return np.where(loop, robust.weight(kernel, x, settings.gate), 1.0)

    descent = _Descent(problem, problem.start(poses))
    converged = descent.run(total, weights, settings.tolerance, settings.max_iterations)
    chi2 = descent.chi2
    history = tuple(float(total(x).sum()) + extra for x, extra in descent.log)
    n = len(problem.fixed)
    return Solution(descent.poses[:n], chi2, weights(chi2), history, converged, problem)


class _Problem:
    """Edges and gravity, evaluated and linearised.

    Where the direction of gravity in the world is not known, it is one more pose, of which only
    two directions matter; the others are held by a unit of information.
    """

    def __init__(
        self,
        pairs: Integers,
        measurements: Float64,
        information: Float64,
        fixed: Bool,
        gravity: Gravity | None,
        rotation: Rotation,
    ) -> None:
        self.fixed, self.information, self.gravity = fixed, information, gravity
        self.pairs = pairs
        self.chart: Chart = CHARTS[rotation]()
        self._Z_inverse = se3.inverse(measurements)
        n = len(fixed)
        joined, held = pairs, fixed
        self._single: tuple[Float64, Float64] | None = None
        if gravity is not None:
            world = np.full(len(gravity.vertices), n)
            joined = np.concatenate([pairs, np.stack([world, gravity.vertices], axis=1)])
            held = np.append(fixed, gravity.world is not None)
            block = np.zeros((n + 1, 6, 6))
            block[n] = np.eye(6)
            self._single = block, np.zeros((n + 1, 6))
        self._joined = joined
        self.system = PairSystem(len(held), joined, held, size=self.chart.size)

    def start(self, poses: Float64) -> Float64:
        """Poses with the one of gravity's world behind them, where there is gravity."""
        poses = np.array(poses, float)
        if self.gravity is None:
            return poses
        down = self.gravity.world
        if down is None:
            R = poses[self.gravity.vertices, :3, :3]
            seen = (R @ self.gravity.directions[..., None])[..., 0]
            down = (seen / self.gravity.sigma[:, None] ** 2).sum(0)
        # The rotation whose third axis is down; the other two don't matter.
        down = down / np.linalg.norm(down)
        x = np.cross(np.eye(3)[np.argmin(np.abs(down))], down)
        x /= np.linalg.norm(x)
        T = np.eye(4)
        T[:3, :3] = np.stack([x, np.cross(down, x), down], axis=1)
        return np.concatenate([poses, T[None]])

    def errors(self, poses: Float64) -> tuple[Float64, Float64]:
        """Return the edges' errors (m, 6) and gravity's (g, 3), each over its sigma."""
        i, j = self.pairs.T
        e = se3.log(self._Z_inverse @ (se3.inverse(poses[i]) @ poses[j]))
        if self.gravity is None:
            return e, np.zeros((0, 3))
        return e, (self._seen_down(poses) - [0, 0, 1]) / self.gravity.sigma[:, None]

    def _seen_down(self, poses: Float64) -> Float64:
        assert self.gravity is not None
        world, R = poses[-1, :3, :3], poses[self.gravity.vertices, :3, :3]
        return (world.T @ R @ self.gravity.directions[..., None])[..., 0]

    def linearised(
        self, poses: Float64, e: Float64, down: Float64, weights: Float64
    ) -> tuple[object, Float64]:
        """Normal equations (matrix, gradient) where the errors were taken."""
        J = se3.jacobian_inverse(e)
        JtW = np.swapaxes(J, 1, 2) @ (weights[:, None, None] * self.information)
        H, g = JtW @ J, (JtW @ e[..., None])[..., 0]
        i, j = self._joined.T
        T_i_j = se3.inverse(poses[i]) @ poses[j]
        if self.gravity is not None:
            J = np.zeros((len(down), 3, 6))
            R = T_i_j[len(self.pairs) :, :3, :3]
            J[:, :, 3:] = (
                -(R @ se3.hat(self.gravity.directions)) / self.gravity.sigma[:, None, None]
            )
            Jt = np.swapaxes(J, 1, 2)
            H = np.concatenate([H, Jt @ J])
            g = np.concatenate([g, (Jt @ down[..., None])[..., 0]])
        basis = self.chart.basis(poses)
        if basis is None:
            return self.system.relative(H, g, T_i_j, self._single)
        return self._in_chart(H, g, T_i_j, *basis)

    def _in_chart(
        self, H: Float64, g: Float64, T_i_j: Float64, P: Float64, off: Float64
    ) -> tuple[object, Float64]:
        i, j = self._joined.T
        A = se3.adjoint(se3.inverse(T_i_j)) @ P[i]
        At, Pt = np.swapaxes(A, 1, 2), np.swapaxes(P, 1, 2)
        HA, HP = H @ A, H @ P[j]
        scale = float(np.mean(np.diagonal(H, axis1=1, axis2=2)))
        block = scale * off
        if self._single is not None:
            block = block + Pt @ self._single[0] @ P
        single = block, np.zeros(block.shape[:2])
        column = g[..., None]
        return self.system.assemble(
            At @ HA, -At @ HP, Pt[j] @ HP, -(At @ column)[..., 0], (Pt[j] @ column)[..., 0], single
        )

    def factor(self, poses: Float64, weights: Float64) -> Factor | None:
        """Factorise the undamped normal equations in the tangent chart."""
        plain = self
        if self.chart.size != 6:
            plain = _Problem(
                self.pairs, se3.inverse(self._Z_inverse), self.information, self.fixed,
                self.gravity, "tangent",
            )  # fmt: skip
        everywhere = plain.start(poses)
        matrix, gradient = plain.linearised(everywhere, *plain.errors(everywhere), weights)
        return plain.system.factor(matrix, gradient)


Cost = Callable[[Float64], Float64]


class _Descent:
    """Levenberg-Marquardt steps; the damping is carried from one run to the next."""

    def __init__(self, problem: _Problem, poses: Float64) -> None:
        self.problem, self.poses = problem, poses
        self.damping = 1e-7
        self.log: list[tuple[Float64, float]] = []
        self._see()
        self._note()

    def _see(self) -> None:
        self.e, self.down = self.problem.errors(self.poses)
        self.chi2 = np.einsum("mi,mij,mj->m", self.e, self.problem.information, self.e)

    def _note(self) -> None:
        self.log.append((self.chi2, float((self.down**2).sum())))

    def run(self, total: Cost, weights: Cost, tolerance: float, iterations: int) -> bool:
        """Step down until a step gains too little; whether that came before the last step."""
        problem = self.problem
        if problem.fixed.all():
            return True
        value = self._value(total)
        for _ in range(iterations):
            if value <= _NOTHING * len(problem.pairs):
                return True
            matrix, gradient = problem.linearised(self.poses, self.e, self.down, weights(self.chi2))
            before = value
            while True:
                found = self._try(matrix, gradient, total, value)
                if found is not None:
                    break
                self.damping = max(self.damping * 10, 1e-7)
                if self.damping > 1e8:
                    # Not even the shortest step goes down.
                    self.damping = 1e-7
                    return True
            value = found
            self.damping = max(self.damping / 10, 1e-12)
            self._note()
            if before - value <= tolerance * before:
                return True
        return False

    def _try(self, matrix: object, gradient: Float64, total: Cost, value: float) -> float | None:
        """Take one step if it goes down; the new objective, or None and everything as before."""
        factor = self.problem.system.factor(matrix, gradient, self.damping)
        step = None if factor is None else factor.step()
        if step is None:
            return None
        kept = self.poses, self.e, self.down, self.chi2
        held = self.problem.system.fixed
        moved = self.problem.chart.retract(self.poses, step)
        self.poses = np.where(held[:, None, None], self.poses, moved)
        self._see()
        new = self._value(total)
        if new < value:
            return new
        self.poses, self.e, self.down, self.chi2 = kept
        return None

    def _value(self, total: Cost) -> float:
        return float(total(self.chi2).sum()) + float((self.down**2).sum())


class _Truncated:
    """Loops count in full or not at all; which ones is found by graduated non-convexity.

    First all count. Where all then fit, that is the result, and it is that of least squares.
    Otherwise the threshold of a Geman-McClure kernel falls from the largest error by half at
    every step (Yang et al. 2020), so that the worst loops lose their weight first, and the others
    come to fit better. At the end edges are taken in or left out until nothing changes.
    """

    def __init__(self, problem: _Problem, poses: Float64, loop: Bool, settings: Settings) -> None:
        self.loop, self.settings = loop, settings
        self.problem = problem
        self.descent = _Descent(problem, problem.start(poses))

    def run(self) -> Solution:
        """Return the solution; the threshold stands from the first check of the accepted loops."""
        loop, settings, descent = self.loop, self.settings, self.descent
        ones = np.ones(len(loop))
        converged = self._with(ones)
        gate = self._gate(descent.chi2[loop])
        weights = ones
        if not (descent.chi2[loop] <= gate).all():
            self._graduate()
            accepted = descent.chi2[loop] <= settings.gate * settings.slack**2
            gate = self._gate(descent.chi2[loop][accepted])
            converged, weights = self._settle(gate)
        limit = np.where(loop & (weights < 1).any(), gate, np.inf)
        history = tuple(float(np.minimum(x, limit).sum()) + extra for x, extra in descent.log)
        n = len(self.problem.fixed)
        return Solution(descent.poses[:n], descent.chi2, weights, history, converged, self.problem)

    def _with(self, weights: Float64) -> bool:
        settings = self.settings
        return self.descent.run(
            lambda x: weights * x, lambda x: weights, settings.tolerance, settings.max_iterations
        )

    def _gate(self, chi2: Float64) -> float:
        """Threshold on the squared error, no lower than what accepted loops show of themselves."""
        spread = float(np.median(chi2)) / _MEDIAN if len(chi2) else 1.0
        return self.settings.gate * float(np.clip(spread, 1.0, self.settings.slack**2))

    def _graduate(self) -> None:
        loop, descent = self.loop, self.descent
        lowest = self.settings.gate
        c = float(descent.chi2[loop].max())
        while c > lowest:
            c = max(c / 2, lowest)
            descent.run(
                lambda x, c=c: np.where(loop, robust.cost("geman-mcclure", x, c), x),  # type: ignore[misc]
                lambda x, c=c: np.where(loop, robust.weight("geman-mcclure", x, c), 1.0),  # type: ignore[misc]
                1e-3,
                2,
            )

    def _settle(self, gate: float) -> tuple[bool, Float64]:
        weights, converged = self._within(gate), False
        for _ in range(_ROUNDS):
            converged = self._with(weights)
            before, weights = weights, self._within(gate)
            if (weights == before).all():
                return converged, weights
        return False, weights

    def _within(self, gate: float) -> Float64:
        return np.where(self.loop & (self.descent.chi2 > gate), 0.0, 1.0)
