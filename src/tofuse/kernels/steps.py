"""One step of an alignment: from summed normal equations to the next pose."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tofuse.kernels import alignment as sums
from tofuse.kernels.alignment import bin_edge, normal_equations
from tofuse.kernels.jit import kernel
from tofuse.kernels.motion import moved, twist_between

Float64 = NDArray[np.float64]


@kernel
def _without_exposure(A: Float64) -> Float64:
    """Marginalise the seventh unknown: (6, 6)."""
    out = np.empty((6, 6))
    for p in range(6):
        for o in range(6):
            taken = A[p, 6] * A[6, o] / A[6, 6] if A[6, 6] > 0 else 0.0
            out[p, o] = A[p, o] - taken
    return out


@kernel
def information(total: Float64) -> Float64:
    """(6, 6) of the pose, from what `accumulate` summed."""
    return _without_exposure(normal_equations(total)[0])


@kernel
def cross_information(total: Float64) -> Float64:
    """(6, 6) symmetrised product of the Jacobians of target and source, over the pose."""
    return _without_exposure(normal_equations(total)[2])


@kernel
def weak_directions(cross: Float64, units: Float64, held: float) -> Float64:
    """(k, 6) unit directions, in `units`, whose sigma is above `held`."""
    scaled = np.empty((6, 6))
    for p in range(6):
        for o in range(6):
            scaled[p, o] = cross[p, o] * units[p] * units[o]
    values, vectors = np.linalg.eigh(scaled)
    count = 0
    while count < 6 and values[count] < 1 / (held * held):
        count += 1
    out = np.empty((count, 6))
    for k in range(count):
        for p in range(6):
            out[k, p] = vectors[p, k]
    return out


@kernel
def advance(
    total: Float64,
    T: Float64,
    T_predicted: Float64,
    weak: Float64,
    prior: Float64,
    units: Float64,
) -> tuple[Float64, Float64]:
    """Solve for a step, and go it.

    Parameters
    ----------
    total
        From `accumulate`.
    T, T_predicted
        (4, 4) of the source: now, and where it was expected.
    weak
        (k, 6) unit directions, in `units`, that stay at the prediction.
    prior
        (6,) sigma of the prediction.
    units
        (6,) in which directions are compared.

    Returns
    -------
    The next (4, 4), and the step (7,), whose last number is that of the exposure.
    """
    A, g, _ = normal_equations(total)
    away = twist_between(T_predicted, T)
    for p in range(6):
        away[p] /= units[p]
        g[p] *= units[p]
        for o in range(7):
            A[p, o] *= units[p]
            A[o, p] *= units[p]
    for p in range(6):
        weight = (units[p] / prior[p]) ** 2
        A[p, p] += weight
        g[p] += weight * away[p]
    if weak.shape[0]:
        # What the data does not hold is held at the prediction, far more firmly than noise can.
        trace = 0.0
        for p in range(6):
            trace += A[p, p]
        firm = 1e3 * max(trace, 1.0)
        for k in range(weak.shape[0]):
            along = 0.0
            for p in range(6):
                along += weak[k, p] * away[p]
            for p in range(6):
                g[p] += firm * along * weak[k, p]
                for o in range(6):
                    A[p, o] += firm * weak[k, p] * weak[k, o]
    _solve(A, g)
    for p in range(7):
        g[p] *= -units[p] if p < 6 else -1.0
    return moved(T, g), g


@kernel
def _solve(A: Float64, b: Float64) -> None:
    """Solve A x = b in place, A symmetric and positive definite, by Cholesky's decomposition."""
    n = len(b)
    for p in range(n):
        for o in range(p + 1):
            total = A[p, o]
            for k in range(o):
                total -= A[p, k] * A[o, k]
            A[p, o] = total / A[o, o] if o < p else np.sqrt(total)
        for k in range(p):
            b[p] -= A[p, k] * b[k]
        b[p] /= A[p, p]
    for p in range(n - 1, -1, -1):
        for k in range(p + 1, n):
            b[p] -= A[k, p] * b[k]
        b[p] /= A[p, p]


@kernel
def scale_of_distances(histogram: Float64) -> float:
    """Sigma of all compared points' distances, in the sigmas they claim; NaN if there are none.

    Of all that was compared, not of what fitted: a scale from inliers would confirm itself. From
    the median, as 1.48 times it is the sigma of normal deviates.
    """
    count = 0.0
    for k in range(sums.BINS):
        count += histogram[k]
    below = 0.0
    for k in range(sums.BINS):
        here = histogram[k]
        if here > 0 and 2 * (below + here) >= count:
            low, high = bin_edge(k), bin_edge(k + 1)
            return 1.48 * np.sqrt(low + (high - low) * (0.5 * count - below) / here)
        below += here
    return np.nan
