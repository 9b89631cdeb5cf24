"""An alignment's steps: from summed normal equations to the next pose, until it settles."""

from __future__ import annotations

import numpy as np

from tofuse.arrays import Float32, Float64
from tofuse.kernels import alignment as sums
from tofuse.kernels.alignment import accumulate, bin_edge, normal_equations
from tofuse.kernels.doubt import faked_information
from tofuse.kernels.jit import kernel
from tofuse.kernels.motion import composed, moved, twist_between

# Points from which it is told how much information can be faked.
SOME_POINTS = 500
# What an alignment guesses, and goes on with: log albedo of the targets minus the source's, scale
# of the sigmas of distances, sigma of the log albedo (0 if it takes no part).
EXPOSURE, SCALE_G, SCALE_P = 0, 1, 2


@kernel
def settle(
    points: Float32,
    targets: tuple[Float32, ...],
    lookups: tuple[Float32, ...],
    lookup_frames: Float64,
    T_targets: Float64,
    T: Float64,
    T_predicted: Float64,
    guessed: Float64,
    most: float,
    iterations: int,
    slack: float,
    photo_slack: float,
    robust: float,
    min_cosine: float,
    judged: bool,
    tilt: float,
    slope: float,
    held: float,
    prior: Float64,
    units: Float64,
    tolerance: float,
) -> tuple[Float64, Float64, Float64, float, int]:
    """Go through the iterations of one level.

    Parameters
    ----------
    points, targets, lookups, lookup_frames
        Of the source and of each target, as `accumulate` takes them; lookup_frames is (n, 4).
    T_targets
        (n, 4, 4) T_target_world of each target.
    T, guessed
        (4, 4) T_world_source and (3,) what is guessed; both are written to.
    T_predicted, prior, units
        As `advance` takes them.
    most
        What the scale of the sigmas may become.
    slack, photo_slack
        Added to the sigmas of distances, m, and of the log albedo.
    robust, min_cosine
        As `accumulate` takes them.
    judged
        Whether directions that the data does not hold stay at the prediction. If not, all move.
    tilt, slope
        As `faked_information` takes them.
    held
        As `weak_directions` takes it.
    tolerance
        The last step is smaller, in `units`, unless there are no more iterations.

    Returns
    -------
    The last sums; (6, 6) information that can be faked; (k, 6) weak directions; the size of the
    last step in `units`; and how many there were. Where the sums are not finite, they are 0, and
    T stays.
    """
    total = np.zeros(sums.SIZE)
    weak = np.zeros((0, 6))
    doubt = np.zeros((6, 6))
    size = np.inf
    done = 0
    while done < iterations and size >= tolerance:
        total[:] = 0.0
        for k in range(len(targets)):
            total += accumulate(
                points,
                targets[k],
                lookups[k],
                lookup_frames[k],
                composed(T_targets[k], T),
                guessed[EXPOSURE],
                guessed[SCALE_G],
                guessed[SCALE_P],
                slack,
                robust,
                min_cosine,
            )
        if judged and done == 0:
            doubt = total[sums.INLIERS] * faked_information(
                points,
                max(1, len(points) // SOME_POINTS),
                guessed[SCALE_G],
                slack,
                guessed[SCALE_P] ** 2,
                tilt,
                slope,
            )
        told = np.isfinite(total.sum() + doubt.sum())
        if told:
            if judged:
                weak = weak_directions(cross_information(total) - doubt, units, held)
            onward, step = advance(total, T, T_predicted, weak, prior, units)
            told = np.isfinite(step.sum())
        if not told:  # planes beyond all bounds, as noise alone can make them: no point fits
            return np.zeros(sums.SIZE), np.zeros((6, 6)), np.eye(6), np.inf, done
        T[:] = onward
        done += 1
        size = 0.0
        for p in range(6):
            size = max(size, abs(step[p] / units[p]))
        if guessed[SCALE_P] > 0:
            guessed[EXPOSURE] += step[6]
        _rescale(total, guessed, most, photo_slack)
    return total, doubt, weak, size, done


@kernel
def _rescale(total: Float64, guessed: Float64, most: float, photo_slack: float) -> None:
    """Take the sigmas from the residuals: the views show only their own noise, not their bias."""
    seen = scale_of_distances(total[sums.HISTOGRAM :])
    if not np.isnan(seen):
        guessed[SCALE_G] = min(max(seen, 0.7), most)
    if guessed[SCALE_P] > 0 and total[sums.WEIGHT_P] > 0:
        variance = total[sums.SQUARES_P] / total[sums.WEIGHT_P] / 0.72
        guessed[SCALE_P] = min(max(np.sqrt(variance + photo_slack**2), 0.005), 0.5)


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
