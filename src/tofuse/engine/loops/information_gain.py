"""How much a loop would reduce the uncertainty of the trajectory.

Loops are chosen by mutual information with the poses, as by Ila, Porta and Andrade-Cetto
("Information-based compact pose SLAM", 2010), one after the other, each given those before. For
that a scalar model of the positions is sufficient: by odometry they are a random walk, in which the
covariance of two positions is the variance of the earlier one, and a loop measures the difference
of two positions.
"""

from __future__ import annotations

import numpy as np

from tofuse.engine.arrays import Float64, Intp

# Approximate accuracy of a loop, m.
_LOOP_SIGMA_M = 0.02
# Maximum number of distinct positions: successive views share one if there are more.
_MAX_POSITIONS = 1000


class InformationGain:
    """Covariance of the positions of views, given the loops between them.

    Parameters
    ----------
    variance
        (N,) of the positions of views by odometry, m^2, in the order of time.
    loop_variance
        That of a loop, in the same unit.
    """

    def __init__(self, variance: Float64, loop_variance: float = _LOOP_SIGMA_M**2) -> None:
        self._loop_variance = loop_variance
        n = len(variance)
        m = min(n, _MAX_POSITIONS)
        self._of_view = np.arange(n) * m // max(n, 1)
        first_view = np.searchsorted(self._of_view, np.arange(m))
        monotonic = np.maximum.accumulate(variance[first_view])
        self._C = np.minimum.outer(monotonic, monotonic)

    def of(self, i: Intp | int, j: Intp | int) -> Float64:
        """Return the gain of loops between views i and j, in bits per direction.

        It is rounded, as the model is not more accurate: loops with equal gains are to be chosen by
        other criteria.
        """
        a, b, C = self._of_view[i], self._of_view[j], self._C
        relative = np.maximum(C[a, a] + C[b, b] - 2 * C[a, b], 0)
        return np.asarray(np.round(0.5 * np.log2(1 + relative / self._loop_variance)), np.float64)

    def add(self, i: int, j: int) -> None:
        """Condition the covariance on a loop between views i and j."""
        a, b = self._of_view[[i, j]]
        u = self._C[:, a] - self._C[:, b]
        self._C -= np.outer(u, u / (u[a] - u[b] + self._loop_variance))
