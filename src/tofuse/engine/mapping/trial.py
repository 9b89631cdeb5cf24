"""The trial of a correction: whether overlapping views show the error that it corrects.

The error that a correction removes changes with the view, so that overlapping views disagree about
surfaces, where and by how much as the correction predicts. The trial estimates the strength of the
error: the fraction of the predicted disagreement that is present. Views of short runs are aligned
uncorrected; the distances between their surfaces are regressed on the change of these distances by
the correction, jointly with the poses of all views. The noise of the pixels is the same in both, so
that it causes no bias, and the spread between runs all over the recording gives the standard error.

The prediction has errors too, which differences between views amplify. So the strength is
underestimated (regression dilution): about a third of the true one in simulated rooms. And other
errors of the camera resemble the predicted one. Two of them, of the focal length and of the range
offset, are estimated jointly. And a second estimate must agree: poses of consecutive views by the
left and the right half of the images, and by the upper and the lower, differ by errors that depend
on the position in the image; the strength is the fraction of the predicted change of these
differences that is present.

A correction of an error with a strength of more than half the true one leaves less error than it
removes. So it is applied if both estimates exceed half of what the full error shows, and are
significant.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from scipy.special import stdtrit

from tofuse.engine.alignment import projective
from tofuse.engine.arrays import Float32, Float64, Intp
from tofuse.engine.compute import run_all
from tofuse.engine.frames import Frame, RangeFrame, Recording
from tofuse.engine.geometry import homogeneous, se3
from tofuse.engine.mapping.recorded_views import RecordedViews
from tofuse.engine.normal import robust_sigma
from tofuse.engine.views import PreparedView, SurfaceOptions, prepare_view

# Degrees of freedom of Student's t (Lange, Little and Taylor 1989 suggest 4).
_FREEDOM = 4.0
# Grid of the pooled value, in spreads of the estimates, and of both deviations.
_VALUES, _DEVIATIONS = 121, 14
_VALUE_RANGE, _MIN_DEVIATION, _MAX_DEVIATION = 6.0, 0.02, 5.0


def pooled(estimates: Float64, information: Float64) -> tuple[float, float]:
    """Pool estimates by a random-effects model with Student's t, which is robust to outliers.

    The k-th estimate is t-distributed about the pooled value, with the squared scale ``tau^2 +
    s^2 / information_k``: tau is the heterogeneity of the estimates, s the unit of the noise
    (random-effects meta-analysis, DerSimonian and Laird 1986; with t, Baker and Jackson 2008).
    The pooled value, tau and s are integrated over a grid with flat priors (for tau and s, on their
    logarithm).

    Parameters
    ----------
    estimates
        (n,) of the same quantity, at least 2.
    information
        (n,) above 0, proportional to the inverse variance of their noise.

    Returns
    -------
    Posterior mean and standard deviation.
    """
    centre = float(np.median(estimates))
    spread = robust_sigma(estimates - centre)
    spread = spread or float(np.std(estimates))
    if not spread:
        return centre, 0.0
    relative = information / float(np.median(information))
    # Within the range of the estimates, extended by their spread.
    lowest = max(centre - _VALUE_RANGE * spread, float(estimates.min()) - spread)
    highest = min(centre + _VALUE_RANGE * spread, float(estimates.max()) + spread)
    values = np.linspace(lowest, highest, _VALUES)
    scales = spread * np.geomspace(_MIN_DEVIATION, _MAX_DEVIATION, _DEVIATIONS)
    value, tau, s = np.meshgrid(values, scales, scales, indexing="ij")
    logs = np.zeros(value.shape)
    for estimate, precision in zip(estimates, relative, strict=True):
        variance = tau**2 + s**2 / precision
        logs -= 0.5 * np.log(variance)
        logs -= 0.5 * (_FREEDOM + 1) * np.log1p((estimate - value) ** 2 / variance / _FREEDOM)
    weight = np.exp(logs - logs.max()).sum((1, 2))
    weight /= weight.sum()
    mean = float(weight @ values)
    return mean, float(np.sqrt(weight @ (values - mean) ** 2))


# Views per run, each run being one sample; and number of runs, all over the recording.
_VIEWS, RUNS = 4, 12
# Desired motion between the views of a run: rad, or as a fraction of the depth; and the largest
# factor by which the stride is changed in one step.
_DESIRED_ANGLE, _DESIRED_DISTANCE = 0.17, 0.085
_MAX_CHANGE = 3.0
# Largest number of frames from one view of a run to the next.
_MAX_STRIDE = 64
# An alignment needs this fraction of the points on a surface of the other view, and this number of
# constrained directions.
_MIN_INLIERS, _MIN_CONSTRAINED = 0.3, 3
# Minimum number of runs, and the significance level.
_MIN_RUNS, _SIGNIFICANCE = 4, 0.05
# Strengths that the full error shows, in distances between surfaces and in poses by halves of the
# images: means of simulated rooms with indirect light (`benchmarks/multipath.py trial`).
_FULL_BY_SURFACES, _FULL_BY_HALVES = 0.36, 0.42
# Every n-th pixel is compared; and the minimum number of points of a pair.
_STRIDE, _MIN_POINTS = 3, 100
# Minimum cosine between normals of the same surface.
_MIN_NORMAL_COSINE = 0.88
# Residuals beyond this multiple of the robust deviation, which is at least this (m), are outliers.
_MAX_DEVIATIONS, _MIN_DEVIATION_M = 4.0, 0.005
# Standard deviation of a fitted plane, m, for any number of pixels.
_PLANE_SIGMA_M = 0.003
# Neighbouring pixels share errors of the prediction: factor on the variance of a single pixel.
_CORRELATION_FACTOR = 10.0
# Standard deviation of a correction, as a fraction of it.
_RELATIVE_SIGMA = 0.2
_ITERATIONS = 3
# Errors of the camera that are estimated jointly: offset of the range, and focal length.
_NUISANCES = 2
_ALIGNMENT = projective.ProjectiveOptions(
    levels=(
        projective.Level(4, 20, 0.15, 0.3),
        projective.Level(4, 15, 0.03, 0.1),
        projective.Level(2, 10, 0.005, 0.02),
    ),
    prior_m=3.0,
    prior_rad=3.0,
    common_tilt=0.0,
    common_slope=0.0,
)
# Alignments of halves of an image, from the pose by the whole image.
_HALVES = replace(_ALIGNMENT, levels=(projective.Level(4, 10, 0.03, 0.1), _ALIGNMENT.levels[-1]))
_VIEW = SurfaceOptions()

Prepare = Callable[[Frame], Frame]


@dataclass(frozen=True)
class Trial:
    """The result of a trial.

    Attributes
    ----------
    explained, predicted
        Of each run: the product of the measured disagreement and the predicted one, and the square
        of the predicted one, each as a weighted mean. Their ratio is the run's strength. Runs
        differ by more than noise, and one with bad poses is an outlier, so their strengths are
        pooled by a robust random-effects model (`pooled`).
    full
        Strength that the full error shows.
    by_halves
        The second estimate; None if the first one decides.
    """

    explained: tuple[float, ...]
    predicted: tuple[float, ...]
    full: float = _FULL_BY_SURFACES
    by_halves: Trial | None = None

    @cached_property
    def _pooled(self) -> tuple[float, float]:
        """Pooled strength and standard error of all runs."""
        if len(self.predicted) < _MIN_RUNS:
            return float("nan"), float("inf")
        predicted = np.array(self.predicted)
        return pooled(np.array(self.explained) / predicted, predicted)

    @property
    def strength(self) -> float:
        """Fraction of the predicted disagreement that is present; NaN with too few runs."""
        return self._pooled[0]

    @property
    def error(self) -> float:
        """Standard error of the strength, from the spread between runs."""
        return self._pooled[1]

    @property
    def is_significant(self) -> bool:
        """Whether the error is significant, and the correction leaves less than it removes."""
        n = len(self.predicted)
        if n < _MIN_RUNS:
            return False
        # Student's t, as the spread is estimated from few runs.
        limit = float(stdtrit(n - 1, 1 - _SIGNIFICANCE)) * self.error
        return self.strength > max(0.5 * self.full, limit)

    @property
    def improves(self) -> bool:
        """Whether both estimates are in favour of the correction."""
        other = self.by_halves
        return self.is_significant and other is not None and other.is_significant

    def in_words(self) -> str:
        """Describe the result."""
        if len(self.predicted) < _MIN_RUNS or not np.isfinite(self.strength):
            return "too few views overlap to decide"
        estimate = f"strength {self.strength:.2f}, standard error {self.error:.2f}"
        if self.by_halves is not None:
            estimate += f"; in poses {self.by_halves.strength:.2f}, {self.by_halves.error:.2f}"
        if self.improves:
            return f"overlapping views disagree as it predicts ({estimate})"
        return f"overlapping views do not clearly disagree as it predicts ({estimate})"


def trial(
    recording: Recording, uncorrected: Prepare, corrected: Prepare, runs: int = RUNS
) -> Trial:
    """Estimate the strength of the error that a correction removes.

    Parameters
    ----------
    recording
        The recording.
    uncorrected, corrected
        Prepare a frame for tracking without and with the correction. Called with the same frames,
        run by run.
    runs
        Number of runs.
    """
    if len(recording) < _VIEWS + _MIN_RUNS - 1:
        return Trial((), ())
    views = _AlignedViews(recording, uncorrected, corrected)
    stride = 1
    runs_of_views: dict[tuple[int, int], tuple[list[_TrialView], Float64]] = {}
    for fraction in (k / (runs - 1) for k in range(runs)):
        last = len(recording) - 1 - (_VIEWS - 1) * stride
        start = max(0, round(fraction * last))
        stride = views.stride(start, stride)
        if (start, stride) not in runs_of_views:
            runs_of_views[start, stride] = views.run(start, stride)
    regressed = run_all([partial(_regressed, *run) for run in runs_of_views.values()])
    found = _pairs_of_sums([run for run in regressed if run is not None], _FULL_BY_SURFACES)
    if not found.is_significant:
        return found
    by_halves = run_all([partial(views.by_halves, *run) for run in sorted(runs_of_views)])
    second = _pairs_of_sums([run for run in by_halves if run is not None], _FULL_BY_HALVES)
    return replace(found, by_halves=second)


def _pairs_of_sums(runs: Sequence[tuple[float, float]], full: float) -> Trial:
    explained, predicted = np.array(runs).reshape(-1, 2).T.tolist()
    return Trial(tuple(explained), tuple(predicted), full)


@dataclass(frozen=True, eq=False)
class _TrialView:
    """A view without the correction, and the relative change of its z (H, W) by the correction."""

    surface: PreparedView
    change: Float32
    uncorrected: RangeFrame
    corrected: RangeFrame

    @classmethod
    def of(cls, uncorrected: RangeFrame, corrected: RangeFrame) -> _TrialView:
        surface = prepare_view(uncorrected, _VIEW)
        valid = uncorrected.valid & corrected.valid
        change = np.where(valid, corrected.z / np.where(valid, uncorrected.z, 1) - 1, np.nan)
        rows, columns = surface.z.shape
        step = change.shape[1] // columns
        sampled = change[step // 2 :: step, step // 2 :: step][:rows, :columns]
        return cls(surface, sampled, uncorrected, corrected)

    @cached_property
    def corrected_surface(self) -> PreparedView:
        """The view with the correction."""
        return prepare_view(self.corrected, _VIEW)


class _AlignedViews:
    """Views of a recording and alignments between them, cached."""

    def __init__(self, recording: Recording, uncorrected: Prepare, corrected: Prepare) -> None:
        def both(image: RangeFrame) -> tuple[RangeFrame, RangeFrame] | None:
            before, after = uncorrected(image), corrected(image)
            if not (isinstance(before, RangeFrame) and isinstance(after, RangeFrame)):
                return None
            return (before, after) if len(before) else None

        self._count = len(recording)
        self._views = RecordedViews(recording, both, lambda pair: _TrialView.of(*pair))
        self._steps: dict[tuple[int, int], projective.Aligned | None] = {}

    def _step(self, i: int, j: int) -> projective.Aligned | None:
        """Align view j to view i; None if they do not fit."""
        if (i, j) not in self._steps:
            self._views.load([i, j])
            target, source = self._views.get(i), self._views.get(j)
            aligned = None
            if target is not None and source is not None:
                inputs = source.surface, [projective.Target(target.surface)]
                aligned = projective.align(*inputs, np.eye(4), _ALIGNMENT)
                fits = aligned.inlier_ratio * aligned.overlap >= _MIN_INLIERS
                if not fits or len(aligned.unobservable) > 6 - _MIN_CONSTRAINED:
                    aligned = None
            self._steps[i, j] = aligned
        return self._steps[i, j]

    def stride(self, start: int, stride: int) -> int:
        """Return the frames from one view to the next for the desired motion; iterative."""
        max_stride = max(1, min(_MAX_STRIDE, (self._count - 1) // _VIEWS))
        tried = set()
        while stride not in tried:
            tried.add(stride)
            step = self._step(start, start + stride)
            # Views that do not fit are too distant.
            ratio = _MAX_CHANGE
            if step is not None:
                ratio = max(self._relative_motion(start, step), 1 / _MAX_CHANGE)
            stride = min(max(1, round(stride / ratio)), max_stride)
        return stride

    def _relative_motion(self, k: int, step: projective.Aligned) -> float:
        """Return the motion relative to the desired one."""
        view, T = self._views.get(k), step.T_world_source
        depth = 1.0 if view is None else view.surface.depth
        return float((se3.lengths(T) / (_DESIRED_DISTANCE * depth, _DESIRED_ANGLE)).max())

    def run(self, start: int, stride: int) -> tuple[list[_TrialView], Float64]:
        """Return aligned views from `start` on, and their poses (N, 4, 4) relative to the first."""
        positions = range(start, start + (_VIEWS - 1) * stride, stride)
        self._views.load([*positions, positions[-1] + stride])
        first = self._views.get(start)
        if first is None:
            return [], np.zeros((0, 4, 4))
        views, poses = [first], [np.eye(4)]
        for k in positions:
            step, view = self._step(k, k + stride), self._views.get(k + stride)
            if step is None or view is None:
                break
            views.append(view)
            poses.append(poses[-1] @ step.T_world_source)
        return views, np.array(poses)

    def by_halves(self, start: int, stride: int) -> tuple[float, float] | None:
        """Return the run's products and squares as in `Trial`, of poses by halves; None if none."""
        sums = np.zeros(2)
        for k in range(start, start + (_VIEWS - 1) * stride, stride):
            step = self._steps.get((k, k + stride))
            if step is None:
                continue
            target, source = self._views.get(k), self._views.get(k + stride)
            if target is None or source is None:
                continue
            sides = (
                (target.surface, source.uncorrected),
                (target.corrected_surface, source.corrected),
            )
            (before, variance), (after, _) = (
                _halves_differ(*side, step.T_world_source) for side in sides
            )
            change = after - before
            sums += -(before * change / variance).sum(), (change**2 / variance).sum()
        return (float(sums[0]), float(sums[1])) if sums[1] > 0 else None


