"""Pose hypotheses: alignments with the last keyframe and the last frame, the likeliest first.

They start from the state of the tracker between two frames.
"""

from __future__ import annotations

import weakref
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from tofuse.engine.alignment import projective
from tofuse.engine.arrays import Float64
from tofuse.engine.geometry import se3
from tofuse.engine.search import verification
from tofuse.engine.tracking.base import Guess
from tofuse.engine.tracking.keyframe_map import Keyframe, KeyframeMap, Relocalizer
from tofuse.engine.tracking.motion import FrameTime, MotionModel
from tofuse.engine.tracking.moving_objects import (
    MIN_MOVING_FRACTION,
    Moving,
    MovingObjects,
    without_pixels,
)
from tofuse.engine.tracking.rival_motions import (
    STANDS,
    STOOD,
    Rival,
    RivalMotions,
    likelihood_ratios,
)
from tofuse.engine.views import PreparedView

# Minimum score of a rotated start relative to the unrotated one: a flat wall fits under any.
_MIN_ROTATED_SCORE_RATIO = 1.03
# A nearly aligned view needs a few more iterations, at the resolution of tracking.
_CONVERGENCE_LEVELS = (projective.Level(4, 8, 0.005, 0.02), projective.Level(2, 8, 0.0, 0.0))
# A view that is compared with a reference where it is.
_NO_STEPS = (projective.Level(2, 1, 0.0, 0.0),)
_MISFIT = verification.FitQuality("conflicting")
_BACKGROUND = 0.9  # quantile of the depths that the farther surfaces of a view have
# Between frames that are farther apart, a camera neither stands still nor goes on as before.
_MAX_STEP_RAD = 0.2
# Every n-th frame is segmented, and any with an indication of moving objects: an unusual fit, more
# than this fraction of points in free space, or objects in the frame before.
_SEGMENT_EVERY, _MAX_IN_FRONT = 4, 0.005


@dataclass(eq=False)
class TrackerState:
    """What the tracker knows of the frames so far.

    `Hypotheses` and `Selection` read it for one frame; `KeyframeTracker` updates it.

    Attributes
    ----------
    keyframes
        Those of all components.
    relocalizer
        Searches for poses, and their budget.
    fit_statistics
        Usual fit of views of this camera.
    is_static
        Whether nothing moves for certain.
    motion
        Velocity of the camera.
    objects
        Moving objects in the last view and in the keyframes.
    rivals
        Motions that would explain the last views as well.
    last
        The last frame of the component; None after an interruption.
    in_sequence
        Whether the frame just before has a pose in the component.
    component
        Number of the component; -1 before the first.
    connected
        Whether a certain link joins the component to an earlier one.
    degenerate
        Number of degenerate directions of the last selected alignment.
    """

    keyframes: KeyframeMap
    relocalizer: Relocalizer
    fit_statistics: verification.FitStatistics
    is_static: bool = False
    motion: MotionModel = field(default_factory=MotionModel)
    objects: MovingObjects = field(default_factory=MovingObjects)
    rivals: RivalMotions = field(default_factory=RivalMotions)
    last: Keyframe | None = None
    in_sequence: bool = False
    component: int = -1
    connected: bool = True
    degenerate: int = 0


@dataclass(frozen=True, eq=False)
class Reference:
    """A keyframe, and its view without moved objects as the target of alignments."""

    keyframe: Keyframe
    target: projective.Target


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """An alignment of the view with a keyframe, and its comparison with usual alignments.

    Attributes
    ----------
    view
        The view as it was aligned: without moving objects.
    predicted
        Whether it started at the predicted pose.
    note
        Unusual origin of the alignment, in words; may be empty.
    fit
        Comparison with usual alignments.
    by_odometry
        Whether the pose is that of external odometry, and not aligned.
    """

    aligned: projective.Aligned
    view: PreparedView
    reference: Reference
    predicted: bool
    note: str
    fit: verification.FitQuality
    by_odometry: bool = False

    @property
    def keyframe(self) -> Keyframe:
        """The keyframe that the view was aligned with."""
        return self.reference.keyframe

    @property
    def T_component_camera(self) -> Float64:
        """(4, 4) pose of the view."""
        return self.aligned.T_world_source

    @property
    def T_keyframe_camera(self) -> Float64:
        """(4, 4) pose of the view in the frame of the keyframe."""
        T = se3.inverse(self.keyframe.T_component_camera) @ self.T_component_camera
        return np.asarray(T, np.float64)


