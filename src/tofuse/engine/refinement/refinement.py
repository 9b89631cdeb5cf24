"""Refinement as a part: selection of views, acceptance of the result, and poses of other frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, ClassVar, Literal, Protocol

import numpy as np

from tofuse.engine.arrays import Bool, Float32, Float64, Intp
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.frames import Frame
from tofuse.engine.geometry import se3
from tofuse.engine.graph import Measured, PoseGraph, external_sensors
from tofuse.engine.parts import part
from tofuse.engine.refinement import calibration_check, fixed_pattern
from tofuse.engine.refinement.calibration_check import (
    CalibrationCheck,
    check_calibration,
    combine_checks,
)
from tofuse.engine.refinement.joint_alignment import (
    MAX_LOSS,
    Priors,
    Refined,
    RefinedViews,
    refine,
    support_fell,
)
from tofuse.engine.refinement.loop_drift import loop_gap
from tofuse.engine.refinement.range_change import RangeChange
from tofuse.engine.refinement.split_half import split_half_errors
from tofuse.engine.refinement.submaps import refine_submaps
from tofuse.engine.stored_views import (
    CoarseView,
    PosedView,
    SampledView,
    Spilled,
    SpilledCoarseView,
    ViewStore,
    pair_equations,
    sampled_points,
)
from tofuse.engine.stored_views import pair_equation_kernels as kernels
from tofuse.engine.views import PreparedView

CameraError = Literal["offset", "scale", "focal"]

# Neighbouring pixels have correlated noise: this many have the information of one.
_CORRELATED_PIXELS = 5.0
_ERROR_INDEX: dict[CameraError, int] = {
    "offset": kernels.OFFSET,
    "scale": kernels.SCALE,
    "focal": kernels.FOCAL,
}


# Errors of the camera, and (m, rad) of the poses by halves of the images.
# The check of the camera; errors by halves of the images (m, rad), and `Refinement.shared_rms`.
_Evaluation = tuple[CalibrationCheck, tuple[float, float, float]]
_Views = Sequence[PosedView[PreparedView]]


@dataclass(frozen=True, eq=False)
class Refinement:
    """Result of the refinement of a trajectory.

    Attributes
    ----------
    poses
        (N, 4, 4) T_world_camera; the first has not moved.
    kept
        Whether it is accepted: unless the views support each other less, but for chance.
    views, pairs
        Numbers of views and of pairs that were compared.
    moved_m, moved_rad
        Largest motions of a view.
    support
        Mean support of the views, up to 1, before and after: see `joint_alignment.Support`.
    errors
        Estimated errors of the camera by name: corrections of the range (m), of the depth
        (fraction) and of the width of the rays (fraction).
    edges
        Measurement of each pair alone, by frame indices; none unless kept.
    calibration_check
        Evidence for errors of the camera, if it was computed.
    non_overlap_edges
        Pairs (i, j) of edges that do not come from the overlap of the two views.
    split_m, split_rad
        Rms errors of the poses by halves of the images (`split_half`); 0 unless kept.
    shared_rms
        Rms depth error that patches of the images share, as far as it differs between them:
        relative to the depth, for a change of the viewpoint of 1 rad (`shared_error`); 0 unless
        kept.
    pattern
        Depth errors that are fixed to the camera, if there are any, and the poses are kept.
    """

    poses: Float64
    kept: bool = False
    views: int = 0
    pairs: int = 0
    moved_m: float = 0.0
    moved_rad: float = 0.0
    support: tuple[float, float] = (0.0, 0.0)
    errors: dict[str, float] = field(default_factory=dict)
    edges: tuple[Measured, ...] = ()
    calibration_check: CalibrationCheck | None = None
    non_overlap_edges: tuple[tuple[int, int], ...] = ()
    split_m: float = 0.0
    split_rad: float = 0.0
    shared_rms: float = 0.0
    pattern: fixed_pattern.FixedPattern = fixed_pattern.NONE

    @property
    def range_change(self) -> RangeChange | None:
        """Change of the camera's range, if the views show one."""
        return None if self.calibration_check is None else self.calibration_check.range_change

    def accepted(self, positions: Intp, after: Float64) -> Refinement:
        """Return the refinement that keeps the poses `after` of the frames at `positions`."""
        motion = se3.log(se3.inverse(self.poses[positions]) @ after)
        return replace(
            self,
            poses=propagate_poses(self.poses, positions, after),
            kept=True,
            moved_m=float(np.linalg.norm(motion[:, :3], axis=1).max()),
            moved_rad=float(np.linalg.norm(motion[:, 3:], axis=1).max()),
        )