def _halves_differ(
    target: PreparedView, source: RangeFrame, T_target_source: Float64
) -> tuple[Float64, Float64]:
    """Return how poses of a view by halves of the image differ: (2, 6) twists and variances.

    Left and right, and upper and lower half; of the source, aligned with the whole target. Each
    half is prepared as an image of its own: planes across the cut would have errors of both.
    """
    onto = [projective.Target(target)]
    rows, columns = np.indices(source.depth.shape)
    weak = np.diag(np.repeat([_HALVES.prior_m, _HALVES.prior_rad], 3) ** -2.0)
    differences, variances = [], []
    for first in (2 * columns < source.depth.shape[1], 2 * rows < source.depth.shape[0]):
        a, b = (
            projective.align(prepare_view(half, _VIEW), onto, T_target_source, _HALVES)
            for half in (source.keep(first), source.keep(~first))
        )
        differences.append(se3.log(se3.inverse(a.T_world_source) @ b.T_world_source))
        covariance = sum(np.linalg.inv(x.information + weak) for x in (a, b))
        variances.append(np.diagonal(covariance))
    return np.array(differences), np.array(variances)


def _regressed(views: Sequence[_TrialView], poses: Float64) -> tuple[float, float] | None:
    """Regress the disagreement of a run jointly with its poses and nuisances: see `Trial`."""
    n = len(views)
    if n < 3:  # the relative pose of a pair absorbs nearly all of it
        return None
    poses = poses.copy()
    pairs = [(i, j) for i in range(n) for j in range(n) if i != j]
    for _ in range(_ITERATIONS):
        size = 6 * n + _NUISANCES + 1
        A, g = np.zeros((size, size)), np.zeros(size)
        for i, j in pairs:
            equations = _compared(views[i], views[j], se3.inverse(poses[i]) @ poses[j])
            if equations is None:
                continue
            J, residual, weight = equations
            columns = np.r_[6 * i : 6 * i + 6, 6 * j : 6 * j + 6, 6 * n : size]
            A[np.ix_(columns, columns)] += J.T @ (weight[:, None] * J)
            g[columns] += J.T @ (weight * residual)
        # The first view is fixed.
        step = _solved(A[6 : 6 * n, 6 : 6 * n], g[6 : 6 * n])
        poses[1:] = poses[1:] @ se3.exp(-step.reshape(-1, 6))
    # The part of the prediction that neither a motion of the views nor another error explains (the
    # Schur complement).
    solved = _solved(A[6:-1, 6:-1], np.stack([g[6:-1], A[6:-1, -1]], 1))
    predicted = A[-1, -1] - A[-1, 6:-1] @ solved[:, 1]
    explained = -(g[-1] - A[-1, 6:-1] @ solved[:, 0])
    return (float(explained), float(predicted)) if predicted > 0 else None