class Hypotheses:
    """The hypotheses of one view, with and without moving objects, evaluated lazily and cached.

    Parameters
    ----------
    view, now
        The view, and when it was taken.
    state
        Of the tracker; only `segment` changes it.
    guess
        Where alignments start, see `Keyframes`.
    options
        How views are aligned.

    Attributes
    ----------
    static_view
        The view without the objects that moved before.
    references
        To align with, the likeliest first.
    T_predicted
        (4, 4) predicted pose; None without a prediction.
    T_last
        (4, 4) pose of the last frame.
    """

    def __init__(
        self,
        view: PreparedView,
        now: FrameTime,
        state: TrackerState,
        guess: Guess,
        options: projective.ProjectiveOptions,
    ) -> None:
        self.view, self.now, self.state = view, now, state
        self._options = options
        self.T_last = np.eye(4) if state.last is None else state.last.T_component_camera
        self.references = self._make_references()
        # The pose that degenerate directions keep.
        self._T_smoothed: Float64 | None = None
        self.T_predicted: Float64 | None = None
        if guess == "previous":
            self.T_predicted = state.motion.predicted_pose(now)
            self._T_smoothed = state.motion.smoothed_pose(now)
        elif guess == "odometry":
            self.T_predicted = state.motion.odometry_pose()
        self.static_view = view
        if state.objects.in_last_view:
            T = self.T_last if self.T_predicted is None else self.T_predicted
            self.static_view = without_pixels(view, state.objects.predicted_mask(T, view))
        # By a weak reference: in a cycle, the views of many frames would wait for the collector.
        self._pending = Hypotheses._generate(weakref.proxy(self))
        self._evaluated: list[Hypothesis] = []
        self._static: dict[Hypothesis, tuple[Hypothesis, ...]] = {}

    def __iter__(self) -> Iterator[Hypothesis]:
        yield from self._evaluated
        for hypothesis in self._pending:
            self._evaluated.append(hypothesis)
            yield hypothesis

    @property
    def first_rejection(self) -> str:
        """The reason why the likeliest hypothesis was rejected, in words."""
        for hypothesis in self._evaluated:
            if hypothesis.fit.reason:
                return hypothesis.fit.reason
        return "it is far from the predicted pose" if self._evaluated else ""

    def realigned(
        self, T: Float64, view: PreparedView, reference: Reference, *, predicted: bool
    ) -> Hypothesis:
        """Realign from a pose T (4, 4), with other pixels of the view or the reference."""
        aligned = self._align(view, reference, T, self._options)
        return self._hypothesis(aligned, view, reference, "", predicted=predicted)

    def by_odometry(self) -> Hypothesis | None:
        """Return the pose by trusted external odometry, of which the view constrains nothing."""
        T = self.state.motion.trusted_odometry_pose(self.now)
        if T is None or not self.references:
            return None
        reference = self.references[0]
        unaligned = self._align(self.view, reference, T, replace(self._options, levels=_NO_STEPS))
        aligned = replace(unaligned, T_world_source=T, unobservable=np.eye(6))
        note = f"by odometry: {self.first_rejection}"
        return Hypothesis(aligned, self.view, reference, True, note, _MISFIT, True)

    def converged(self, hypothesis: Hypothesis) -> Hypothesis:
        """Iterate a hypothesis to convergence, for which the default levels may not suffice."""
        if hypothesis.aligned.converged:
            return hypothesis
        view, r, T = hypothesis.view, hypothesis.reference, hypothesis.T_component_camera
        prior = T if self._T_smoothed is None or not hypothesis.predicted else self._T_smoothed
        options = replace(self._options, levels=_CONVERGENCE_LEVELS)
        aligned = self._align(view, r, prior, options, start=T)
        refined = self._hypothesis(
            aligned, view, r, hypothesis.note, predicted=hypothesis.predicted
        )
        return refined if aligned.score >= hypothesis.aligned.score else hypothesis

    def static(self, hypothesis: Hypothesis) -> tuple[Hypothesis, ...]:
        """Return the same alignment without moving objects, if its pose is that of the camera.

        A moving object may fill so much of the view that the alignment follows it: then the
        predicted pose is the better start. Where objects begin to move, the camera itself may have
        jumped instead; so a search must not confirm that.
        """
        if self.state.is_static:
            return ()
        if hypothesis not in self._static:
            poses = [hypothesis.T_component_camera]
            if hypothesis.predicted and self.T_predicted is not None:
                poses.insert(0, self.T_predicted)
            self._static[hypothesis] = tuple(self._generate_static(hypothesis, poses))
        return self._static[hypothesis]

    def segment(self, hypothesis: Hypothesis) -> tuple[Hypothesis, Moving | None]:
        """Segment moving objects where there may be any, and realign the rest of the view.

        Returns
        -------
        The accepted hypothesis, realigned if enough moves; and the segmentation, if any.
        """
        if self.state.is_static:
            return hypothesis, None
        view, aligned, objects = self.view, hypothesis.aligned, self.state.objects
        suspected = hypothesis.view is not self.static_view
        is_due = (
            objects.in_last_view
            or suspected
            or not hypothesis.fit.is_usual
            or aligned.in_front > _MAX_IN_FRONT * aligned.compared
            or view.index % _SEGMENT_EVERY == 0
        )
        if not is_due:
            return hypothesis, None
        keyframe, T = hypothesis.keyframe, hypothesis.T_component_camera
        moving = self._moving_wholly(T, keyframe, suspected=suspected)
        excluded = np.count_nonzero(view.planes[..., 3]) - np.count_nonzero(
            hypothesis.view.planes[..., 3]
        )
        if moving.reliable and moving.fraction - excluded / view.pixels > MIN_MOVING_FRACTION:
            static = self._without_moving(moving, T, keyframe, predicted=hypothesis.predicted)
            if static.fit.is_usual or not hypothesis.fit.is_usual:
                hypothesis = static
                T = static.T_component_camera
                moving = self._moving_wholly(T, keyframe, suspected=suspected)
        objects.update(moving)
        return hypothesis, moving

    def with_rival(
        self, accepted: Hypothesis, moving: Moving | None
    ) -> tuple[Hypothesis, Moving | None, float]:
        """Compare the accepted motion with its rivals, and adopt the one that most surface follows.

        Returns
        -------
        The hypothesis and its segmentation, and the share of the view that follows another motion.
        """
        keyframe, state = accepted.keyframe, self.state
        if state.is_static:
            return accepted, moving, 0.0
        if state.last is not None:
            step = se3.inverse(state.last.T_component_camera) @ accepted.T_component_camera
            if float(se3.angle(step)) > _MAX_STEP_RAD:
                return accepted, moving, 0.0
        rivals = {STANDS: Rival(keyframe, keyframe.T_component_camera)}
        stood = state.rivals.stood_since
        if stood is not None and stood.view.index != keyframe.view.index:
            rivals[STOOD] = Rival(stood, stood.T_component_camera)
        if self.T_predicted is not None:
            rivals["goes on"] = Rival(keyframe, self.T_predicted)
        scale = state.objects.typical_scale
        share, winner, rest = state.rivals.compare(
            self.view, accepted.T_component_camera, rivals, scale
        )
        if not winner:
            return accepted, moving, share
        keyframe, T = rivals[winner]
        to_keyframe = se3.inverse(keyframe.T_component_camera)
        ratios = likelihood_ratios(
            self.view,
            keyframe.view,
            to_keyframe @ accepted.T_component_camera,
            to_keyframe @ T,
            scale,
        )
        with_objects = self._moving(T, keyframe, suspected=True)
        with_objects = state.objects.with_cells(with_objects, ~(ratios >= 0))
        static = self._without_moving(with_objects, T, keyframe, predicted=accepted.predicted)
        if not with_objects.reliable or not static.fit.is_usual:
            return accepted, moving, share
        state.keyframes.remove_after(keyframe)  # they followed what moves
        state.objects.update(with_objects)
        state.rivals.reset(keyframe if winner in (STANDS, STOOD) else None)
        state.motion.rest_at(static.T_component_camera, self.now)
        return static, with_objects, rest

    def _make_references(self) -> list[Reference]:
        """Return the newest keyframe and the last frame, without moved objects."""
        last = self.state.last
        if last is None:
            return []
        keyframes = [self.state.keyframes.newest]
        if last.view.index != keyframes[0].view.index:
            keyframes.append(last)
        references = []
        for keyframe in keyframes:
            if not _comparable(self.view, keyframe.view):
                continue
            target, mask = keyframe.target, self.state.objects.reference_mask(keyframe.view)
            if mask.any():
                view = without_pixels(keyframe.view, mask)
                target = projective.Target(view, se3.inverse(keyframe.T_component_camera))
            references.append(Reference(keyframe, target))
        return references

    def _generate(self) -> Iterator[Hypothesis]:
        T_predicted, view = self.T_predicted, self.static_view
        if T_predicted is not None:
            prior = T_predicted if self._T_smoothed is None else self._T_smoothed
            for r in self.references:
                aligned = self._align(view, r, prior, self._options, start=T_predicted)
                yield self._hypothesis(aligned, view, r, "", predicted=True)
        reason = "no prediction" if T_predicted is None else "the prediction did not fit"
        for r in self.references:
            aligned, start = self._from_best_rotation(r)
            yield self._hypothesis(
                aligned, view, r, f"{reason}: aligned from {start}", predicted=False
            )

    def _generate_static(
        self, hypothesis: Hypothesis, poses: list[Float64]
    ) -> Iterator[Hypothesis]:
        """Realign from poses (4, 4), without the objects that move if the camera is there."""
        keyframe = hypothesis.keyframe
        for T in poses:
            moving = self._moving(T, keyframe, suspected=True)
            if not moving.reliable or moving.fraction <= MIN_MOVING_FRACTION:
                continue
            static = self._without_moving(moving, T, keyframe, predicted=hypothesis.predicted)
            if self.state.objects.in_last_view:
                yield static
                continue
            T_static = static.T_keyframe_camera
            if self.state.relocalizer.confirms(self.view, keyframe, T_static) is not False:
                yield static

    def _moving(self, T: Float64, keyframe: Keyframe, *, suspected: bool) -> Moving:
        """Segment the objects that move relative to a keyframe if the pose is T (4, 4)."""
        return self.state.objects.compare(
            self.view, T, keyframe.view, keyframe.T_component_camera, suspected=suspected
        )

    def _moving_wholly(self, T: Float64, keyframe: Keyframe, *, suspected: bool) -> Moving:
        """Segment objects by a keyframe; if any move, by the newest one without any as well.

        What comes into view behind the front of an object, as a body behind an arm, is in free
        space of that one alone.
        """
        objects = self.state.objects
        moving = self._moving(T, keyframe, suspected=suspected)
        if not moving.reliable or moving.fraction <= MIN_MOVING_FRACTION:
            return moving
        still = self.state.keyframes.newest_of(self.state.component, objects.none_in)
        if still is None or still.view.index == keyframe.view.index:
            return moving
        since_then = self._moving(T, still, suspected=suspected)
        if not since_then.explains_disagreement:
            return moving
        return objects.with_cells(moving, since_then.pair_update.last.cells.moving)

    def _without_moving(
        self, moving: Moving, T: Float64, keyframe: Keyframe, *, predicted: bool
    ) -> Hypothesis:
        """Realign the view from T (4, 4) with a keyframe, without moving objects."""
        target = projective.Target(
            moving.applied_to_reference(keyframe.view), se3.inverse(keyframe.T_component_camera)
        )
        view = moving.applied(self.view)
        return self.realigned(T, view, Reference(keyframe, target), predicted=predicted)

    def _hypothesis(
        self,
        aligned: projective.Aligned,
        view: PreparedView,
        reference: Reference,
        note: str,
        *,
        predicted: bool,
    ) -> Hypothesis:
        fit = self.state.fit_statistics.assess(aligned)
        return Hypothesis(aligned, view, reference, predicted, note, fit)

    def _from_best_rotation(self, reference: Reference) -> tuple[projective.Aligned, str]:
        """Align from the last pose, or its rotation that fits best; and name the start."""
        view = self.static_view
        coarse = replace(self._options, levels=verification.PATIENT[:1])
        motions = _rotation_candidates(view)
        unrotated, *rotated = [
            self._align(view, reference, self.T_last @ motion, coarse) for motion in motions
        ]
        best = max(range(len(rotated)), key=lambda k: rotated[k].score)
        rotates = rotated[best].score > _MIN_ROTATED_SCORE_RATIO * unrotated.score
        best_aligned, name = (
            (rotated[best], "a rotation") if rotates else (unrotated, "the last pose")
        )
        if rotates:
            name += f" by {np.degrees(se3.angle(motions[1 + best])):.0f} degrees"
        # Without a prediction, weakly constrained directions follow the data.
        options = replace(
            self._options, levels=verification.PATIENT, common_tilt=0.0, common_slope=0.0
        )
        prior = best_aligned.T_world_source if rotates else self.T_last
        start = best_aligned.T_world_source
        return self._align(view, reference, prior, options, start=start), name

    def _align(
        self,
        view: PreparedView,
        reference: Reference,
        T: Float64,
        options: projective.ProjectiveOptions,
        *,
        start: Float64 | None = None,
    ) -> projective.Aligned:
        scale = self.state.fit_statistics.noise_scale
        return projective.align(
            view, [reference.target], T, options, start=start, usual_scale=scale
        )


def _comparable(view: PreparedView, other: PreparedView) -> bool:
    """Whether views can show the same scene, be it behind something near that fills one of them."""
    return verification.comparable(view.depth, other.depth) or verification.comparable(
        _background_depth(view), _background_depth(other)
    )


def _background_depth(view: PreparedView) -> float:
    valid = view.z[view.z > 0]
    return float(np.quantile(valid, _BACKGROUND)) if len(valid) else 1.0


def _rotation_candidates(view: PreparedView) -> list[Float64]:
    """Return motions (4, 4) to try: none, and rotations about the camera and the scene."""
    centre = (0.0, 0.0, view.depth)
    motions = [np.eye(4)]
    for angle in np.radians([-12, -6, 6, 12]):
        for axis in (3, 4):
            twist = np.zeros(6)
            twist[axis] = angle
            rotation = se3.exp(twist)
            motions += [rotation, se3.about(centre, rotation)]
    return motions
