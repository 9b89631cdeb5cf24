"""A camera's systematic errors of range, from pixels that see planes.

What a pixel p measures of a plane is ``r = t + c(r) + o_p`` with t the true range, c the same
curve for all pixels and o_p an offset of its own (Lindner and Kolb 2006, who know the planes'
poses). Curve, offsets and all planes are estimated together, by Gauss-Newton on robust least
squares; the offsets are eliminated pixel by pixel. Where no plane's pose is known, a curve that
grows with the range is the same as planes that are farther off: the data says nothing about the
scale, and a weak prior keeps it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from scipy.sparse import csr_array, diags_array

from tofuse.arrays import Float64, Intp
from tofuse.calibration.plane_views import PlaneView
from tofuse.errors import InputError
from tofuse.geometry.cameras import Camera
from tofuse.sensor.depth_correction import DepthCorrection

_KNOT_M = 0.04
_MOST_KNOTS = 200
_PIXELS = 6000  # that the curve is estimated from; offsets are of all pixels
_ROUNDS = 8
_HUBER = 2.0  # standard deviations
# What is believed beforehand, standard deviations in m: of the curve, of its bend from knot to
# knot, of the offsets; of the curve's mean and slope, where no plane's pose is known.
_CURVE_M, _BEND_M, _OFFSET_M = 0.1, 0.004, 0.02
# Where boards' poses tell a slope over the image, pixels are free while planes are estimated: what
# is believed of thousands of them would outweigh the poses.
_ANY_OFFSET_M, _MEAN_OFFSET_M = 1.0, 1e-4
_MEAN_M, _SLOPE = 0.002, 0.001
_FLOOR_M = 0.001  # of the noise
_LEAST_SPREAD_M = 0.3
_MOST_SHAPE_M = 0.004  # standard deviation of the curve, but for mean and slope
_SMOOTH = 1 / 50  # of the image's width


@dataclass(frozen=True)
class DepthFit:
    """A correction of depth, and how well it is known.

    Attributes
    ----------
    correction
        What to subtract.
    frames, planes
        Frames that were used, and planes in them.
    range_m
        Nearest and farthest range that was seen: the curve is held constant beyond.
    before_m, after_m
        Distance of single pixels from the planes, noise included, root mean square of the middle.
    bias_before_m, bias_after_m
        The same of means over patches of pixels, of which noise is averaged away.
    constant_sigma_m, scale_sigma
        Standard deviations of the curve's mean in m, and of its slope (a share of the range); where
        no pose is known, those of what was believed beforehand.
    warnings
        What a person should know, one line each.
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
        Of `board_planes` or `scene_planes`.
    camera
        Whose pixels they are.
    where
        What was opened, for messages.

    Raises
    ------
    InputError
        If the planes are all at about one range.
    """
    everything = np.concatenate([view.measured_m for view in views])
    low, high = (float(v) for v in np.quantile(everything, [0.005, 0.995]))
    if high - low < _LEAST_SPREAD_M:
        raise InputError(
            f"shows planes from {low:.2f} to {high:.2f} m only",
            where=where,
            remedy="record a wall from several distances, over the range that is to be corrected",
        )
    count = int(np.clip(np.ceil((high - low) / _KNOT_M), 4, _MOST_KNOTS)) + 1
    knots = np.linspace(low, high, count)
    shape = camera.height, camera.width
    thinned = [_thinned(view, shape) for view in views]
    state = _solved(thinned, knots, shape)
    if not state.shape_sigma < _MOST_SHAPE_M:
        raise InputError(
            f"shows {len(views)} planes, which tell the curve to {1000 * state.shape_sigma:.0f} mm",
            where=where,
            remedy="record a wall from 20 places or more, at all distances, tilted to all sides",
        )
    residuals = _residuals(views, knots, state)
    offsets = _offsets(views, residuals, shape)
    # The mean of the offsets is the curve's.
    seen = np.unique(np.concatenate([view.pixels for view in views]))
    mean = float(offsets.ravel()[seen].mean())
    offsets -= mean
    curve = state.curve + mean
    after = [r - offsets.ravel()[v.pixels] - mean for r, v in zip(residuals, views, strict=True)]
    flat = np.zeros_like(curve)
    before = _residuals(views, knots, _own_planes(thinned, knots, flat, shape))
    constant, scale = state.sigma
    return DepthFit(
        DepthCorrection(knots, curve, offsets.astype(np.float32)),
        len({view.frame for view in views}),
        len(views),
        (low, high),
        _middle(np.concatenate(before)),
        _middle(np.concatenate(after)),
        _patches(views, before, shape),
        _patches(views, after, shape),
        constant,
        scale,
        tuple(_warnings(views, len(seen) / (shape[0] * shape[1]))),
    )


def composed(first: DepthCorrection, then: DepthCorrection) -> DepthCorrection:
    """Return one correction for two, the second of which is of what the first has corrected.

    The first's offsets move the range at which the second is looked up by millimetres, which
    changes nothing that counts.
    """
    ends = [then.range_m[0], then.range_m[-1]]
    back = then.range_m + np.interp(then.range_m, first.range_m, first.bias_m)
    knots = np.unique(np.concatenate([first.range_m, back, ends]))
    bias = np.interp(knots, first.range_m, first.bias_m)
    bias = bias + np.interp(knots - bias, then.range_m, then.bias_m)
    a, b = first.pixel_bias_m, then.pixel_bias_m
    pixel = b if a is None else a if b is None else a + b
    return DepthCorrection(knots, bias, pixel)


@dataclass(frozen=True, eq=False)
class _State:
    """Curve (K,) in m, planes (V, 3), deviations of the curve's mean and slope, and of the rest."""

    curve: Float64
    planes: Float64
    sigma: tuple[float, float]
    shape_sigma: float