def _solved(matrix: Float64, right: Float64) -> Float64:
    """Solve normal equations; damping fixes unconstrained directions."""
    damped = matrix + np.diag(1e-6 * np.diag(matrix) + 1e-12)
    return np.asarray(np.linalg.solve(damped, right), np.float64)


def _compared(
    target: _TrialView, source: _TrialView, T: Float64
) -> tuple[Float64, Float64, Float64] | None:
    """Return the distances of a view's points from another's planes, with derivatives.

    Parameters
    ----------
    T
        (4, 4) T_target_source.

    Returns
    -------
    (M, 15) derivatives by the right perturbations of target and source (m, rad), by the other
    errors of the camera, and by the strength of the correction; (M,) distances in m; (M,) weights.
    None with too few points.
    """
    s, t = source.surface, target.surface
    subset = np.s_[::_STRIDE, ::_STRIDE]
    plane, change = s.planes[subset].astype(float), source.change[subset].astype(float)
    valid = (plane[..., 3] > 0) & np.isfinite(change)
    plane, change = plane[valid], change[valid]
    variance = s.plane_variance[subset][valid].astype(float)
    ray = homogeneous(s.rays[subset][valid])
    z = 1 / plane[:, 3]
    point = ray * z[:, None]
    R = T[:3, :3]
    transformed = point @ R.T + T[:3, 3]
    v, u, inside = _projected(t, transformed)
    target_plane = t.planes[v, u].astype(float)
    target_change = target.change[v, u].astype(float)
    length = np.linalg.norm(target_plane[:, :3], axis=1)
    valid = inside & (target_plane[:, 3] > 0) & (length > 0) & np.isfinite(target_change)
    length = np.where(valid, length, 1)
    normal = target_plane[:, :3] / length[:, None]
    source_normal = plane[:, :3] / np.linalg.norm(plane[:, :3], axis=1, keepdims=True)
    valid &= np.einsum("ki,ki->k", normal, source_normal @ R.T) > _MIN_NORMAL_COSINE
    distance = np.einsum("ki,ki->k", normal, transformed) - 1 / length
    valid &= np.isfinite(distance)
    if np.count_nonzero(valid) < _MIN_POINTS:
        return None
    deviation = robust_sigma(distance[valid])
    valid &= np.abs(distance) < _MAX_DEVIATIONS * max(deviation, _MIN_DEVIATION_M)
    if np.count_nonzero(valid) < _MIN_POINTS:
        return None
    normal, transformed, point, distance = (
        x[valid] for x in (normal, transformed, point, distance)
    )
    z, variance, v, u = z[valid], variance[valid], v[valid], u[valid]
    target_z = 1 / target_plane[valid, 3]
    target_ray = homogeneous(t.rays[v, u])
    normal_in_source = normal @ R
    target_point = target_ray * target_z[:, None]
    others = _by_other_errors(point, normal_in_source) - _by_other_errors(target_point, normal)
    source_term = np.einsum("ki,ki->k", normal_in_source, point) * change[valid]
    target_term = -np.einsum("ki,ki->k", normal, target_point) * target_change[valid]
    J = np.concatenate(
        [
            -normal,
            -np.cross(transformed, normal),
            normal_in_source,
            np.cross(point, normal_in_source),
            others,
            (source_term + target_term)[:, None],
        ],
        axis=1,
    )
    noise = variance * z**4 + t.plane_variance[v, u] * target_z**4
    prediction_variance = (
        _CORRELATION_FACTOR * _RELATIVE_SIGMA**2 * (source_term**2 + target_term**2)
    )
    # Errors of neighbours are correlated: a pair has the same weight for any number of points.
    weight = 1 / (2 * noise + _PLANE_SIGMA_M**2 + prediction_variance) / len(distance)
    return J, distance, weight


