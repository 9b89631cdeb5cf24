"""Priors of the joint alignment: measurements of the poses that don't come from the views."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tofuse.engine.alignment import projective
from tofuse.engine.arrays import Float64, Intp
from tofuse.engine.geometry import se3
from tofuse.engine.graph import external_sensors, sparse

WEAK = 1e-3  # information of a weak prior in `UNITS`
DAMPING = 1e-6  # fraction of the diagonal that is added to it


@dataclass(frozen=True, eq=False)
class Priors:
    """Measurements of the poses by odometry and gravity.

    Attributes
    ----------
    pairs, measured, information
        (M, 2) positions i, j of views, (M, 4, 4) T_i_j and (M, 6, 6) its information.
    gravity
        Directions of gravity, or None.
    """

    pairs: Intp
    measured: Float64
    information: Float64
    gravity: external_sensors.Gravity | None = None

    @classmethod
    def none(cls) -> Priors:
        """Return no priors."""
        return cls(np.zeros((0, 2), np.intp), np.zeros((0, 4, 4)), np.zeros((0, 6, 6)))

    def system(self, n: int, ends: Intp) -> sparse.PairSystem:
        """Return the sparse system of n poses, pairs `ends` (m, 2) and those of the priors."""
        first = np.arange(n) == 0
        return sparse.PairSystem(n, np.concatenate([ends, self.pairs]), fixed=first)

    def equations(self, T_i_j: Float64) -> tuple[Float64, Float64]:
        """Return the normal equations (M, 6, 6), (M, 6) at relative poses (M, 4, 4)."""
        e = se3.log(se3.inverse(self.measured) @ T_i_j)
        J = se3.jacobian_inverse(e)
        JtW = np.swapaxes(J, 1, 2) @ self.information
        return JtW @ J, (JtW @ e[..., None])[..., 0]


def weak_prior(n: int) -> tuple[Float64, Float64]:
    """Return equations (n, 6, 6), (n, 6) that just keep unconstrained poses in place."""
    return np.tile(np.diag(WEAK / projective.UNITS**2), (n, 1, 1)), np.zeros((n, 6))