class Refiner(Protocol):
    """State of a refinement of one recording.

    Attributes
    ----------
    needs_points
        Whether it needs the points of frames, not only prepared views.
    """

    needs_points: ClassVar[bool] = True

    def push(self, view: Frame, T_component_camera: Float64) -> None:
        """Add the next frame that has a pose, if `needs_points` is set."""
        return

    def finish(self, graph: PoseGraph, sensors: external_sensors.SensorPriors) -> Refinement:
        """Refine the poses of all frames of a graph, with measurements by external sensors."""
        ...


class RefinementMethod(Protocol):
    """A method that refines poses after loop closure."""

    part_kind: ClassVar[str] = "refinement"

    def start(self, views: ViewStore[PreparedView]) -> Refiner:
        """Begin a new recording; prepared views are added to `views` as they come."""
        ...


@part("refinement", "none")
@dataclass(frozen=True)
class NoRefinement(RefinementMethod, Refiner):
    """Leaves all poses as they are."""

    needs_points: ClassVar[bool] = False

    def start(self, views: ViewStore[PreparedView]) -> Refiner:
        """See `RefinementMethod.start`."""
        return self

    def finish(self, graph: PoseGraph, sensors: external_sensors.SensorPriors) -> Refinement:
        """See `Refiner.finish`."""
        return Refinement(graph.poses)


@dataclass(frozen=True, eq=False)
class AlreadyRefined(RefinementMethod, Refiner):
    """Keeps poses that were refined before, with the measurements of that refinement.

    Attributes
    ----------
    measured, non_overlap_edges
        By frame indices: measurements of pairs of views, and other edges.
    """

    needs_points: ClassVar[bool] = False
    measured: tuple[Measured, ...]
    non_overlap_edges: tuple[Measured, ...]

    def start(self, views: ViewStore[PreparedView]) -> Refiner:
        """See `RefinementMethod.start`."""
        return self

    def finish(self, graph: PoseGraph, sensors: external_sensors.SensorPriors) -> Refinement:
        """See `Refiner.finish`."""
        posed = set(graph.ids.tolist())
        edges = (*self.measured, *self.non_overlap_edges)
        return Refinement(
            graph.poses,
            kept=True,
            edges=tuple(e for e in edges if {e.i, e.j} <= posed),
            non_overlap_edges=tuple((e.i, e.j) for e in self.non_overlap_edges),
        )


@part("refinement", "joint")
@dataclass(frozen=True)
class Joint(Bounded, RefinementMethod):
    """Joint alignment of all overlapping views (eq 2.8), see `refine`.

    Views are spaced by the motion of the camera (`ViewStore`); frames in between follow them. The
    result is accepted only if the views support each other at least as well as before, and views
    that lose support keep their pose relative to their neighbours.

    Attributes
    ----------
    calibrate
        Errors of the camera to estimate as well: "offset", "scale", "focal".
    neighbours
        Maximum number of earlier views that each one is compared with; fewer for speed.
    submap
        Largest number of views that are refined together; more are divided, see `submaps`.
    color
        Whether motions that colour images measure at their full resolution are added, see `color`.
    """

    calibrate: tuple[CameraError, ...] = ()
    neighbours: Annotated[int, Bounds(1)] = 10
    submap: Annotated[int, Bounds(10, 100_000)] = 300
    color: bool = True

    @property
    def alignment(self) -> pair_equations.RefineOptions:
        """Options of the joint alignment."""
        return pair_equations.RefineOptions(neighbours=self.neighbours)

    def start(self, views: ViewStore[PreparedView]) -> Refiner:
        """See `RefinementMethod.start`."""
        return _Joint(self, views)


