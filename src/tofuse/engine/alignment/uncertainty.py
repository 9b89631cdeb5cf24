"""Covariance of an alignment, with the prior along degenerate directions.

The estimate solves g(T) = sum w J r = 0. To first order its error is ``X^-1 g``, g taken at the
true pose, and its covariance ``X^-1 B X^-1`` with X the derivative of g and B its covariance (the
"sandwich" of M-estimation; Huber 1981, ch. 6). Neither is the plain information matrix:

- noise in normals and albedo gradients enters J J^T twice and causes spurious information. In X,
  the symmetrised product of the target's and the source's Jacobian, it cancels. The robust weights
  enter X with the derivative of the influence function, not with the weights themselves;
- B is not the pixels' noise alone. Smoothing correlates the noise of neighbours; multipath,
  scattering and motion distort whole patches of the range image. Differences between patches
  appear in the residuals, less the part absorbed by the fit; errors common to all patches are
  fully absorbed and invisible in the residuals. They are modelled as proportional to the change
  of the view: a constant bias of the camera causes no pose error from the same viewpoint.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from tofuse.engine.alignment import tile_sum_kernels as kernels
from tofuse.engine.alignment.projective import (
    MIN_COSINE,
    ROBUST,
    UNITS,
    Aligned,
    ProjectiveOptions,
    Target,
)
from tofuse.engine.arrays import Float64
from tofuse.engine.compute import median
from tofuse.engine.geometry import distance_and_angle
from tofuse.engine.views import PreparedView, residual_kernels

_UPPER7 = np.triu_indices(7)
# Everything here is in units of 1 cm and 1 degree, so that eigenvalues can be compared.
_SCALE = np.append(UNITS, 1.0)
_SCALES = np.outer(_SCALE, _SCALE)
# Minimum number of compared pixels per tile, and of tiles.
_MIN_PIXELS = 10
_MIN_TILES = 6
# Minimum sigma, in units of 1 cm and 1 degree: keeps the covariance of a still camera invertible.
_MIN_SIGMA = 1e-3
# Information of an unconstrained direction, as a fraction of that of the weak prior.
_MIN_INFORMATION = 1e-3
# Approximate number of pixels used: the noise of denser ones is correlated.
_SAMPLED_PIXELS = 6336
# Numbers of columns and of rows of patches.
_TILES = (8, 6)
# Number of pixels with fully correlated noise after smoothing, of distances and of albedo.
_NOISE_PIXELS, _PHOTO_NOISE_PIXELS = 5.0, 4.0
# Correlation length (1/e) of the errors of patches, as a fraction of the image's width.
_REACH = 0.31
# Largest sigma from the data alone, in units of 1 cm and 1 degree.
_MAX_SIGMA = 1.8
# Lower limit of X, as a fraction of the weighted information.
_STEEPNESS = 0.3


@dataclass(frozen=True)
class UncertaintyOptions:
    """Systematic errors of views; docs/uncertainty.md describes their calibration.

    Attributes
    ----------
    hidden
        Correlated error of patches that is invisible in the residuals: fraction of the depth per
        radian of change of the view.
    offset
        Component of it common to all patches, relative to the rest.
    floor
        Minimum error of the pose, as a fraction of the change of the view.
    """

    hidden: float = 0.0025
    offset: float = 3.0
    floor: float = 0.008


@dataclass(frozen=True, eq=False)
class Patches:
    """Sums over the patches of a view at the final pose, in units of 1 cm and 1 degree.

    Attributes
    ----------
    geometry, photo
        (7, 7) sums of w J J^T; the seventh unknown is the exposure.
    weighted, cross
        (7, 7) sums of w times the symmetrised product of target's and source's Jacobian; and X, the
        derivative of the gradient, which has the derivative of the influence function for w.
    positions
        (n, 2) column and row of the patches with distances, as fractions of the image's width.
    weights
        (n,) sums of w, 1/m^2.
    means
        (n,) weighted mean distances, m.
    responses
        (n, 7) sums of w J: the response of the gradient to an error common to the patch.
    change
        Change of the view: angle in rad plus distance relative to the depth.
    depth
        Median depth, m.
    stride
        Spacing of the pixels used, along either axis.
    """

    geometry: Float64
    photo: Float64
    weighted: Float64
    cross: Float64
    positions: Float64
    weights: Float64
    means: Float64
    responses: Float64
    change: float
    depth: float
    stride: int


def patches(
    source: PreparedView, targets: Sequence[Target], aligned: Aligned, alignment: ProjectiveOptions
) -> Patches:
    """Return the sums over the patches of an aligned view.

    Parameters
    ----------
    source, targets, alignment
        As given to `align`, which returned `aligned`.
    """
    rows, columns = source.z.shape
    stride = max(1, round(float(np.sqrt(rows * columns / _SAMPLED_PIXELS))))
    tile_columns, tile_rows = _TILES
    photometric = (
        alignment.photometric and source.has_albedo and all(t.view.has_albedo for t in targets)
    )
    inverse_depths = source.planes[stride // 2 :: stride, stride // 2 :: stride, 3]
    inverse_depths = inverse_depths[inverse_depths > 0]
    depth = 1 / median(inverse_depths) if len(inverse_depths) else 1.0
    residuals = residual_kernels.Residuals(
        aligned.exposure,
        aligned.scale,
        aligned.photo_scale if photometric else 0.0,
        0.0,
        ROBUST,
        MIN_COSINE,
    )
    sums_per_target = []
    upper = np.zeros((kernels.KINDS, kernels.UPPER))
    changes = []
    for target in targets:
        view = target.view
        T = np.ascontiguousarray(target.T_target_world @ aligned.T_world_source)
        translation, rotation = distance_and_angle(np.eye(4), T)
        changes.append(rotation + translation / depth)
        of_tiles, of_image = kernels.tile_sums(
            source.images, view.target_image, T, residuals, stride, tile_columns, tile_rows
        )
        sums_per_target.append(of_tiles)
        upper += of_image
    tile_sums = np.concatenate(sums_per_target)
    valid = tile_sums[:, kernels.COUNT] >= _MIN_PIXELS
    positions = np.tile(_positions(rows, columns, tile_columns, tile_rows), (len(targets), 1))[
        valid
    ]
    tile_sums = tile_sums[valid]
    weights = tile_sums[:, kernels.WEIGHT]
    return Patches(
        _matrix(upper[kernels.GEOMETRIC]),
        _matrix(upper[kernels.PHOTOMETRIC]),
        _matrix(upper[kernels.WEIGHTED]),
        _matrix(upper[kernels.CROSS]),
        positions,
        weights,
        tile_sums[:, kernels.RESIDUAL] / weights,
        tile_sums[:, kernels.RESPONSE : kernels.RESPONSE + 7] * _SCALE,
        sum(changes) / len(changes),
        depth,
        stride,
    )


@cache
def _positions(rows: int, columns: int, tile_columns: int, tile_rows: int) -> Float64:
    """Return column and row (down * across, 2) of the tiles, as fractions of the image's width."""
    v, u = np.mgrid[:tile_rows, :tile_columns]
    return np.stack([u / tile_columns, v * rows / (tile_rows * columns)], -1).reshape(-1, 2)


