"""The keyframe tracker: predict, align, select a hypothesis, continue or begin a component."""

from __future__ import annotations

import numpy as np

from tofuse.arrays import Float64
from tofuse.errors import InputError
from tofuse.odometry.base import Status, Step, Tracker
from tofuse.odometry.hypotheses import Hypotheses, Hypothesis
from tofuse.odometry.keyframe_map import Keyframe, KeyframeMap
from tofuse.odometry.keyframes import Keyframes
from tofuse.odometry.motion import Moment, MotionModel
from tofuse.odometry.motion_segmentation import MIN_MOVING_FRACTION, MotionSegmentation
from tofuse.odometry.moving_objects import at_size
from tofuse.odometry.relocalization import Relocalizer
from tofuse.odometry.selection import HypothesisSelector
from tofuse.recordings.frames import Frame, RangeFrame
from tofuse.registration.base import Link, Registration
from tofuse.registration.prepared_view import PreparedView, prepare_view
from tofuse.registration.projective import registration_of
from tofuse.registration.search import SearchOptions
from tofuse.registration.uncertainty import covariance
from tofuse.registration.verification import FitStatistics, comparable


class KeyframeTracker(Tracker):
    """See `Keyframes`."""

    def __init__(self, options: Keyframes, search: SearchOptions) -> None:
        self._options = options
        self._keyframes = KeyframeMap(options.keyframe_angle, options.keyframe_distance)
        self._fit_statistics = FitStatistics()
        self._relocalizer = Relocalizer(search if options.searches else None, self._fit_statistics)
        self._motion = MotionModel()
        self._segmentation = MotionSegmentation(self._relocalizer)
        self._selector = HypothesisSelector(
            self._fit_statistics, self._motion, self._segmentation, self._relocalizer
        )
        self._component = -1
        self._connected = True  # whether a certain link joins the component to an earlier one
        self._last: Keyframe | None = None  # the last frame of the component
        self._in_sequence = False  # whether the frame just before has a pose in the component

    def prepare(self, frame: Frame) -> PreparedView | None:
        """See `Tracker.prepare`."""
        if not isinstance(frame, RangeFrame) or self._problem_of(frame):
            return None
        return prepare_view(frame, self._options.views.surface)

    def push(
        self, frame: Frame, T_odometry: Float64 | None = None, surface: PreparedView | None = None
    ) -> Step:
        """See `Tracker.push`."""
        if not isinstance(frame, RangeFrame):
            raise InputError("is a cloud; this tracker needs images", where=f"frame {frame.index}")
        self._relocalizer.count_frame()
        problem = self._problem_of(frame) if surface is None else ""
        if problem:
            return self._lose(problem)
        view = prepare_view(frame, self._options.views.surface) if surface is None else surface
        if np.count_nonzero(view.planes[..., 3] > 0) < self._options.minimum_points:
            return self._lose("too few pixels have a surface")
        now = Moment(frame.index, frame.timestamp)
        self._motion.set_odometry(T_odometry)
        hypotheses = self._hypotheses(view, now)
        selected = self._selector.best(hypotheses, now, in_sequence=self._in_sequence)
        if selected is None:
            step = self._begin_component(view, hypotheses)
        else:
            step = self._continue_component(frame, selected, hypotheses)
        self._update(view, step, now)
        return step

    def _lose(self, reason: str) -> Step:
        self._in_sequence = False
        return Step("lost", reason, None)

    def _update(self, view: PreparedView, step: Step, now: Moment) -> None:
        T = step.T_component_camera
        assert T is not None
        self._last = Keyframe(view, T, self._component, step.doubtful)
        degenerate = step.registration is not None and len(step.registration.unobservable) > 0
        self._motion.update(T, now, degenerate=degenerate)
        self._in_sequence = True

    def predicted_pose(self, now: Moment) -> Float64 | None:
        """See `Tracker.predicted_pose`."""
        return self._motion.predicted_pose(now)

    def interrupt(self) -> None:
        """See `Tracker.interrupt`."""
        self._motion.interrupt()
        self._last, self._in_sequence = None, False

    def _problem_of(self, frame: RangeFrame) -> str:
        """Return why a frame can't be tracked; empty if it can."""
        min_points = self._options.minimum_points
        if len(frame) < min_points:
            return f"{len(frame)} valid points, {min_points} are needed"
        first_depth = frame.depth.flat[np.argmax(frame.valid)]
        # A subset of the pixels is nearly always enough.
        for subset in (np.s_[::8, ::8], np.s_[:, :]):
            if np.any((frame.depth[subset] != first_depth) & frame.valid[subset]):
                return ""
        return f"every depth is {first_depth:.3g} m"

    def _hypotheses(self, view: PreparedView, now: Moment) -> Hypotheses:
        """Return alignments with the last keyframe and the last frame, from the predicted pose."""
        last, guess = self._last, self._options.guess
        T_last = np.eye(4) if last is None else last.T_component_camera
        references = []
        if last is not None:
            keyframes = [self._keyframes.newest]
            if last.view.index != keyframes[0].view.index:
                keyframes.append(last)
            references = [
                self._segmentation.reference(k)
                for k in keyframes
                if comparable(view.depth, k.depth)
            ]
        T_predicted = T_smoothed = None
        if guess == "previous":
            T_predicted, T_smoothed = (
                self._motion.predicted_pose(now),
                self._motion.smoothed_pose(now),
            )
        elif guess == "odometry":
            T_predicted = self._motion.odometry_pose()
        static = self._segmentation.static_part(
            view, T_last if T_predicted is None else T_predicted
        )
        return Hypotheses(
            view,
            static,
            references,
            T_predicted,
            T_smoothed,
            T_last,
            self._options.views.alignment,
            self._fit_statistics,
        )

    def _begin_component(self, view: PreparedView, hypotheses: Hypotheses) -> Step:
        """Begin a component with an unconnected view, and search for links to the others."""
        self._component += 1
        last = None if self._last is None else self._last.view.index
        adjacent = last if self._in_sequence else None
        links = self._relocalizer.links(view, self._keyframes, self._component, adjacent)
        self._connected = any(link.certain for link in links)
        self._keyframes.add(Keyframe(view, np.eye(4), self._component))
        if self._in_sequence:  # the camera still moves at the same velocity
            self._motion.change_frame()
        else:
            self._motion.interrupt()
        self._segmentation.reset()
        reason = ""
        if self._component:
            rejection = hypotheses.first_rejection or "nothing comparable was seen before"
            reason = f"begins component {self._component}: {rejection}"
            if links:
                reason += f"; {links[-1].how} in frame {links[-1].i}"
        return Step(
            "tracked", reason, np.eye(4), surface=view, component=self._component, links=links
        )

    def _continue_component(
        self, frame: RangeFrame, selected: Hypothesis, hypotheses: Hypotheses
    ) -> Step:
        """Refine the selected hypothesis without moving objects, and take its pose."""
        view = hypotheses.full_view
        accepted, moving = self._segmentation.segment(hypotheses.converged(selected), hypotheses)
        self._fit_statistics.learn(accepted.aligned, view.depth)
        links = self._insert_keyframe(view, accepted)
        status, reason = _status_of(accepted, frame)
        mask = None
        if moving is not None and moving.fraction > MIN_MOVING_FRACTION:
            mask = at_size(moving.view, frame)
            view = moving.applied(view)
        return Step(
            status,
            reason,
            accepted.T_component_camera,
            accepted.keyframe.view.index,
            self._registration(accepted),
            view,
            self._component,
            links,
            doubtful=not accepted.assessment.is_usual,
            inflation=_inflation(accepted),
            moving=mask,
        )

    def _insert_keyframe(self, view: PreparedView, accepted: Hypothesis) -> tuple[Link, ...]:
        """Make a view a keyframe if it is due, and search for links while unconnected.

        It is due far from the last keyframe, or where it fits the last frame only; unless the view
        itself is doubtful.
        """
        T, keyframe = accepted.T_component_camera, accepted.keyframe
        doubtful = not accepted.assessment.is_usual
        replaces = keyframe is self._last and not doubtful
        if not (replaces or self._keyframes.is_far(T, keyframe)):
            return ()
        links: tuple[Link, ...] = ()
        if not self._connected:
            links = self._relocalizer.links(view, self._keyframes, self._component)
            self._connected = any(link.certain for link in links)
        self._keyframes.add(Keyframe(view, T, self._component, doubtful))
        return links

    def _registration(self, accepted: Hypothesis) -> Registration:
        aligned, targets = accepted.aligned, [accepted.reference.target]
        C = covariance(accepted.view, targets, aligned, self._options.views.alignment)
        return registration_of(aligned, accepted.T_keyframe_camera, C * _inflation(accepted) ** 2)


def _inflation(accepted: Hypothesis) -> float:
    """Factor of the standard deviations: odds twice as high as usual double them."""
    return float(np.exp(min(accepted.assessment.excess, 5.0)))


def _status_of(accepted: Hypothesis, frame: RangeFrame) -> tuple[Status, str]:
    """Return the status of a frame with a pose, and anything unusual in tracking it."""
    notes = [accepted.note, accepted.assessment.reason]
    if frame.amplitude_image is not None and not accepted.aligned.photometric:
        notes.append("the albedo took no part")
    status: Status = "tracked"
    if len(accepted.aligned.unobservable) == 6:
        status = "predicted"
        notes.insert(0, "all directions are degenerate")
    return status, "; ".join(filter(None, notes))