class _Joint(Refiner):
    needs_points: ClassVar[bool] = False

    def __init__(self, options: Joint, views: ViewStore[PreparedView]) -> None:
        self._options, self._store = options, views
        self._error_indices = [_ERROR_INDEX[name] for name in options.calibrate]

    def finish(self, graph: PoseGraph, sensors: external_sensors.SensorPriors) -> Refinement:
        """See `Refiner.finish`."""
        options, poses = self._options, graph.poses
        row = {int(index): k for k, index in enumerate(graph.ids)}
        posed = self._store.of(row)
        positions = np.array([row[p.index] for p in posed], np.intp)
        if len(posed) < 2:
            return Refinement(poses, views=len(posed))
        before = poses[positions]
        refine_views = self._at_once if len(posed) <= options.submap else self._in_submaps
        refined, evaluated, pattern = refine_views(posed, before, sensors)
        calibration = combine_checks([check for check, _ in evaluated])
        support = refined.before.of_views(len(posed)), refined.after.of_views(len(posed))
        mean = float(support[0].mean()), float(support[1].mean())
        unchanged = Refinement(poses, False, len(posed), len(refined.pairs), support=mean)
        gain = support[1] - support[0]
        if not len(refined.pairs):
            return unchanged
        if support_fell(gain):  # the camera may be the cause
            return replace(unchanged, calibration_check=calibration)
        after = with_unsupported_views_fixed(before, refined.poses, gain < -MAX_LOSS)
        split_m, split_rad, shared_rms = _mean_errors([errors for _, errors in evaluated])
        return replace(
            unchanged.accepted(positions, after),
            calibration_check=calibration,
            split_m=split_m,
            split_rad=split_rad,
            shared_rms=shared_rms,
            errors={name: float(refined.errors[_ERROR_INDEX[name]]) for name in options.calibrate},
            edges=pairwise_measurements([p.index for p in posed], refined),
            pattern=pattern,
        )

    def _at_once(
        self, posed: _Views, poses: Float64, sensors: external_sensors.SensorPriors
    ) -> tuple[Refined, list[_Evaluation], fixed_pattern.FixedPattern]:
        views = [self._sampled(p) for p in posed]
        priors = _priors([p.index for p in posed], sensors)
        alignment = self._options.alignment
        pattern = self._pattern(views, poses, priors)
        # In place: all views twice would be the most memory of a run.
        for k, view in enumerate(views):
            views[k] = pattern.corrected(view)
        refined = refine(views, poses, alignment, calibrate=self._error_indices, priors=priors)
        aligned = RefinedViews(views, refined, alignment, priors, self._error_indices)
        return refined, [self._evaluate(aligned)], pattern

    def _in_submaps(
        self, posed: _Views, poses: Float64, sensors: external_sensors.SensorPriors
    ) -> tuple[Refined, list[_Evaluation], fixed_pattern.FixedPattern]:
        ids, alignment = [p.index for p in posed], self._options.alignment
        some = fixed_pattern.runs(len(posed))
        sampled = [self._sampled(posed[k]) for k in some]
        priors = _priors([ids[k] for k in some], sensors)
        pattern = self._pattern(sampled, poses[some], priors, some)
        del sampled
        refined, evaluated = refine_submaps(
            [self._coarse(p) for p in posed],
            poses,
            alignment,
            self._options.submap,
            lambda subset: [pattern.corrected(self._sampled(posed[k])) for k in subset],
            lambda subset: _priors(ids if subset is None else [ids[k] for k in subset], sensors),
            self._evaluate,
            self._error_indices,
        )
        return refined, evaluated, pattern

    def _pattern(
        self,
        views: Sequence[SampledView],
        poses: Float64,
        priors: Priors,
        positions: Intp | None = None,
    ) -> fixed_pattern.FixedPattern:
        """Estimate the fixed pattern, unless the calibration is wrong, which is corrected first.

        Between two views a pattern may explain a wrong focal length better than any focal length
        does, as what tells these apart is the drift over many views. See `fixed_pattern.estimate`.
        """
        options = self._options.alignment
        found = fixed_pattern.estimate(views, poses, options, positions)
        if found.z is not None and calibration_check.is_wrong(views, poses, options, priors):
            return fixed_pattern.NONE
        return found

    def _evaluate(self, submap: RefinedViews) -> _Evaluation:
        """Evaluate a submap while its views are in memory."""
        errors = *split_half_errors(submap), float(np.sqrt(submap.refined.shared_growth))
        if not self._error_indices:
            return check_calibration(submap), errors
        gap = loop_gap(submap, submap.refined.poses, submap.refined.errors)
        return CalibrationCheck(gap=gap), errors

    def _coarse(self, posed: PosedView[PreparedView]) -> SpilledCoarseView:
        surface = _surface(posed)
        coarse = CoarseView.of(surface, sampled_points(surface, self._options.alignment.points))
        return SpilledCoarseView(coarse.centroid, Spilled(coarse, self._store.coarse))

    def _sampled(self, posed: PosedView[PreparedView]) -> SampledView:
        points = self._options.alignment.points
        return SampledView.of(_surface(posed), points, posed.recording)