def covariance_of_patches(sums: Patches, options: UncertaintyOptions) -> Float64:
    """Return the covariance (6, 6) of the right perturbation in m and rad, without a prior."""
    hessian, prior = _with_weak_prior(_hessian(sums))
    bread = np.asarray(np.linalg.inv(hessian), np.float64)
    per_pixel = sums.stride**2
    B = max(1.0, _NOISE_PIXELS / per_pixel) * sums.geometry + prior
    B += max(1.0, _PHOTO_NOISE_PIXELS / per_pixel) * sums.photo
    if len(sums.weights) >= _MIN_TILES:
        x, y = sums.positions.T
        distance = np.hypot(x[:, None] - x, y[:, None] - y)
        correlation = np.exp(-distance / _REACH)
        observed = _observed_variance(sums, bread, correlation)
        hidden = (options.hidden * sums.depth * sums.change) ** 2
        hidden_correlation = np.exp(-0.5 * distance / _REACH) + options.offset**2
        B += (
            sums.responses.T
            @ (observed * correlation + hidden * hidden_correlation)
            @ sums.responses
        )
    C = (bread @ B @ bread)[:6, :6]
    floor = options.floor * sums.change * np.array([sums.depth] * 3 + [1.0] * 3) / UNITS
    C += np.diag(np.maximum(floor, _MIN_SIGMA) ** 2)
    return 0.5 * (C + C.T) * np.outer(UNITS, UNITS)


def covariance(
    source: PreparedView,
    targets: Sequence[Target],
    aligned: Aligned,
    alignment: ProjectiveOptions,
    options: UncertaintyOptions | None = None,
) -> Float64:
    """Return the covariance (6, 6) of an alignment: m and rad, right perturbation, source's frame.

    Degenerate directions have the covariance of the prediction, which also bounds the others.

    Parameters
    ----------
    source, targets, alignment
        As given to `align`, which returned `aligned`.
    options
        Systematic errors of the views; those of one camera unless given.
    """
    sums = patches(source, targets, aligned, alignment)
    C = covariance_of_patches(sums, options or UncertaintyOptions())
    prior = np.array([alignment.prior_m] * 3 + [alignment.prior_rad] * 3)
    return with_prior(bounded_by_prior(C, prior), aligned.unobservable, prior)


