"""Calibration of a camera's systematic range errors from views of planes.

On a plane a pixel p measures ``r = t + c(r) + o_p`` with the true range t, a curve c shared by all
pixels, and an offset o_p of the pixel (Lindner and Kolb 2006, with known poses of the planes).
Curve, offsets and all planes are estimated jointly, by Gauss-Newton on robust least squares; the
offsets are eliminated pixel by pixel. Without any known pose, a curve proportional to the range is
equivalent to more distant planes: the scale is unobservable, and is fixed by a weak prior.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
from scipy.linalg import block_diag
from scipy.sparse import csr_array, diags_array

from tofuse.apps.calibration.plane_views import PlaneView
from tofuse.engine.arrays import Float64, Intp
from tofuse.engine.cameras import Camera
from tofuse.engine.errors import InputError
from tofuse.engine.normal import robust_sigma
from tofuse.engine.sensor import DepthCorrection

_KNOT_SPACING_M = 0.04
_MAX_KNOTS = 200
_CURVE_PIXELS = 6000  # used for the curve; offsets are estimated from all pixels
_ROUNDS = 8
_HUBER = 2.0  # standard deviations
# Prior standard deviations in m: of the curve, its second differences and the offsets; and of the
# curve's mean and slope without any known pose.
_CURVE_M, _BEND_M, _OFFSET_M = 0.1, 0.004, 0.02
# While planes are estimated with known board poses, pixel offsets are nearly free: otherwise the
# priors of thousands of pixels would outweigh the poses.
_ANY_OFFSET_M, _MEAN_OFFSET_M = 1.0, 1e-4
_MEAN_M, _SLOPE = 0.002, 0.001
_FIXED_M = 1e-7  # prior of curve and offsets that are fixed to 0
_FLOOR_M = 0.001  # lower limit of the noise
_MIN_SPREAD_M = 0.3
# A ToF camera's scale is that of its clock, so that it hardly errs by more than this fraction. A
# curve with a larger slope and a constant below this fraction of its values is due to the board.
_MAX_SCALE_ERROR, _MAX_CONSTANT = 0.01, 1 / 3
_MAX_SHAPE_M = 0.004  # standard deviation of the curve without mean and slope
_BLUR_WIDTH = 1 / 50  # width of the blur, relative to the image's width


@dataclass(frozen=True)
class DepthFit:
    """A depth correction and its uncertainty.

    Attributes
    ----------
    correction
        Range error to subtract.
    frames, planes
        Numbers of frames that were used, and of planes in them.
    range_m
        Smallest and largest observed range; the curve is constant beyond.
    before_m, after_m
        Robust rms distance of single pixels from the planes, noise included.
    bias_before_m, bias_after_m
        The same for averages over patches of pixels, which suppress noise.
    constant_sigma_m, scale_sigma
        Standard deviations of the curve's mean in m, and of its slope relative to the range; those
        of the priors without any known pose.
    warnings
        For the user, one line each.
    """

    correction: DepthCorrection = field(repr=False)
    frames: int
    planes: int
    range_m: tuple[float, float]
    before_m: float
    after_m: float
    bias_before_m: float
    bias_after_m: float
    constant_sigma_m: float
    scale_sigma: float
    warnings: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        offsets = self.correction.pixel_bias_m
        return {
            "frames": self.frames,
            "planes": self.planes,
            "range_m": list(self.range_m),
            "rms_m": {"before": self.before_m, "after": self.after_m},
            "bias_rms_m": {"before": self.bias_before_m, "after": self.bias_after_m},
            "constant_sigma_m": self.constant_sigma_m,
            "scale_sigma": self.scale_sigma,
            "curve": {
                "range_m": self.correction.range_m.tolist(),
                "bias_m": self.correction.bias_m.tolist(),
            },
            "pixel_offset_rms_m": 0.0 if offsets is None else float(np.sqrt((offsets**2).mean())),
            "warnings": list(self.warnings),
        }


def calibrate_depth(views: Sequence[PlaneView], camera: Camera, where: str = "") -> DepthFit:
    """Estimate curve and offsets from planes.

    Parameters
    ----------
    views
        From `board_planes` or `scene_planes`.
    camera
        Of the views.
    where
        Name of the recording in error messages.

    Raises
    ------
    InputError
        If the planes' ranges vary too little, or the curve is too uncertain.
    """
    ranges = np.concatenate([view.measured_m for view in views])
    low, high = (float(v) for v in np.quantile(ranges, [0.005, 0.995]))
    if high - low < _MIN_SPREAD_M:
        raise InputError(
            f"shows planes from {low:.2f} to {high:.2f} m only",
            where=where,
            remedy="record a wall from several distances, over the range that is to be corrected",
        )
    count = int(np.clip(np.ceil((high - low) / _KNOT_SPACING_M), 4, _MAX_KNOTS)) + 1
    knots = np.linspace(low, high, count)
    shape = camera.height, camera.width
    subsampled = [_subsampled(view, shape) for view in views]
    state = _solve(subsampled, knots)
    constant, scale, shape_sigma = _sigmas(state, knots, ranges)
    if not shape_sigma < _MAX_SHAPE_M:
        raise InputError(
            f"shows {len(views)} planes, which determine the curve only to "
            f"{1000 * shape_sigma:.0f} mm",
            where=where,
            remedy="record a wall from 20 places or more, at all distances, tilted to all sides",
        )
    residuals = _residuals(views, knots, state)
    offsets = _pixel_offsets(views, residuals, shape)
    # The mean of the offsets is part of the curve.
    observed = np.unique(np.concatenate([view.pixels for view in views]))
    mean = float(offsets.ravel()[observed].mean())
    offsets -= mean
    curve = state.curve + mean
    after = [r - offsets.ravel()[v.pixels] - mean for r, v in zip(residuals, views, strict=True)]
    before = _residuals(views, knots, _solve(subsampled, knots, fixed=True))
    return DepthFit(
        DepthCorrection(knots, curve, offsets.astype(np.float32)),
        len({view.frame for view in views}),
        len(views),
        (low, high),
        robust_sigma(np.concatenate(before)),
        robust_sigma(np.concatenate(after)),
        _patch_rms(views, before, shape),
        _patch_rms(views, after, shape),
        constant,
        scale,
        (
            *_warnings(views, len(observed) / (shape[0] * shape[1])),
            *_size_warnings(knots, curve),
        ),
    )


def compose(first: DepthCorrection, second: DepthCorrection) -> DepthCorrection:
    """Return the composition of two corrections, the second applied after the first.

    The first one's offsets change the range at which the second is evaluated by millimetres, which
    is neglected.
    """
    ends = [second.range_m[0], second.range_m[-1]]
    before_first = second.range_m + np.interp(second.range_m, first.range_m, first.bias_m)
    knots = np.unique(np.concatenate([first.range_m, before_first, ends]))
    bias = np.interp(knots, first.range_m, first.bias_m)
    bias = bias + np.interp(knots - bias, second.range_m, second.bias_m)
    a, b = first.pixel_bias_m, second.pixel_bias_m
    pixel = b if a is None else a if b is None else a + b
    return DepthCorrection(knots, bias, pixel)


@dataclass(frozen=True, eq=False)
class _State:
    """Curve (K,) in m, planes (V, 3), and the covariance (K, K) of the curve."""

    curve: Float64
    planes: Float64
    covariance: Float64


def _subsampled(view: PlaneView, shape: tuple[int, int]) -> PlaneView:
    """Return the view on every n-th row and column, the same in all views."""
    step = max(1, round(float(np.sqrt(shape[0] * shape[1] / _CURVE_PIXELS))))
    row, column = np.divmod(view.pixels, shape[1])
    keep = (row % step == step // 2) & (column % step == step // 2)
    names = ("pixels", "measured_m", "sigma_m", "directions")
    return replace(view, **{name: getattr(view, name)[keep] for name in names})


def _solve(views: Sequence[PlaneView], knots: Float64, *, fixed: bool = False) -> _State:
    """Run Gauss-Newton over planes and curve; a `fixed` curve and the offsets stay 0."""
    knot_count = len(knots)
    measured = np.concatenate([view.measured_m for view in views])
    sigma = np.hypot(np.concatenate([view.sigma_m for view in views]), _FLOOR_M)
    directions = np.concatenate([view.directions for view in views])
    view_of = np.repeat(np.arange(len(views)), [len(view.pixels) for view in views])
    pixels, pixel = np.unique(np.concatenate([view.pixels for view in views]), return_inverse=True)
    start = np.stack([view.plane for view in views])
    planes, curve, offsets = start.copy(), np.zeros(knot_count), np.zeros(len(pixels))
    has_pose = _has_known_pose(views)
    prior, offset_sigma = _prior(knots, has_pose=has_pose), _ANY_OFFSET_M if has_pose else _OFFSET_M
    if fixed:
        prior, offset_sigma = _FIXED_M**-2 * np.eye(knot_count), _FIXED_M
    size, n = knot_count + 3 * len(views), len(measured)
    information = block_diag(prior, *(view.information for view in views))
    for _ in range(_ROUNDS):
        true = 1 / np.einsum("nc,nc->n", planes[view_of], directions)
        expected = _measured_of_true(true, knots, curve)
        knot, fraction = _interval(expected, knots)
        bias = curve[knot] * (1 - fraction) + curve[knot + 1] * fraction
        residual = measured - true - bias - offsets[pixel]
        scale = max(robust_sigma(residual / sigma), 0.1)
        weight = 1 / (sigma * scale) ** 2
        weight *= np.minimum(1, _HUBER * scale * sigma / np.maximum(np.abs(residual), 1e-12))
        # The curve says nothing of what is beyond it, which would bend planes and curve.
        weight *= (expected >= knots[0]) & (expected <= knots[-1])
        # Columns: two knots, three parameters of the plane. d(true) = -true^2 ray . d(plane).
        slope = -(true**2)[:, None] * directions
        columns = np.stack([knot, knot + 1, *(knot_count + 3 * view_of + a for a in range(3))], 1)
        values = np.concatenate([np.stack([1 - fraction, fraction], 1), slope], 1)
        A = csr_array((values.ravel(), columns.ravel(), np.arange(0, 5 * n + 1, 5)), (n, size))
        AtW = (diags_array(weight) @ A).T.tocsr()
        # The offsets are eliminated, and solved for afterwards.
        target = residual + offsets[pixel]
        by_pixel = csr_array((weight, (pixel, np.arange(n))), (len(pixels), n))
        total = by_pixel.sum(1) + 1 / offset_sigma**2
        coupled = by_pixel @ A
        own_offsets = (by_pixel @ target) / total
        normal = (AtW @ A - coupled.T @ (diags_array(1 / total) @ coupled)).toarray() + information
        rhs = AtW @ target - coupled.T @ own_offsets
        rhs -= information @ np.concatenate([curve, (planes - start).ravel()])
        # The mean of the offsets is part of the curve and fixed to 0 (Sherman-Morrison).
        mean_weight = 1 / ((len(total) * _MEAN_OFFSET_M) ** 2 + (1 / total).sum())
        coupled_mean = coupled.T @ (1 / total)
        normal += mean_weight * np.outer(coupled_mean, coupled_mean)
        rhs += mean_weight * coupled_mean * own_offsets.sum()
        # Scale the columns, as those of planes and curve have different units.
        unit = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-12))
        scaled = normal * unit[:, None] * unit + 1e-10 * np.eye(size)
        step = unit * np.linalg.solve(scaled, unit * rhs)
        curve = curve + step[:knot_count]
        planes = planes + step[knot_count:].reshape(-1, 3)
        own_offsets = (by_pixel @ (target - A @ step)) / total
        offsets = own_offsets - mean_weight * own_offsets.sum() / total
    covariance = np.linalg.inv(scaled) * unit[:, None] * unit
    return _State(curve, planes, covariance[:knot_count, :knot_count])


def _sigmas(state: _State, knots: Float64, ranges: Float64) -> tuple[float, float, float]:
    """Return the sigmas of the curve's mean and slope, and of its shape, over observed ranges."""
    counts: Float64 = np.full(len(knots), 1e-9)
    counts += np.bincount(_interval(ranges, knots)[0], minlength=len(knots))
    basis = np.stack([np.ones_like(knots), knots - knots.mean()], 1)
    shape = np.eye(len(knots)) - basis @ _mean_and_slope_projector(knots, np.ones(len(knots)))
    (constant, slope), shapes = (
        np.diag(P @ state.covariance @ P.T).clip(0)
        for P in (_mean_and_slope_projector(knots, counts), shape)
    )
    return constant**0.5, slope**0.5, float(np.average(shapes, weights=counts)) ** 0.5


