"""Keyframe odometry: projective, photometric, and aware of degenerate directions.

The tracker prepares a frame, generates pose hypotheses, selects one, and continues or begins a
component.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import numpy as np

from tofuse.engine.alignment import Link, Registration, ViewOptions, covariance, projective
from tofuse.engine.arrays import Float64
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.errors import InputError
from tofuse.engine.frames import Frame, RangeFrame
from tofuse.engine.parts import part
from tofuse.engine.search import SearchOptions, verification
from tofuse.engine.tracking.base import Guess, Odometry, Status, Step, Tracker
from tofuse.engine.tracking.hypotheses import Hypotheses, Hypothesis, TrackerState
from tofuse.engine.tracking.keyframe_map import Keyframe, KeyframeMap, Relocalizer
from tofuse.engine.tracking.motion import FrameTime
from tofuse.engine.tracking.moving_objects import MIN_MOVING_FRACTION, at_size
from tofuse.engine.tracking.outlines import moved_fraction
from tofuse.engine.tracking.selection import Selection
from tofuse.engine.views import PreparedView, prepare_view


@part("odometry", "keyframes")
@dataclass(frozen=True)
class Keyframes(Bounded, Odometry):
    """Aligns each frame with the newest keyframe, coarse to fine.

    A frame far from the keyframe becomes the next one. Degenerate directions follow the motion
    model, and are reported. An alignment is compared with how views of this camera usually fit
    (`search.verification`): one that fits worse must beat its rivals, and gets a wide
    covariance. A frame that can't be connected begins a new component, in a coordinate frame of
    its own.

    Attributes
    ----------
    views
        How images are prepared and aligned.
    searches
        Whether lost frames are relocalized by exhaustive search while frames arrive; without, the
        time of each frame is bounded.
    guess
        Where an alignment starts: "previous" (constant velocity), "identity" (the last pose),
        "odometry" (the motion between the poses of an odometry file).
    moving
        What moves relative to the rest of the view: "exclude" it from alignment and model, or
        "ignore" that anything may, in a static scene.
    keyframe_angle, keyframe_distance
        Motion after which a frame becomes a keyframe: rad, and as a fraction of the median depth.
    minimum_points
        Valid points that a frame must have.
    """

    views: ViewOptions = ViewOptions()  # noqa: RUF009 - immutable
    searches: bool = True
    guess: Guess = "previous"
    moving: Literal["exclude", "ignore"] = "exclude"
    keyframe_angle: Annotated[float, Bounds(0, exclusive=True)] = 0.2
    keyframe_distance: Annotated[float, Bounds(0, exclusive=True)] = 0.1
    minimum_points: Annotated[int, Bounds(1)] = 100

    takes: ClassVar[frozenset[str]] = frozenset({"range"})

    def start(self, seed: int, search: SearchOptions | None = None) -> Tracker:
        """See `Odometry.start`. There is nothing random in it."""
        return KeyframeTracker(self, search or SearchOptions())


class KeyframeTracker(Tracker):
    """See `Keyframes`."""

    def __init__(self, options: Keyframes, search: SearchOptions) -> None:
        self._options = options
        fit_statistics = verification.FitStatistics()
        self._state = TrackerState(
            KeyframeMap(options.keyframe_angle, options.keyframe_distance),
            Relocalizer(search if options.searches else None, fit_statistics),
            fit_statistics,
            is_static=options.moving == "ignore",
        )

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
        state = self._state
        state.relocalizer.count_frame()
        view = self.prepare(frame) if surface is None else surface
        if view is None:
            return self._lose(self._problem_of(frame))
        if np.count_nonzero(view.planes[..., 3] > 0) < self._options.minimum_points:
            return self._lose("too few pixels have a surface")
        now = FrameTime(frame.index, frame.timestamp)
        state.motion.set_odometry(T_odometry)
        hypotheses = Hypotheses(
            view, now, state, self._options.guess, self._options.views.alignment
        )
        selected = Selection(hypotheses).best()
        state.degenerate = 0 if selected is None else len(selected.aligned.unobservable)
        if selected is None:
            step = self._begin_component(hypotheses)
        else:
            step = self._continue_component(frame, selected, hypotheses)
        self._update(view, step, now)
        return step

    def _lose(self, reason: str) -> Step:
        self._state.in_sequence = False
        return Step("lost", reason, None)

    def _update(self, view: PreparedView, step: Step, now: FrameTime) -> None:
        T = step.T_component_camera
        assert T is not None
        self._state.last = Keyframe(view, T, step.component, step.doubtful)
        degenerate = step.registration is not None and len(step.registration.unobservable) > 0
        self._state.motion.update(T, now, degenerate=degenerate)
        self._state.in_sequence = True

    def predicted_pose(self, now: FrameTime) -> Float64 | None:
        """See `Tracker.predicted_pose`."""
        return self._state.motion.predicted_pose(now)

    def interrupt(self) -> None:
        """See `Tracker.interrupt`."""
        self._state.motion.interrupt()
        self._state.last, self._state.in_sequence = None, False

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

    def _begin_component(self, hypotheses: Hypotheses) -> Step:
        """Begin a component with an unconnected view, and search for links to the others."""
        state, view = self._state, hypotheses.view
        state.component += 1
        adjacent = state.last.view.index if state.last is not None and state.in_sequence else None
        links = state.relocalizer.links(view, state.keyframes, state.component, adjacent)
        state.connected = any(link.certain for link in links)
        state.keyframes.add(Keyframe(view, np.eye(4), state.component))
        if state.in_sequence:  # the camera still moves at the same velocity
            state.motion.change_frame()
        else:
            state.motion.interrupt()
        state.objects.reset()
        state.rivals.reset()
        reason = ""
        if state.component:
            rejection = hypotheses.first_rejection or "nothing comparable was seen before"
            reason = f"begins component {state.component}: {rejection}"
            if links:
                reason += f"; {links[-1].how} in frame {links[-1].i}"
        return Step(
            "tracked", reason, np.eye(4), surface=view, component=state.component, links=links
        )

    def _continue_component(
        self, frame: RangeFrame, selected: Hypothesis, hypotheses: Hypotheses
    ) -> Step:
        """Refine the selected hypothesis without moving objects, and take its pose."""
        view, accepted, moving, rival = hypotheses.view, selected, None, 0.0
        if not selected.by_odometry:
            accepted, moving = hypotheses.segment(hypotheses.converged(selected))
            accepted, moving, rival = hypotheses.with_rival(accepted, moving)
            self._state.fit_statistics.learn(accepted.aligned, view.depth)
        links = self._insert_keyframe(view, accepted)
        status, reason = _status_of(accepted, frame)
        mask, moved = None, 0.0
        if moving is not None and moving.fraction > MIN_MOVING_FRACTION:
            mask = at_size(moving.view, frame)
            T, keyframe = accepted.T_component_camera, accepted.keyframe
            moved = moved_fraction(moving.view, view, T, keyframe.view, keyframe.T_component_camera)
            view = moving.applied(view)
        return Step(
            status,
            reason,
            accepted.T_component_camera,
            accepted.keyframe.view.index,
            self._registration(accepted),
            view,
            self._state.component,
            links,
            doubtful=not accepted.fit.is_usual,
            inflation=_inflation(accepted),
            moving=mask,
            moved=moved,
            rival=rival,
        )

    def _insert_keyframe(self, view: PreparedView, accepted: Hypothesis) -> tuple[Link, ...]:
        """Make a view a keyframe if it is due, and search for links while unconnected.

        It is due far from the last keyframe, or where it fits the last frame only; unless the view
        itself is doubtful.
        """
        state, T, keyframe = self._state, accepted.T_component_camera, accepted.keyframe
        doubtful = not accepted.fit.is_usual
        replaces = keyframe is state.last and not doubtful
        if not (replaces or state.keyframes.is_far(T, keyframe)):
            return ()
        links: tuple[Link, ...] = ()
        if not state.connected:
            links = state.relocalizer.links(view, state.keyframes, state.component)
            state.connected = any(link.certain for link in links)
        state.keyframes.add(Keyframe(view, T, state.component, doubtful))
        return links

    def _registration(self, accepted: Hypothesis) -> Registration:
        aligned, targets = accepted.aligned, [accepted.reference.target]
        C = covariance(accepted.view, targets, aligned, self._options.views.alignment)
        return projective.registration_of(
            aligned, accepted.T_keyframe_camera, C * _inflation(accepted) ** 2
        )


def _inflation(accepted: Hypothesis) -> float:
    """Factor of the standard deviations: odds twice as high as usual double them."""
    return float(np.exp(min(accepted.fit.excess, 5.0)))


def _status_of(accepted: Hypothesis, frame: RangeFrame) -> tuple[Status, str]:
    """Return the status of a frame with a pose, and anything unusual in tracking it."""
    notes = [accepted.note, accepted.fit.reason]
    if frame.amplitude_image is not None and not accepted.aligned.photometric:
        notes.append("the albedo took no part")
    status: Status = "tracked"
    if len(accepted.aligned.unobservable) == 6:
        status = "predicted"
        notes.insert(0, "all directions are degenerate")
    return status, "; ".join(filter(None, notes))