def _mean_errors(errors: Sequence[tuple[float, float, float]]) -> list[float]:
    """Root mean squares of three errors; 0 without any."""
    squares = np.reshape(errors, (-1, 3)) ** 2
    return np.sqrt(squares.sum(0) / max(len(errors), 1)).tolist()


def _surface(posed: PosedView[PreparedView]) -> PreparedView:
    return posed.view.with_pixel_variance().without_caches()


def pairwise_measurements(ids: Sequence[int], refined: Refined) -> tuple[Measured, ...]:
    """Return the measurements of single pairs, with reduced information.

    All pairs of a view share its errors, so the information is divided by their number.

    Parameters
    ----------
    ids
        Frame indices of the views.
    refined
        Result of their joint alignment.
    """
    pairs = refined.pairs
    partners = np.bincount(pairs.ravel(), minlength=len(ids))
    divisors = _CORRELATED_PIXELS * 0.5 * partners[pairs].sum(1)
    return tuple(
        Measured(ids[i], ids[j], T, H / divisor)
        for (i, j), T, H, divisor in zip(
            pairs, refined.measured, refined.information, divisors, strict=True
        )
    )


def _priors(ids: Sequence[int], measured: external_sensors.SensorPriors) -> Priors:
    """Measurements of external sensors as priors on the views, scaled to the pixels' noise."""
    position = {index: k for k, index in enumerate(ids)}
    steps = measured.between(ids)
    m = len(steps)
    gravity = measured.gravity_of(ids)
    if gravity is not None:
        gravity = replace(
            gravity,
            sigma=gravity.sigma / np.sqrt(_CORRELATED_PIXELS),
            gate=gravity.gate * _CORRELATED_PIXELS,
        )
    return Priors(
        np.array([(position[s.i], position[s.j]) for s in steps], np.intp).reshape(m, 2),
        np.array([s.T_i_j for s in steps]).reshape(m, 4, 4),
        np.array([s.information * _CORRELATED_PIXELS for s in steps]).reshape(m, 6, 6),
        gravity,
        measured.witnessed(ids),
        measured.verified,
    )


def with_unsupported_views_fixed(before: Float64, after: Float64, lost: Bool) -> Float64:
    """Return the refined poses, with views that lost support fixed to their nearest neighbour.

    The first one stays.

    Parameters
    ----------
    before, after
        (N, 4, 4) poses before and after the refinement, in which the first one stays.
    lost
        (N,) mask of the views that lost support.
    """
    out = after.copy()
    supported = np.flatnonzero(~lost)
    for k in np.flatnonzero(lost) if len(supported) else ():
        nearest = supported[np.argmin(np.abs(supported - k))]
        out[k] = out[nearest] @ se3.inverse(before[nearest]) @ before[k]
    return before[0] @ se3.inverse(out[0]) @ out if lost[0] else out


def without_errors(points: Float32, errors: Mapping[str, float]) -> Float32:
    """Correct points for errors of the camera.

    Parameters
    ----------
    points
        (N, 3) m, in the camera's frame.
    errors
        As in `Refinement.errors`.
    """
    p = points.astype(np.float64)
    length = np.linalg.norm(p, axis=1, keepdims=True)
    corrected = p * (
        1 + errors.get("offset", 0.0) / np.maximum(length, 1e-9) + errors.get("scale", 0.0)
    )
    corrected[:, :2] += errors.get("focal", 0.0) * p[:, :2]
    return corrected.astype(np.float32)


def propagate_poses(poses: Float64, positions: Intp, after: Float64) -> Float64:
    """Propagate refined poses to all frames.

    Each frame keeps its motion relative to the views before and after it, interpolated between the
    two by its position between them.

    Parameters
    ----------
    poses
        (N, 4, 4) of all frames, before.
    positions
        (M,) ascending positions of the refined poses.
    after
        (M, 4, 4) refined poses.
    """
    frames = np.arange(len(poses))
    following = np.clip(np.searchsorted(positions, frames), 0, len(positions) - 1)
    preceding = np.clip(np.searchsorted(positions, frames, side="right") - 1, 0, len(positions) - 1)
    relative = [after[k] @ se3.inverse(poses[positions[k]]) @ poses for k in (preceding, following)]
    gap = positions[following] - positions[preceding]
    fraction = np.where(gap > 0, (frames - positions[preceding]) / np.maximum(gap, 1), 0.0)
    return se3.interpolate(relative[0], relative[1], fraction)