def _mean_and_slope_projector(knots: Float64, weights: Float64) -> Float64:
    """Return the matrix (2, K) that fits mean and slope to a curve by weighted least squares."""
    base = np.stack([np.ones_like(knots), knots - np.average(knots, weights=weights)], 1)
    return np.asarray(np.linalg.solve((base.T * weights) @ base, base.T * weights))


def _measured_of_true(true: Float64, knots: Float64, curve: Float64) -> Float64:
    """Return the noise-free measurements (N,) of true ranges (N,), at which the curve is evaluated.

    Evaluated at the noisy measurements, noise would bias the slope of the curve.
    """
    return np.asarray(true + np.interp(true + np.interp(true, knots, curve), knots, curve))


def _interval(measured: Float64, knots: Float64) -> tuple[Intp, Float64]:
    """Return the knot before each range (N,), and the range's fraction of the knot interval."""
    position = (measured - knots[0]) / (knots[1] - knots[0])
    knot = np.clip(np.floor(position), 0, len(knots) - 2).astype(np.intp)
    return knot, np.clip(position - knot, 0, 1)


def _has_known_pose(views: Sequence[PlaneView]) -> bool:
    """Whether the pose of any plane is known."""
    return any(float(np.trace(view.information)) > 1 for view in views)


def _prior(knots: Float64, *, has_pose: bool) -> Float64:
    """Return the prior information (K, K) of a curve: small, smooth, and level without a pose."""
    knot_count = len(knots)
    second_difference = np.diff(np.eye(knot_count), 2, axis=0)
    information = (
        np.eye(knot_count) / (_CURVE_M**2 * knot_count)
        + second_difference.T @ second_difference / _BEND_M**2
    )
    if not has_pose:
        mean_and_slope = _mean_and_slope_projector(knots, np.ones(knot_count)) / np.array(
            [[_MEAN_M], [_SLOPE]]
        )
        information += mean_and_slope.T @ mean_and_slope
    return np.asarray(information)


