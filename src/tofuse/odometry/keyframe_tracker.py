"""The keyframe tracker at work: continue the component, or begin a new one."""

from __future__ import annotations

from typing import Literal

import numpy as np

from tofuse.arrays import Float64
from tofuse.errors import InputError
from tofuse.geometry import se3
from tofuse.odometry.attempts import Attempt, Attempts
from tofuse.odometry.base import Step, Tracker
from tofuse.odometry.keyframe_map import Keyframe, KeyframeMap
from tofuse.odometry.keyframes import Keyframes
from tofuse.odometry.motion import Moment, Motion
from tofuse.odometry.moving import at_size
from tofuse.odometry.relocalization import Relocalizer
from tofuse.odometry.rivals import Rivals
from tofuse.odometry.segmentation import NOTICED, Segmentation
from tofuse.recordings.frames import Frame, RangeFrame
from tofuse.registration.base import Link, Registration
from tofuse.registration.prepared_view import PreparedView, prepare_view
from tofuse.registration.projective import registration_of
from tofuse.registration.uncertainty import covariance
from tofuse.registration.verification import UsualFit, comparable


class KeyframeTracker(Tracker):
    """See `Keyframes`."""

    def __init__(self, options: Keyframes) -> None:
        self._options = options
        self._keyframes = KeyframeMap(options.keyframe_angle, options.keyframe_distance)
        self._usual = UsualFit(options.unusual)
        search = options.search if options.searches else None
        self._relocalizer = Relocalizer(search, self._usual)
        self._motion = Motion()
        self._segmentation = Segmentation(self._relocalizer)
        self._rivals = Rivals(self._usual, self._motion, self._segmentation, self._relocalizer)
        self._component = -1
        self._connected = True  # whether a certain link joins the component to an earlier one
        self._last: Keyframe | None = None  # the last frame of the component
        self._T_odometry: Float64 | None = None
        self._in_sequence = False  # whether the frame just before has a pose in the component

    def prepare(self, frame: Frame) -> PreparedView | None:
        """See `Tracker.prepare`."""
        if not isinstance(frame, RangeFrame) or self._unfit(frame):
            return None
        return prepare_view(frame, self._options.surface)

    def push(
        self, frame: Frame, T_odometry: Float64 | None = None, surface: PreparedView | None = None
    ) -> Step:
        """See `Tracker.push`."""
        if not isinstance(frame, RangeFrame):
            raise InputError("is a cloud; this tracker needs images", where=f"frame {frame.index}")
        self._relocalizer.count_frame()
        if surface is None and (reason := self._unfit(frame)):
            return self._lose(reason)
        view = prepare_view(frame, self._options.surface) if surface is None else surface
        if np.count_nonzero(view.planes[..., 3] > 0) < self._options.minimum_points:
            return self._lose("too few pixels have a surface")
        now = Moment(frame.index, frame.timestamp)
        self._motion.sense(T_odometry)
        attempts = self._attempts(view, now, T_odometry)
        found = self._rivals.best(attempts, now, in_sequence=self._in_sequence)
        if found is None:
            step = self._begin_component(view, attempts)
        else:
            step = self._continue_component(frame, found, attempts)
        assert step.T_component_camera is not None
        self._last = Keyframe(view, step.T_component_camera, self._component, step.doubtful)
        self._motion.follow(step.T_component_camera, now)
        self._T_odometry = T_odometry
        self._in_sequence = True
        return step

    def _lose(self, reason: str) -> Step:
        self._in_sequence = False
        return Step("lost", reason, None)

    def expected(self, now: Moment) -> Float64 | None:
        """See `Tracker.expected`."""
        return self._motion.expected(now)

    def interrupt(self) -> None:
        """See `Tracker.interrupt`."""
        self._motion.interrupt()
        self._last, self._in_sequence = None, False

    def _unfit(self, frame: RangeFrame) -> str:
        """Why nothing can be made of a frame; empty if something can."""
        least = self._options.minimum_points
        if len(frame) < least:
            return f"{len(frame)} valid points, {least} are needed"
        first = frame.depth.flat[np.argmax(frame.valid)]
        # Some of the pixels are nearly always enough.
        for some in (np.s_[::8, ::8], np.s_[:, :]):
            if np.any((frame.depth[some] != first) & frame.valid[some]):
                return ""
        return f"every depth is {first:.3g} m"

    def _attempts(self, view: PreparedView, now: Moment, T_odometry: Float64 | None) -> Attempts:
        """Alignments with the last keyframe and the last frame."""
        last, options = self._last, self._options
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
        expected = None if last is None else self._predicted(last, now, T_odometry)
        steady = self._motion.steadily(now) if options.guess == "previous" else None
        rest = self._segmentation.rest_of(view, T_last if expected is None else expected)
        if options.guess == "identity":
            expected = None
        return Attempts(
            view, rest, references, expected, steady, T_last, options.alignment, self._usual
        )

    def _predicted(self, last: Keyframe, now: Moment, T_odometry: Float64 | None) -> Float64 | None:
        """Where the guess puts the camera; None where it says nothing."""
        if self._options.guess == "previous":
            return self._motion.expected(now)
        if self._options.guess == "identity":
            return last.T_component_camera
        before = self._T_odometry
        if T_odometry is None or before is None:
            return None
        return np.asarray(last.T_component_camera @ se3.inverse(before) @ T_odometry, np.float64)

    def _begin_component(self, view: PreparedView, attempts: Attempts) -> Step:
        """Start anew with a view that can't be connected, and look for where it may belong."""
        self._component += 1
        last = None if self._last is None else self._last.view.index
        adjacent = last if self._in_sequence else None
        links = self._relocalizer.links(view, self._keyframes, self._component, adjacent)
        self._connected = any(link.certain for link in links)
        self._keyframes.add(Keyframe(view, np.eye(4), self._component))
        if self._in_sequence:  # the camera still moves as it did
            self._motion.restart()
        else:
            self._motion.interrupt()
        self._segmentation.reset()
        reason = ""
        if self._component:
            why = attempts.objection or "nothing comparable was seen before"
            reason = f"begins component {self._component}: {why}"
            if links:
                reason += f"; {links[-1].how} in frame {links[-1].i}"
        return Step(
            "tracked", reason, np.eye(4), surface=view, component=self._component, links=links
        )

    def _continue_component(self, frame: RangeFrame, found: Attempt, attempts: Attempts) -> Step:
        view = attempts.whole
        found, moving = self._segmentation.follow(attempts.converged(found), attempts)
        aligned, keyframe, T = found.aligned, found.keyframe, found.T_component_camera
        self._usual.learn(aligned, view.depth)
        notes = [found.how, found.assessment.reason]
        if frame.amplitude_image is not None and not aligned.photometric:
            notes.append("the albedo took no part")
        status: Literal["tracked", "predicted"] = "tracked"
        if len(aligned.unobservable) == 6:
            status = "predicted"
            notes.insert(0, "all directions are degenerate")
        links: tuple[Link, ...] = ()
        doubtful = not found.assessment.usual
        # Where the last keyframe fits no longer, this one takes over; unless it is at fault itself.
        if (keyframe is self._last and not doubtful) or self._keyframes.is_far(T, keyframe):
            if not self._connected:
                links = self._relocalizer.links(view, self._keyframes, self._component)
                self._connected = any(link.certain for link in links)
            self._keyframes.add(Keyframe(view, T, self._component, doubtful))
        mask = None
        if moving is not None and moving.fraction > NOTICED:
            mask = at_size(moving.view, frame)
            view = moving.applied(view)
        return Step(
            status,
            "; ".join(filter(None, notes)),
            T,
            keyframe.view.index,
            self._registration(found),
            view,
            self._component,
            links,
            doubtful,
            mask,
        )

    def _registration(self, found: Attempt) -> Registration:
        a, options = found.aligned, self._options
        targets = [found.reference.target]
        C = covariance(found.view, targets, a, options.alignment, options.uncertainty)
        # Odds that are twice as high as usual double the standard deviation.
        C = C * np.exp(2 * min(found.assessment.excess, 5.0))
        return registration_of(a, found.T_keyframe_camera, C)
