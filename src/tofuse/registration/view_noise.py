"""Noise of range images: stated by the frame or by a law of its kind, and its scale.

`z` is an image (H, W) of depths in m, `w` their reciprocals, and `weight` the inverse variances of
these; all are 0 where unknown.
"""

from __future__ import annotations

import numpy as np

from tofuse.arrays import Bool, Float32
from tofuse.geometry.cameras import ray_lengths
from tofuse.kernels.median import median
from tofuse.kernels.view_planes import fit_planes
from tofuse.normal import MEDIAN_OF_NORMAL
from tofuse.recordings.frames import RangeFrame
from tofuse.registration.projection import Projection

# m. Sigmas beyond are invalid, and their squares exceed the range of float32.
_MIN_SIGMA, _MAX_SIGMA = 1e-6, 1e3
# Number of pixels assumed to share a correlated error: an alignment treats pixels as independent,
# so its variance is multiplied by this.
_CORRELATED_PIXELS = 100.0


def stated_sigma(frame: RangeFrame) -> Float32 | None:
    """Return the sigma of z (H, W) that the frame states, m; 0 where unknown."""
    if frame.sigma_image is None:
        return None
    valid = (frame.sigma_image > _MIN_SIGMA) & (frame.sigma_image < _MAX_SIGMA)
    # The stated noise is that of the radial range.
    sigma = np.where(valid, frame.sigma_image / ray_lengths(frame.camera), np.float32(0))
    return np.asarray(sigma, np.float32)


def noise_law(
    frame: RangeFrame, z: Float32, amplitude: Float32 | None, projection: Projection
) -> Float32:
    """Return the sigma of z (H, W) in m up to a factor, by a law of the sensor family."""
    if amplitude is None or frame.amplitude_kind == "ir":
        return np.float32(0.001) + np.float32(0.003) * z * z
    if frame.amplitude_kind == "raw":
        raw = amplitude
    else:
        r2 = z * z * projection.lengths2
        raw = amplitude * inverse(r2, r2 > 0)
    positive = raw[::2, ::2]
    positive = positive[positive > 0]
    if len(positive) == 0:
        return np.float32(0.001) + np.float32(0.003) * z * z
    typical = np.float32(median(positive))
    # A tiny amplitude stands for none, far below the limit of the law.
    law = np.asarray(typical / np.fmax(raw, np.float32(1e-6) * typical), np.float32)
    return np.float32(0.01) * np.clip(law, np.float32(0.15), np.float32(20))


def typical_noise(w: Float32, weight: Float32) -> float:
    """Return the standard deviation of the difference between neighbours, relative to their depth.

    A robust estimate from the median of second differences along a subset of rows.
    """
    rows = np.s_[::4]
    neighbours = [w[rows, k : w.shape[1] - 2 + k] for k in range(3)]
    valid = np.logical_and.reduce([weight[rows, k : w.shape[1] - 2 + k] > 0 for k in range(3)])
    if not valid.any():
        return 0.0
    before, here, after = (values[valid] for values in neighbours)
    second_difference = np.abs(before - 2 * here + after) / here
    # sqrt(6) in a second difference, sqrt(2) in a first one.
    return median(second_difference) / MEDIAN_OF_NORMAL / np.sqrt(3.0)


def noise_scale(w: Float32, rays: Float32, weight: Float32, radius: int) -> float:
    """Estimate the variance scale: median misfit of the smallest windows on a subset of rows."""
    rows, columns = w.shape
    planes = np.empty((rows, columns, 4), np.float32)
    quality = np.empty((rows, columns, 2), np.float32)
    values = []
    valid = weight > 0
    radii = np.array([radius], np.int64)
    for i in range(radius, rows - radius, max(1, rows // 12)):
        fit_planes(w, rays, weight, valid, radii, np.inf, 0.7, 0.2, planes, quality, i, i + 1)
        values.append(quality[i, :, 0])
    misfit = np.concatenate(values) if values else np.zeros(0)
    misfit = misfit[np.isfinite(misfit)]
    if len(misfit) == 0:
        return 1.0
    return min(max(median(misfit), 1e-6), 1e6)


def scale_at(relative: float, z: Float32, sigma: Float32) -> float:
    """Return the variance scale at which a typical pixel's sigma is `relative` times its depth."""
    z, sigma = z[::4, ::4], sigma[::4, ::4]
    valid = (z > 0) & (sigma > 0)
    if not valid.any():
        return 0.0
    return median(relative * z[valid] / sigma[valid]) ** 2


def shared_sigma(frame: RangeFrame, lengths2: Float32) -> Float32 | None:
    """Return the correlated sigma of z (H, W) in m, given the squared ray lengths (H, W)."""
    image = frame.shared_sigma_image
    if image is None:
        return None
    rows, columns = lengths2.shape
    step = image.shape[1] // columns
    # It varies slowly: one pixel per block is enough.
    sampled = image[step // 2 :: step, step // 2 :: step][:rows, :columns]
    valid = np.isfinite(sampled) & (sampled > 0)
    return np.asarray(np.where(valid, sampled, 0) / np.sqrt(lengths2), np.float32)


def with_shared_error(
    variance: Float32, planes: Float32, shared: Float32 | None
) -> tuple[Float32, Float32 | None]:
    """Return `plane_variance` and `pixel_variance` with the shared sigma of z (H, W) in m added."""
    if shared is None:
        return variance, None
    shared_variance = (shared * planes[..., 3] ** 2) ** 2
    return variance + np.float32(_CORRELATED_PIXELS) * shared_variance, variance + shared_variance


def inverse(values: Float32, valid: Bool) -> Float32:
    """Return the reciprocal of each value, 0 where invalid."""
    return np.reciprocal(np.where(valid, values, np.float32(np.inf)))