def _residuals(views: Sequence[PlaneView], knots: Float64, state: _State) -> list[Float64]:
    """Return the range residuals of each view's pixels, without their offsets."""
    out = []
    for view, plane in zip(views, state.planes, strict=True):
        true = 1 / (view.directions @ plane)
        bias = np.interp(_measured_of_true(true, knots, state.curve), knots, state.curve)
        out.append(view.measured_m - true - bias)
    return out


def _pixel_offsets(
    views: Sequence[PlaneView], residuals: Sequence[Float64], shape: tuple[int, int]
) -> Float64:
    """Estimate the offsets (H, W): a smooth part over the image, and a shrunken part per pixel.

    The shrinkage follows from the variance between pixels in excess of their noise (empirical
    Bayes).
    """
    size = shape[0] * shape[1]
    sums, weights = np.zeros(size), np.zeros(size)
    joined = np.concatenate(residuals)
    sigma = np.hypot(np.concatenate([view.sigma_m for view in views]), _FLOOR_M)
    scale = max(robust_sigma(joined / sigma), 0.1)
    for view, residual in zip(views, residuals, strict=True):
        sigmas = np.hypot(view.sigma_m, _FLOOR_M) * scale
        # The residual contains the offset, so the outlier threshold is large.
        max_residual = 3 * _OFFSET_M + 3 * sigmas
        weight = np.where(np.abs(residual) < max_residual, 1 / sigmas**2, 0)
        np.add.at(sums, view.pixels, weight * residual)
        np.add.at(weights, view.pixels, weight)
    sums, weights = sums.reshape(shape), weights.reshape(shape)
    mean = np.divide(sums, weights, out=np.zeros(shape), where=weights > 0)
    smooth = _blur_and_fill(sums, weights, max(2.0, _BLUR_WIDTH * shape[1]))
    observed = weights > 0
    deviation = (mean - smooth)[observed]
    limit = 3 * max(robust_sigma(deviation), 1e-6)
    inliers = np.abs(deviation) < limit
    variance = float(np.mean(deviation[inliers] ** 2 - 1 / weights[observed][inliers]))
    pixel_weight = np.zeros(shape)
    if variance > 0:
        pixel_weight[observed] = variance / (variance + 1 / weights[observed])
    return np.asarray(smooth + pixel_weight * (mean - smooth))