def with_prior(C: Float64, unobservable: Float64, prior: Float64) -> Float64:
    """Set the covariance of unobservable directions to that of the prediction.

    Parameters
    ----------
    C
        (6, 6) covariance, m and rad.
    unobservable
        (k, 6) orthonormal directions in units of 1 cm and 1 degree.
    prior
        (6,) sigma of the prediction, m and rad.
    """
    if not len(unobservable):
        return C
    scaled = C / np.outer(UNITS, UNITS)
    projector = unobservable.T @ unobservable
    complement = np.eye(6) - projector
    scaled = (
        complement @ scaled @ complement + projector @ np.diag((prior / UNITS) ** 2) @ projector
    )
    return 0.5 * (scaled + scaled.T) * np.outer(UNITS, UNITS)


def bounded_by_prior(C: Float64, prior: Float64) -> Float64:
    """Bound the covariance C (6, 6) by that of the prediction, sigma `prior` (6,).

    X^-1 B X^-1 is unbounded along directions in which the robust loss has no minimum.
    """
    values, vectors = np.linalg.eigh(C / np.outer(prior, prior))
    if values[-1] <= 1:
        return C
    bounded: Float64 = ((vectors * np.minimum(values, 1.0)) @ vectors.T) * np.outer(prior, prior)
    return 0.5 * (bounded + bounded.T)


def _observed_variance(sums: Patches, bread: Float64, correlation: Float64) -> float:
    """Estimate the variance in m^2 of the correlated errors of patches from the residuals.

    Method of moments, corrected for the degrees of freedom of the fit: residuals are (1 - P) times
    the errors, P the projection of the fit (as in restricted maximum likelihood).
    """
    n = len(sums.weights)
    M = np.eye(n) - (sums.responses / sums.weights[:, None]) @ bread @ sums.responses.T
    weights = sums.weights / sums.weights.sum()
    weights = np.minimum(weights, 4 * median(weights))
    expected = float(weights @ ((M @ correlation) * M).sum(1))
    noise = float(weights @ ((M / sums.weights) * M).sum(1))
    surplus = float(weights @ sums.means**2) - noise
    return max(surplus, 0.0) / max(expected, 0.1 * float(weights.sum()))


def _hessian(sums: Patches) -> Float64:
    """Return X (7, 7), bounded below by `_STEEPNESS` times its value without robust weights.

    For normal errors the ratio is two thirds. With many residuals near the limit of the loss, X is
    a difference of large numbers and may even be negative.
    """
    min_eigenvalue = _MIN_INFORMATION * _MAX_SIGMA**-2
    return bounded_below(sums.cross, sums.weighted, _STEEPNESS, min_eigenvalue)


def bounded_below(
    X: Float64, reference: Float64, fraction: float, min_eigenvalue: float
) -> Float64:
    """Return the symmetric matrix `X` with no direction below a fraction of `reference`.

    Eigenvalues of `reference` are at least `min_eigenvalue`.
    """
    values, vectors = np.linalg.eigh(reference)
    root = vectors / np.sqrt(np.maximum(values, min_eigenvalue))
    values, directions = np.linalg.eigh(root.T @ X @ root)
    basis = np.linalg.inv(root).T @ directions
    return np.asarray((basis * np.maximum(values, fraction)) @ basis.T, np.float64)


def _with_weak_prior(X: Float64) -> tuple[Float64, Float64]:
    """Raise the eigenvalues of X (7, 7) to ``_MAX_SIGMA**-2``; return it, and the prior's B (7, 7).

    The information added to X is that of a prior, which counts in B as well: without it, the
    variance ``B / X**2`` would decrease the less a direction is constrained.
    """
    X = X.copy()
    if X[6, 6] <= 0:
        X[6, :] = X[:, 6] = 0.0
        X[6, 6] = 1.0
    values, vectors = np.linalg.eigh(X)
    missing = np.maximum(_MAX_SIGMA**-2 - values, 0.0)
    raised: Float64 = X + (vectors * missing) @ vectors.T
    prior: Float64 = (vectors * np.minimum(missing, _MAX_SIGMA**-2)) @ vectors.T
    return raised, prior


def _matrix(upper: Float64) -> Float64:
    out = np.zeros((7, 7))
    out[_UPPER7] = upper
    out.T[_UPPER7] = upper
    return out * _SCALES
