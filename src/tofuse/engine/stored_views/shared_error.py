"""Correlated depth errors of the pixels of a patch, in the joint refinement of many views.

Multipath, scattering and motion bias whole patches of a range image, differently in each view, so
that a thousand pixels of a wall constrain a pose little better than one. The residuals show the
magnitude: patches of two views disagree by more than pixel noise, increasingly with the change of
the viewpoint. The excess is the variance of a random effect for each patch of each pair (a variance
component, estimated by moments as in restricted maximum likelihood). Without an excess, all pixels
are independent.

Albedo has no such errors, so its relative weight increases with those of the distances.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from tofuse.engine.alignment import projective
from tofuse.engine.arrays import Float32, Float64, Int64
from tofuse.engine.stored_views import pair_equation_kernels as kernels
from tofuse.engine.views import Projection

# Patches in a row, and rows of patches; correlation length of errors (to 1/e) as a fraction of the
# image's width, as in the tracker's covariance.
ACROSS, DOWN = 6, 4
PATCHES = ACROSS * DOWN
_CORRELATION_LENGTH = 0.31
# Minimum weight of a patch, as a fraction of the median.
_MIN_WEIGHT = 0.1
# Smaller changes of the viewpoint, in rad, count as this one.
_MIN_CHANGE = 0.02
# Prior sigma of the pose of a single pair, in units of 1 cm and 1 degree (and 1 of the exposure).
_PRIOR_SIGMA = 1.8
_UNITS = np.append(projective.UNITS, 1.0)
_UPPER = np.triu_indices(kernels.UNKNOWNS)


def patches_of(points: Float32 | Float64, projection: Projection) -> Int64:
    """Return the (N,) patch of each point of a view."""
    rays = points[:, :2] / points[:, 2:3]
    low, high = projection.ray_bounds
    relative = (rays - low) / np.maximum(high - low, 1e-9)
    shape = np.array([ACROSS, DOWN])
    u, v = np.clip((relative * shape).astype(np.int64), 0, shape - 1).T
    return np.asarray(v * ACROSS + u, np.int64)


@cache
def _correlation(aspect: float) -> Float64:
    v, u = np.mgrid[:DOWN, :ACROSS]
    x, y = u.ravel() / ACROSS, v.ravel() * aspect / DOWN
    return np.exp(-np.hypot(x[:, None] - x, y[:, None] - y) / _CORRELATION_LENGTH)


def patch_correlation(shape: tuple[int, int]) -> Float64:
    """Return the (PATCHES, PATCHES) correlation of the errors of patches, of an image (H, W)."""
    rows, columns = shape
    return _correlation(rows / columns)


@dataclass(frozen=True, eq=False)
class Disagreement:
    """Residuals of the patches of pairs, and the parts that noise and shared errors explain.

    Attributes
    ----------
    observed, noise
        (P,) weighted mean squares of the patches' residuals, and their expectation by noise, m^2.
    expected
        (P,) their expectation by shared errors of variance 1.
    """

    observed: Float64
    noise: Float64
    expected: Float64

    def variance(self, growth: Float64) -> float:
        """Return the variance of shared errors at growth 1; pairs have `growth` (P,) times it."""
        explained = float(self.expected @ growth)
        return max(float((self.observed - self.noise).sum()), 0.0) / max(explained, 1e-12)


def disagreement(sums: Float64, rows: Float64, correlation: Float64) -> Disagreement:
    """Compare the residuals of pairs by patch, without the part that their poses would absorb.

    Parameters
    ----------
    sums
        (P, PATCHES, PATCH_SIZE) of `pair_equation_kernels.target_equations`.
    rows
        (P, SIZE) normal equations of the pairs, see `pair_equation_kernels`.
    correlation
        (PATCHES, PATCHES) of the errors.
    """
    count = len(sums)
    weight = sums[..., kernels.PATCH_WEIGHT]
    per_weight = 1 / np.maximum(weight, 1e-12)
    valid = weight > _MIN_WEIGHT * np.median(weight, axis=1, keepdims=True)
    A = np.zeros((count, kernels.UNKNOWNS, kernels.UNKNOWNS))
    A[:, _UPPER[0], _UPPER[1]] = rows[:, kernels.PRODUCTS : kernels.GRADIENT]
    A[:, _UPPER[1], _UPPER[0]] = rows[:, kernels.PRODUCTS : kernels.GRADIENT]
    normal = A[:, :7, :7] * np.outer(_UNITS, _UNITS) + np.eye(7) / _PRIOR_SIGMA**2
    J = np.zeros((count, PATCHES, 7))
    J[..., :6] = sums[..., kernels.PATCH_RESPONSE :]
    J *= _UNITS
    absorbed = per_weight[..., None] * J @ np.linalg.inv(normal) @ np.swapaxes(J, 1, 2)
    projector = (np.eye(PATCHES) - absorbed) * valid[:, :, None] * valid[:, None, :]
    normalised = np.where(valid, weight, 0.0)
    normalised /= np.maximum(normalised.sum(1, keepdims=True), 1e-12)
    means = sums[..., kernels.PATCH_RESIDUAL] * per_weight
    return Disagreement(
        (normalised * means**2).sum(1),
        (normalised * (projector**2 * np.where(valid, per_weight, 0.0)[:, None]).sum(2)).sum(1),
        (normalised * ((projector @ correlation) * projector).sum(2)).sum(1),
    )


def growth(depth: Float64, rotation: Float64, translation: Float64) -> Float64:
    """Return the (P,) growth of the errors' variance with the change of viewpoint of a pair.

    Parameters
    ----------
    depth
        (P,) median depth of the targets, m.
    rotation, translation
        (P,) rotation in rad and translation in m from one view to the other.
    """
    change = np.maximum(rotation + translation / depth, _MIN_CHANGE)
    return np.asarray((depth * change) ** 2, np.float64)