def _thinned(view: PlaneView, shape: tuple[int, int]) -> PlaneView:
    """Every so manieth row and column, the same in all views."""
    step = max(1, round(float(np.sqrt(shape[0] * shape[1] / _PIXELS))))
    row, column = np.divmod(view.pixels, shape[1])
    keep = (row % step == step // 2) & (column % step == step // 2)
    return PlaneView(
        view.frame,
        view.plane,
        view.information,
        view.pixels[keep],
        view.measured_m[keep],
        view.sigma_m[keep],
        view.directions[keep],
    )


def _own_planes(
    views: Sequence[PlaneView], knots: Float64, curve: Float64, shape: tuple[int, int]
) -> _State:
    """Fit the planes alone, to what was measured."""
    return _solved(views, knots, shape, held=curve)


def _solved(
    views: Sequence[PlaneView],
    knots: Float64,
    shape: tuple[int, int],
    held: Float64 | None = None,
) -> _State:
    """Gauss-Newton over curve and planes; a curve that is `held` stays, and has no offsets."""
    many = len(knots)
    counts = [len(view.pixels) for view in views]
    measured = np.concatenate([view.measured_m for view in views])
    sigma = np.hypot(np.concatenate([view.sigma_m for view in views]), _FLOOR_M)
    rays = np.concatenate([view.directions for view in views])
    which = np.repeat(np.arange(len(views)), counts)
    pixels, pixel = np.unique(np.concatenate([view.pixels for view in views]), return_inverse=True)
    start = np.stack([view.plane for view in views])
    planes, curve = start.copy(), np.zeros(many) if held is None else held.copy()
    offsets = np.zeros(len(pixels))
    prior = _prior(knots, posed=_posed(views))
    believed = _ANY_OFFSET_M if _posed(views) else _OFFSET_M
    size = many + 3 * len(views)
    n = len(measured)
    covariance = np.zeros((many, many))
    scale = 1.0
    for _ in range(_ROUNDS):
        true = 1 / np.einsum("nc,nc->n", planes[which], rays)
        left, share = _between(_expected(true, knots, curve), knots)
        bias = curve[left] * (1 - share) + curve[left + 1] * share
        residual = measured - true - bias - offsets[pixel]
        scale = max(_middle(residual / sigma), 0.1)
        weight = 1 / (sigma * scale) ** 2
        weight *= np.minimum(1, _HUBER * scale * sigma / np.maximum(np.abs(residual), 1e-12))
        # Columns: two knots, three numbers of the plane. d(true) = -true^2 ray . d(plane).
        slope = -(true**2)[:, None] * rays
        columns = np.stack([left, left + 1, *(many + 3 * which + a for a in range(3))], 1)
        values = np.concatenate([np.stack([1 - share, share], 1), slope], 1)
        A = csr_array((values.ravel(), columns.ravel(), np.arange(0, 5 * n + 1, 5)), (n, size))
        AtW = (diags_array(weight) @ A).T.tocsr()
        normal = (AtW @ A).toarray()
        # Without the offsets: they are solved for afterwards.
        target = residual + offsets[pixel]
        right = AtW @ target
        by_pixel = csr_array((weight, (pixel, np.arange(n))), (len(pixels), n))
        total = by_pixel.sum(1) + 1 / believed**2
        if held is None:
            coupled = by_pixel @ A
            normal -= (coupled.T @ (diags_array(1 / total) @ coupled)).toarray()
            alone = (by_pixel @ target) / total
            right -= coupled.T @ alone
            # Their mean is the curve's: held at 0, by the formula of Sherman and Morrison.
            held_mean = 1 / ((len(total) * _MEAN_OFFSET_M) ** 2 + (1 / total).sum())
            together = coupled.T @ (1 / total)
            normal += held_mean * np.outer(together, together)
            right += held_mean * together * alone.sum()
            normal[:many, :many] += prior
            right[:many] -= prior @ curve
        for k, view in enumerate(views):
            own = slice(many + 3 * k, many + 3 * k + 3)
            normal[own, own] += view.information
            right[own] += view.information @ (start[k] - planes[k])
        free = slice(0, None) if held is None else slice(many, None)
        step = np.zeros(size)
        # Columns of a plane and of the curve are of other sizes.
        unit = 1 / np.sqrt(np.maximum(np.diag(normal)[free], 1e-12))
        scaled = normal[free, free] * unit[:, None] * unit
        step[free] = unit * np.linalg.solve(scaled + 1e-10 * np.eye(len(unit)), unit * right[free])
        curve = curve + step[:many]
        planes = planes + step[many:].reshape(-1, 3)
        if held is None:
            alone = (by_pixel @ (target - A @ step)) / total
            offsets = alone - held_mean * alone.sum() / total
            inverse = np.linalg.inv(scaled + 1e-10 * np.eye(len(unit)))
            covariance = (inverse * unit[:, None] * unit)[:many, :many]
    weights = (np.bincount(left, minlength=many) + 1e-9).astype(np.float64)
    rest = np.eye(many) - _line(knots) @ _level(knots, np.ones(many))
    variances = np.diag(rest @ covariance @ rest.T)
    shape_sigma = float(np.sqrt(max(np.average(variances, weights=weights), 0)))
    return _State(curve, planes, _deviations(knots, weights, covariance), shape_sigma)


def _deviations(knots: Float64, weights: Float64, covariance: Float64) -> tuple[float, float]:
    """Standard deviations of the curve's mean, and of its slope, over the ranges that were seen."""
    functionals = _level(knots, weights)
    variances = np.diag(functionals @ covariance @ functionals.T)
    constant, slope = np.sqrt(np.maximum(variances, 0))
    return float(constant), float(slope)


def _line(knots: Float64) -> Float64:
    """(K, 2) a constant and a slope about the middle, as curves."""
    return np.stack([np.ones_like(knots), knots - knots.mean()], 1)


def _level(knots: Float64, weights: Float64) -> Float64:
    """(2, K) what takes mean and slope of a curve, by weighted least squares."""
    base = np.stack([np.ones_like(knots), knots - np.average(knots, weights=weights)], 1)
    return np.asarray(np.linalg.solve((base.T * weights) @ base, base.T * weights))


def _expected(true: Float64, knots: Float64, curve: Float64) -> Float64:
    """Ranges that a true range is measured as, without noise.

    Where the curve is looked up: at what was measured, noise would look like a slope of the curve.
    """
    return np.asarray(true + np.interp(true + np.interp(true, knots, curve), knots, curve))


def _between(measured: Float64, knots: Float64) -> tuple[Intp, Float64]:
    """(N,) knot before each range, and how far it is on the way to the next."""
    place = (measured - knots[0]) / (knots[1] - knots[0])
    left = np.clip(np.floor(place), 0, len(knots) - 2).astype(np.intp)
    return left, np.clip(place - left, 0, 1)


def _posed(views: Sequence[PlaneView]) -> bool:
    """Whether the pose of any plane is known."""
    return any(float(np.trace(view.information)) > 1 for view in views)


def _prior(knots: Float64, *, posed: bool) -> Float64:
    """(K, K) information about a curve: small, bent little from knot to knot, and maybe level."""
    many = len(knots)
    bend = np.diff(np.eye(many), 2, axis=0)
    information = np.eye(many) / (_CURVE_M**2 * many) + bend.T @ bend / _BEND_M**2
    if not posed:
        level = _level(knots, np.ones(many)) / np.array([[_MEAN_M], [_SLOPE]])
        information += level.T @ level
    return np.asarray(information)


def _residuals(views: Sequence[PlaneView], knots: Float64, state: _State) -> list[Float64]:
    """What remains of each pixel's range without its offset, view by view."""
    out = []
    for view, plane in zip(views, state.planes, strict=True):
        true = 1 / (view.directions @ plane)
        bias = np.interp(_expected(true, knots, state.curve), knots, state.curve)
        out.append(view.measured_m - true - bias)
    return out


def _offsets(
    views: Sequence[PlaneView], residuals: Sequence[Float64], shape: tuple[int, int]
) -> Float64:
    """(H, W) offsets: what is smooth over the image, and of a pixel's own as much as it is known.

    The share of what a pixel measured alone follows from how much more pixels differ than their
    noise (empirical Bayes).
    """
    size = shape[0] * shape[1]
    sums, weights = np.zeros(size), np.zeros(size)
    joined = np.concatenate(residuals)
    sigma = np.hypot(np.concatenate([view.sigma_m for view in views]), _FLOOR_M)
    scale = max(_middle(joined / sigma), 0.1)
    for view, residual in zip(views, residuals, strict=True):
        own = np.hypot(view.sigma_m, _FLOOR_M) * scale
        # The residual holds the offset itself: only what is far off is an outlier.
        far = 3 * _OFFSET_M + 3 * own
        weight = np.where(np.abs(residual) < far, 1 / own**2, 0)
        np.add.at(sums, view.pixels, weight * residual)
        np.add.at(weights, view.pixels, weight)
    sums, weights = sums.reshape(shape), weights.reshape(shape)
    mean = np.divide(sums, weights, out=np.zeros(shape), where=weights > 0)
    smooth = _filled(sums, weights, max(2.0, _SMOOTH * shape[1]))
    seen = weights > 0
    apart = (mean - smooth)[seen]
    limit = 3 * max(_middle(apart), 1e-6)
    typical = np.abs(apart) < limit
    variance = float(np.mean(apart[typical] ** 2 - 1 / weights[seen][typical]))
    own_share = np.zeros(shape)
    if variance > 0:
        own_share[seen] = variance / (variance + 1 / weights[seen])
    return np.asarray(smooth + own_share * (mean - smooth))


def _filled(sums: Float64, weights: Float64, width: float) -> Float64:
    """Blur a weighted mean; where nothing was seen, wider and wider."""
    out = np.zeros(sums.shape)
    missing = np.ones(sums.shape, bool)
    least = 1e-3 * float(weights.max())
    while missing.any() and width < 4 * max(sums.shape):
        total = cv2.GaussianBlur(weights, (0, 0), width)
        blurred = cv2.GaussianBlur(sums, (0, 0), width)
        new = missing & (total > least)
        out[new] = blurred[new] / total[new]
        missing &= ~new
        width *= 2
    return out


def _middle(values: Float64) -> float:
    """Root mean square of a normal distribution with these values' median."""
    return float(np.median(np.abs(values))) / 0.6745


def _patches(
    views: Sequence[PlaneView], residuals: Sequence[Float64], shape: tuple[int, int]
) -> float:
    """Root mean square of the medians over patches of a tenth of the image's width."""
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


def _warnings(views: Sequence[PlaneView], covered: float) -> list[str]:
    out = []
    if not _posed(views):
        out.append(
            "planes at unknown poses do not tell the scale of the range, and hardly a constant "
            "offset: both are left as they are; a checkerboard (--board) tells them"
        )
    if covered < 0.9:
        out.append(f"{100 * (1 - covered):.0f} % of the pixels saw no plane: interpolated")
    if len({view.frame for view in views}) < 8:
        out.append("few views: 20 or more at all distances are better")
    return out