def _blur_and_fill(sums: Float64, weights: Float64, width: float) -> Float64:
    """Blur a weighted mean, with increasing widths where there is no data."""
    out = np.zeros(sums.shape)
    missing = np.ones(sums.shape, bool)
    min_weight = 1e-3 * float(weights.max())
    while missing.any() and width < 4 * max(sums.shape):
        total = cv2.GaussianBlur(weights, (0, 0), width)
        blurred = cv2.GaussianBlur(sums, (0, 0), width)
        filled = missing & (total > min_weight)
        out[filled] = blurred[filled] / total[filled]
        missing &= ~filled
        width *= 2
    return out


def _patch_rms(
    views: Sequence[PlaneView], residuals: Sequence[Float64], shape: tuple[int, int]
) -> float:
    """Return the rms of the medians over patches of a tenth of the image's width."""
    side = max(4, shape[1] // 10)
    medians = []
    for view, residual in zip(views, residuals, strict=True):
        row, column = np.divmod(view.pixels, shape[1])
        patch = (row // side) * (shape[1] // side + 1) + column // side
        order = np.argsort(patch, kind="stable")
        starts = np.flatnonzero(np.diff(patch[order])) + 1
        groups = np.split(residual[order], starts)
        medians += [float(np.median(group)) for group in groups if len(group) >= side]
    return float(np.sqrt(np.mean(np.square(medians)))) if medians else float("nan")


def _size_warnings(knots: Float64, curve: Float64) -> list[str]:
    """Warn of a curve that a wrong size of the board's squares would explain."""
    slope, constant = np.polyfit(knots, curve, 1)
    if abs(slope) < _MAX_SCALE_ERROR or abs(constant) > _MAX_CONSTANT * abs(slope) * knots.mean():
        return []
    return [
        f"ranges are {100 * abs(slope):.1f} % too {'long' if slope > 0 else 'short'}, more than is "
        "usual for a ToF camera: measure a square of the board, since printers may rescale it"
    ]


def _warnings(views: Sequence[PlaneView], covered: float) -> list[str]:
    out = []
    if not _has_known_pose(views):
        out.append(
            "planes at unknown poses do not determine the scale of the range, and hardly a "
            "constant offset: both are unchanged; a checkerboard (--board) determines them"
        )
    if covered < 0.9:
        out.append(f"{100 * (1 - covered):.0f} % of the pixels saw no plane and were interpolated")
    if len({view.frame for view in views}) < 8:
        out.append("few views: 20 or more at all distances are better")
    return out