def _by_other_errors(points: Float64, normals: Float64) -> Float64:
    """Return how points (M, 3) move along normals by an offset of the range and a focal length."""
    along = np.einsum("ki,ki->k", normals, points) / np.linalg.norm(points, axis=1)
    return np.stack([along, (normals[:, :2] * points[:, :2]).sum(1)], 1)


def _projected(view: PreparedView, points: Float64) -> tuple[Intp, ...]:
    """Project points (M, 3): row and column (M,) of their pixels, and whether they are inside."""
    grid = view.projection
    in_front = points[:, 2] > 1e-3
    xy = points[:, :2] / np.where(in_front, points[:, 2], 1)[:, None]
    x0, y0, per_x, per_y = grid.frame
    nodes = np.stack([(xy[:, 1] - y0) * per_y, (xy[:, 0] - x0) * per_x], 1)
    last = np.array(grid.lookup.shape[:2]) - 1
    inside = in_front & ((nodes >= 0) & (nodes <= last)).all(1)
    a, b = np.rint(np.clip(nodes, 0, last)).astype(np.intp).T
    u, v = np.rint(grid.lookup[a, b]).T
    rows, columns = view.z.shape
    inside &= (u >= 0) & (v >= 0) & (u < columns) & (v < rows)
    return (
        np.where(inside, v, 0).astype(np.intp),
        np.where(inside, u, 0).astype(np.intp),
        inside.astype(bool),
    )
