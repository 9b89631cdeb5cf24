"""Whether a correction may stay: a trial on some views of a recording, which knows no truth.

The error that a correction takes off changes with the view, so that overlapping views disagree
about where surfaces are, and the correction says beforehand where and by how much. The trial asks
for its strength: which share of the predicted disagreement is there. Some views of a run are laid
over each other as they are; how far their surfaces are apart is regressed on what the correction
would change of that, with the poses of all views free to follow. The noise of the pixels is the
same on both sides, so it does not bend the answer, and the spread between places all over the
recording says how far it is known.

What is predicted has errors of its own, and differences between views have more of them than of
the truth. So the strength comes out too small where all of the error is there (regression
dilution): 0.2 to 0.5 in simulated rooms. It tells whether there is anything to take off, not how
much.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import stdtrit

from tofuse.arrays import Float32, Float64, Intp
from tofuse.errors import UnreadableFrameError
from tofuse.geometry import se3
from tofuse.pipeline.pooling import pooled
from tofuse.recordings.frames import Frame, RangeFrame
from tofuse.recordings.recording import Recording
from tofuse.registration.prepared_view import PreparedView, SurfaceOptions, prepare_view
from tofuse.registration.projective import (
    Aligned,
    Level,
    ProjectiveOptions,
    Target,
    align,
)

# Runs of so many views each, each of them one piece of evidence; where in the recording they begin.
_VIEWS = 4
_PLACES = tuple(k / 11 for k in range(12))
# Motion between the views of a run that is wanted: rad, or as a share of the depth; and by which
# factor a guess is mended at once.
_ANGLE, _DISTANCE = 0.17, 0.085
_TOO_FAR = 3.0
# Largest number of frames from one view of a run to the next.
_FARTHEST = 64
# Least share of the points that meet a surface of the other view, and fit it; an alignment that
# holds fewer directions is none.
_FITS, _LEAST_HELD = 0.3, 3
# Fewest runs that can tell, and the chance that they do by luck.
_LEAST_RUNS, _LUCK = 4, 0.05
# Strength that other errors fake: what lens and smoothing do to corners looks like indirect light.
# In simulated rooms without any it is up to 0.12, with it 0.2 and more.
_FAKED = 0.15
# Points: every so manieth pixel, and the fewest that a pair needs.
_STRIDE, _LEAST_POINTS = 3, 100
# Surfaces that differ more in direction (cosine) are not the same one.
_SAME_SIDE = 0.88
# Residuals beyond so many robust deviations, and these are at least so large (m), are outliers.
_ROBUST, _LEAST_DEVIATION_M = 4.0, 0.005
# The fit of a plane is no better than this, m, however many pixels it has.
_PLANE_M = 0.003
# Neighbouring pixels share what is wrong with a prediction: each pixel is told so much more of it.
_SHARED = 10.0
_ITERATIONS = 3
_ALIGNMENT = ProjectiveOptions(
    levels=(Level(4, 20, 0.15, 0.3), Level(4, 15, 0.03, 0.1), Level(2, 10, 0.005, 0.02)),
    prior_m=3.0,
    prior_rad=3.0,
    common_tilt=0.0,
    common_slope=0.0,
)
_VIEW = SurfaceOptions()

Prepare = Callable[[Frame], Frame]


@dataclass(frozen=True)
class Trial:
    """What a trial found.

    Attributes
    ----------
    explained, predicted
        Of each run: the product of the disagreement that is there with the predicted one, and the
        square of the predicted one, each as a weighted mean. Their ratio is the run's strength.
        Runs differ by more than noise, and one with bad poses may be far off, so their strengths
        are pooled by a robust random-effects model (`pooling`).
    """

    explained: tuple[float, ...]
    predicted: tuple[float, ...]

    @cached_property
    def _pooled(self) -> tuple[float, float]:
        """Strength and standard error of all runs together."""
        if len(self.predicted) < _LEAST_RUNS:
            return float("nan"), float("inf")
        predicted = np.array(self.predicted)
        return pooled(np.array(self.explained) / predicted, predicted)

    @property
    def strength(self) -> float:
        """Share of the predicted disagreement that is there; NaN where too few runs tell."""
        return self._pooled[0]

    @property
    def error(self) -> float:
        """Standard error of the strength, from how much the runs differ."""
        return self._pooled[1]

    @property
    def relative_error(self) -> float:
        """Of the strength, as a share of it."""
        return self.error / self.strength if self.strength > 0 else float("inf")

    @property
    def helps(self) -> bool:
        """Whether the error that the correction takes off is clearly there.

        Not by luck, and more of it than other errors fake.
        """
        n = len(self.predicted)
        if n < _LEAST_RUNS:
            return False
        # Student's, as the spread is known from as few runs.
        least = max(_FAKED, float(stdtrit(n - 1, 1 - _LUCK)) * self.error)
        return self.strength > least

    def in_words(self) -> str:
        """What was found, in words."""
        if len(self.predicted) < _LEAST_RUNS or not np.isfinite(self.strength):
            return "too few views overlap to tell"
        found = f"strength {self.strength:.2f}, standard error {self.error:.2f}"
        if self.helps:
            return f"overlapping views disagree as it predicts ({found})"
        return f"overlapping views do not clearly disagree as it predicts ({found})"


def trial(recording: Recording, without: Prepare, corrected: Prepare, doubt: float = 0.2) -> Trial:
    """Ask views whether the error is there that a correction takes off.

    Parameters
    ----------
    without, corrected
        Make of a frame what would be tracked. Called with the same frames, run by run.
    doubt
        Standard deviation of the correction, as a share of it.
    """
    if len(recording) < _VIEWS + _LEAST_RUNS - 1:
        return Trial((), ())
    bench = _Bench(recording, without, corrected)
    stride, seen, told = 1, set(), []
    for place in _PLACES:
        last = len(recording) - 1 - (_VIEWS - 1) * stride
        start = max(0, round(place * last))
        stride = bench.stride(start, stride)
        if (start, stride) in seen:
            continue
        seen.add((start, stride))
        found = _asked(*bench.run(start, stride), doubt)
        if found is not None:
            told.append(found)
    explained, predicted = np.array(told).reshape(-1, 2).T.tolist()
    return Trial(tuple(explained), tuple(predicted))


@dataclass(frozen=True, eq=False)
class _View:
    """A view without the correction, and by which share of z (H, W) that would move its points."""

    surface: PreparedView
    change: Float32

    @classmethod
    def of(cls, without: RangeFrame, corrected: RangeFrame) -> _View:
        surface = prepare_view(without, _VIEW)
        both = without.valid & corrected.valid
        share = np.where(both, corrected.z / np.where(both, without.z, 1) - 1, np.nan)
        rows, columns = surface.z.shape
        step = share.shape[1] // columns
        return cls(surface, share[step // 2 :: step, step // 2 :: step][:rows, :columns])


class _Bench:
    """Views of a recording, made ready when they are first asked for."""

    def __init__(self, recording: Recording, without: Prepare, corrected: Prepare) -> None:
        self._recording = recording
        self._without, self._corrected = without, corrected
        self._views: dict[int, _View | None] = {}
        self._steps: dict[tuple[int, int], Aligned | None] = {}

    def _view(self, k: int) -> _View | None:
        if k not in self._views:
            self._views[k] = self._prepared(k)
        return self._views[k]

    def _prepared(self, k: int) -> _View | None:
        if k >= len(self._recording):
            return None
        try:
            frame = self._recording[k]
        except UnreadableFrameError:
            return None
        without, corrected = self._without(frame), self._corrected(frame)
        if not (isinstance(without, RangeFrame) and isinstance(corrected, RangeFrame)):
            return None
        return _View.of(without, corrected) if len(without) else None

    def _step(self, i: int, j: int) -> Aligned | None:
        """View j in view i; None where they do not fit."""
        if (i, j) not in self._steps:
            target, source = self._view(i), self._view(j)
            found = None
            if target is not None and source is not None:
                ends = source.surface, [Target(target.surface, np.eye(4))]
                found = align(*ends, np.eye(4), _ALIGNMENT)
                fits = found.inlier_share * found.overlap >= _FITS
                if not fits or len(found.unobservable) > 6 - _LEAST_HELD:
                    found = None
            self._steps[i, j] = found
        return self._steps[i, j]

    def stride(self, start: int, stride: int) -> int:
        """Frames from one view to the next, for the motion that is wanted; from that before."""
        farthest = max(1, min(_FARTHEST, (len(self._recording) - 1) // _VIEWS))
        tried = set()
        while stride not in tried:
            tried.add(stride)
            step = self._step(start, start + stride)
            # What does not fit is farther away than it should be.
            moved = _TOO_FAR if step is None else max(self._moved(start, step), 1 / _TOO_FAR)
            stride = min(max(1, round(stride / moved)), farthest)
        return stride

    def _moved(self, k: int, step: Aligned) -> float:
        view, T = self._view(k), step.T_world_source
        depth = 1.0 if view is None else view.surface.depth
        far = float(np.linalg.norm(T[:3, 3]))
        return max(float(se3.angle(T)) / _ANGLE, far / (_DISTANCE * depth))

    def run(self, start: int, stride: int) -> tuple[list[_View], Float64]:
        """Views from `start` on that hang together, and their poses (N, 4, 4) in the first one."""
        first = self._view(start)
        if first is None:
            return [], np.zeros((0, 4, 4))
        views, poses = [first], [np.eye(4)]
        for k in range(start, start + (_VIEWS - 1) * stride, stride):
            step, view = self._step(k, k + stride), self._view(k + stride)
            if step is None or view is None:
                break
            views.append(view)
            poses.append(poses[-1] @ step.T_world_source)
        return views, np.array(poses)


def _asked(views: Sequence[_View], poses: Float64, doubt: float) -> tuple[float, float] | None:
    """What a run says of the strength, when the poses of its views follow: see `Trial`."""
    n = len(views)
    if n < 3:  # a pair takes nearly all of it for motion
        return None
    poses = poses.copy()
    pairs = [(i, j) for i in range(n) for j in range(n) if i != j]
    for _ in range(_ITERATIONS):
        A, g = np.zeros((6 * n + 1, 6 * n + 1)), np.zeros(6 * n + 1)
        for i, j in pairs:
            rows = _compared(views[i], views[j], se3.inverse(poses[i]) @ poses[j], doubt)
            if rows is None:
                continue
            J, residual, weight = rows
            at = np.r_[6 * i : 6 * i + 6, 6 * j : 6 * j + 6, 6 * n]
            A[np.ix_(at, at)] += J.T @ (weight[:, None] * J)
            g[at] += J.T @ (weight * residual)
        # The first view stays; directions that nothing holds do as well.
        free = A[6:-1, 6:-1]
        free = free + np.diag(1e-6 * np.diag(free) + 1e-12)
        solved = np.linalg.solve(free, np.stack([g[6:-1], A[6:-1, -1]], 1))
        poses[1:] = poses[1:] @ se3.exp(-solved[:, 0].reshape(-1, 6))
    # Of the prediction what no motion of the views explains (the Schur complement).
    predicted = A[-1, -1] - A[-1, 6:-1] @ solved[:, 1]
    explained = -(g[-1] - A[-1, 6:-1] @ solved[:, 0])
    return (float(explained), float(predicted)) if predicted > 0 else None


def _compared(
    target: _View, source: _View, T: Float64, doubt: float
) -> tuple[Float64, Float64, Float64] | None:
    """Distances of the points of a view from another's planes.

    Parameters
    ----------
    T
        (4, 4) T_target_source.

    Returns
    -------
    (M, 13) derivatives by the right perturbations of target and source (m, rad), and by the
    strength of the correction; (M,) distances in m; (M,) weights. None where hardly any are left.
    """
    s, t = source.surface, target.surface
    thin = np.s_[::_STRIDE, ::_STRIDE]
    plane, change = s.planes[thin].astype(float), source.change[thin].astype(float)
    known = (plane[..., 3] > 0) & np.isfinite(change)
    plane, change = plane[known], change[known]
    variance = s.plane_variance[thin][known].astype(float)
    ray = np.concatenate([s.rays[thin][known], np.ones((len(plane), 1))], 1).astype(float)
    z = 1 / plane[:, 3]
    point = ray * z[:, None]
    R = T[:3, :3]
    moved = point @ R.T + T[:3, 3]
    v, u, inside = _landed(t, moved)
    facing = t.planes[v, u].astype(float)
    target_change = target.change[v, u].astype(float)
    length = np.linalg.norm(facing[:, :3], axis=1)
    known = inside & (facing[:, 3] > 0) & (length > 0) & np.isfinite(target_change)
    length = np.where(known, length, 1)
    normal = facing[:, :3] / length[:, None]
    own = plane[:, :3] / np.linalg.norm(plane[:, :3], axis=1, keepdims=True)
    known &= np.einsum("ki,ki->k", normal, own @ R.T) > _SAME_SIDE
    distance = np.einsum("ki,ki->k", normal, moved) - 1 / length
    known &= np.isfinite(distance)
    if np.count_nonzero(known) < _LEAST_POINTS:
        return None
    deviation = 1.4826 * float(np.median(np.abs(distance[known])))
    known &= np.abs(distance) < _ROBUST * max(deviation, _LEAST_DEVIATION_M)
    if np.count_nonzero(known) < _LEAST_POINTS:
        return None
    normal, moved, point, distance = (x[known] for x in (normal, moved, point, distance))
    z, variance, v, u = z[known], variance[known], v[known], u[known]
    target_z = 1 / facing[known, 3]
    target_ray = np.concatenate([t.rays[v, u], np.ones((len(v), 1))], 1).astype(float)
    along = normal @ R
    by_source = np.einsum("ki,ki->k", along, point) * change[known]
    by_target = -np.einsum("ki,ki->k", normal, target_ray) * target_z * target_change[known]
    J = np.concatenate(
        [
            -normal,
            -np.cross(moved, normal),
            along,
            np.cross(point, along),
            (by_source + by_target)[:, None],
        ],
        axis=1,
    )
    noise = variance * z**4 + t.plane_variance[v, u] * target_z**4
    vague = _SHARED * doubt**2 * (by_source**2 + by_target**2)
    # Neighbours share nearly everything: a pair counts as much however many points it has.
    weight = 1 / (2 * noise + _PLANE_M**2 + vague) / len(distance)
    return J, distance, weight


def _landed(view: PreparedView, points: Float64) -> tuple[Intp, ...]:
    """Row and column (M,) of the pixels of a view that points (M, 3) land on, and if they do."""
    grid = view.projection
    ahead = points[:, 2] > 1e-3
    xy = points[:, :2] / np.where(ahead, points[:, 2], 1)[:, None]
    x0, y0, per_x, per_y = grid.frame
    nodes = np.stack([(xy[:, 1] - y0) * per_y, (xy[:, 0] - x0) * per_x], 1)
    most = np.array(grid.lookup.shape[:2]) - 1
    inside = ahead & ((nodes >= 0) & (nodes <= most)).all(1)
    a, b = np.rint(np.clip(nodes, 0, most)).astype(np.intp).T
    u, v = np.rint(grid.lookup[a, b]).T
    rows, columns = view.z.shape
    inside &= (u >= 0) & (v >= 0) & (u < columns) & (v < rows)
    return (
        np.where(inside, v, 0).astype(np.intp),
        np.where(inside, u, 0).astype(np.intp),
        inside.astype(bool),
    )
