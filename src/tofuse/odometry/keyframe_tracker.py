"""The keyframe tracker at work: continue the component, or begin a new one."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from tofuse.errors import InputError
from tofuse.geometry import se3
from tofuse.maps.surface_map import SurfaceMap, surface_map
from tofuse.odometry.base import Step, Tracker
from tofuse.odometry.keyframe_map import Keyframe, KeyframeMap
from tofuse.odometry.keyframes import Keyframes
from tofuse.odometry.motion import Moment, Motion, is_small
from tofuse.odometry.relocalization import Relocalizer
from tofuse.recordings.frames import Frame, RangeFrame
from tofuse.registration.agreement import agreement
from tofuse.registration.base import Registration
from tofuse.registration.projective import UNITS, Aligned, align
from tofuse.registration.uncertainty import covariance
from tofuse.registration.verification import (
    PATIENT,
    Assessment,
    Link,
    UsualFit,
    comparable,
    self_scaled,
)

Float64 = NDArray[np.float64]

# From one frame to the next: what moves further without a prediction is a large step, which has
# rivals. rad, and fraction of the depth.
_LARGE = 0.35
# A turn must explain more than standing still does: a flat wall fits any.
_CLEARLY = 1.03


@dataclass(frozen=True, eq=False)
class _Attempt:
    """An alignment of the view with a keyframe, and how it compares with usual ones."""

    aligned: Aligned
    keyframe: Keyframe
    predicted: bool
    how: str
    assessment: Assessment

    @property
    def T(self) -> Float64:
        return self.aligned.T_world_source


class KeyframeTracker(Tracker):
    """See `Keyframes`."""

    def __init__(self, options: Keyframes) -> None:
        self._options = options
        self._keyframes = KeyframeMap(options.keyframe_angle, options.keyframe_distance)
        self._relocalizer = Relocalizer(options.belief if options.searches else None)
        self._usual = UsualFit(options.unusual)
        self._motion = Motion()
        self._component = -1
        self._connected = True  # whether a certain link joins the component to an earlier one
        self._last: Keyframe | None = None  # the last frame of the component
        self._T_odometry: Float64 | None = None

    def prepare(self, frame: Frame) -> SurfaceMap | None:
        """See `Tracker.prepare`."""
        if not isinstance(frame, RangeFrame) or self._unfit(frame):
            return None
        return surface_map(frame, self._options.surface)

    def push(
        self, frame: Frame, T_odometry: Float64 | None = None, surface: SurfaceMap | None = None
    ) -> Step:
        """See `Tracker.push`."""
        if not isinstance(frame, RangeFrame):
            raise InputError("is a cloud; this tracker needs images", where=f"frame {frame.index}")
        self._relocalizer.count_frame()
        if surface is None and (reason := self._unfit(frame)):
            return Step("lost", reason, None)
        view = surface_map(frame, self._options.surface) if surface is None else surface
        if np.count_nonzero(view.planes[..., 3] > 0) < self._options.minimum_points:
            return Step("lost", "too few pixels have a surface", None)
        now = Moment(frame.index, frame.timestamp)
        attempts = self._attempts(view, now, T_odometry)
        found = self._first_usual(attempts, now)
        if found is None:
            found = self._unrivalled(view, attempts, now)
        if found is None:
            step = self._begin_component(view, attempts)
        else:
            step = self._continue_component(view, found, lit=frame.amplitude_image is not None)
        assert step.T_component_camera is not None
        self._last = Keyframe(view, step.T_component_camera, self._component)
        self._motion.follow(step.T_component_camera, now)
        self._T_odometry = T_odometry
        return step

    def expected(self, now: Moment) -> Float64 | None:
        """See `Tracker.expected`."""
        return self._motion.expected(now)

    def interrupt(self) -> None:
        """See `Tracker.interrupt`."""
        self._motion.interrupt()
        self._last = None

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

    def _attempts(
        self, view: SurfaceMap, now: Moment, T_odometry: Float64 | None
    ) -> _Attempts:
        """Alignments with the last keyframe and the last frame, the likeliest first."""
        return _Attempts(self._alignments(view, now, T_odometry))

    def _alignments(
        self, view: SurfaceMap, now: Moment, T_odometry: Float64 | None
    ) -> Iterator[_Attempt]:
        last = self._last
        if last is None:
            return
        keyframes = [self._keyframes.newest]
        if last.view.index != keyframes[0].view.index:
            keyframes.append(last)
        keyframes = [k for k in keyframes if comparable(view.depth, k.depth)]
        options = self._options
        expected = self._predicted(last, now, T_odometry)
        if expected is not None and options.guess != "identity":
            steady = self._motion.steadily(now) if options.guess == "previous" else None
            for k in keyframes:
                aligned = align(
                    view,
                    [k.target],
                    expected if steady is None else steady,
                    options.alignment,
                    start=expected,
                    usual_scale=self._usual.noise_scale,
                )
                yield self._attempt(aligned, k, "", predicted=True)
        unknown = "nothing predicted it" if expected is None else "the prediction did not fit"
        for k in keyframes:
            aligned, where = self._turned(view, k, last.T_component_camera)
            yield self._attempt(aligned, k, f"{unknown}: found from {where}", predicted=False)

    def _attempt(
        self, aligned: Aligned, keyframe: Keyframe, how: str, *, predicted: bool
    ) -> _Attempt:
        return _Attempt(aligned, keyframe, predicted, how, self._usual.assess(aligned))

    def _predicted(
        self, last: Keyframe, now: Moment, T_odometry: Float64 | None
    ) -> Float64 | None:
        """Where the guess puts the camera; None where it says nothing."""
        if self._options.guess == "previous":
            return self._motion.expected(now)
        if self._options.guess == "identity":
            return last.T_component_camera
        before = self._T_odometry
        if T_odometry is None or before is None:
            return None
        return np.asarray(last.T_component_camera @ se3.inverse(before) @ T_odometry, np.float64)

    def _turned(
        self, view: SurfaceMap, keyframe: Keyframe, T_last: Float64
    ) -> tuple[Aligned, str]:
        """Align from where the camera was, or from the turn of it that fits best."""
        options, target = self._options, [keyframe.target]
        coarse = replace(options.alignment, levels=PATIENT[:1])
        motions = _turns(view)
        scale = self._usual.noise_scale
        still, *turned = [
            align(view, target, T_last @ motion, coarse, usual_scale=scale) for motion in motions
        ]
        best = max(range(len(turned)), key=lambda k: turned[k].score)
        moves = turned[best].score > _CLEARLY * still.score
        chosen, where = (turned[best], "a turn") if moves else (still, "where the camera was")
        if moves:
            where += f" by {np.degrees(se3.angle(motions[1 + best])):.0f} degrees"
        # With no prediction to keep to, what little the data says is the better guess.
        how = replace(options.alignment, levels=PATIENT, common_tilt=0.0, common_slope=0.0)
        T = chosen.T_world_source if moves else T_last
        start = chosen.T_world_source
        return align(view, target, T, how, start=start, usual_scale=scale), where

    def _first_usual(self, attempts: _Attempts, now: Moment) -> _Attempt | None:
        """The first alignment that fits as usual, and that the camera's motion allows."""
        for attempt in attempts:
            if not attempt.assessment.usual or self._motion.surprise(attempt.T, now):
                continue
            if attempt.predicted or self._is_safe(attempt):
                return attempt
        return None

    def _is_safe(self, attempt: _Attempt) -> bool:
        """Whether an alignment that nothing predicted is no large step, and is well determined."""
        assert self._last is not None
        between = se3.inverse(self._last.T_component_camera) @ attempt.T
        if is_small(between):
            return True
        far = np.linalg.norm(between[:3, 3]) > _LARGE * self._last.depth
        if far or se3.angle(between) > _LARGE:
            return False
        return attempt.aligned.converged and not len(attempt.aligned.unobservable)

    def _unrivalled(
        self, view: SurfaceMap, attempts: _Attempts, now: Moment
    ) -> _Attempt | None:
        """The alignment that explains the view best, unless both images contradict even that.

        A poor fit is believed in sequence only, where the motion leads; never after a gap.
        """
        if self._last is None or now.index - self._last.view.index > 1:
            return None
        compare = self_scaled(self._usual)
        best, best_score = None, 0.0
        for attempt in attempts:
            if self._motion.surprise(attempt.T, now) or not np.isfinite(attempt.aligned.rms_m):
                continue
            if not (attempt.predicted or self._is_safe(attempt)):
                continue
            k = attempt.keyframe
            T_keyframe_view = se3.inverse(k.T_component_camera) @ attempt.T
            score = agreement(view, k.view, T_keyframe_view, compare).score
            # Of equals the likeliest, which comes first.
            if score > _CLEARLY * best_score:
                best, best_score = attempt, score
        return best

    def _begin_component(self, view: SurfaceMap, attempts: _Attempts) -> Step:
        """Start anew with a view that can't be connected, and look for where it may belong."""
        self._component += 1
        last = None if self._last is None else self._last.view.index
        adjacent = last if last is not None and view.index - last == 1 else None
        links = self._relocalizer.links(
            view, self._keyframes, self._component, self._usual, adjacent
        )
        self._connected = any(link.certain for link in links)
        self._keyframes.add(Keyframe(view, np.eye(4), self._component))
        self._motion.interrupt()
        reason = ""
        if self._component:
            why = attempts.objection or "another recording begins"
            reason = f"begins component {self._component}: {why}"
            if links:
                reason += f"; {links[-1].how} in frame {links[-1].i}"
        return Step(
            "tracked",
            reason,
            np.eye(4),
            surface=view,
            component=self._component,
            links=links,
        )

    def _continue_component(self, view: SurfaceMap, found: _Attempt, *, lit: bool) -> Step:
        options, aligned, keyframe = self._options, found.aligned, found.keyframe
        doubtful = not found.assessment.usual
        self._usual.learn(aligned, view.depth)
        C = covariance(view, [keyframe.target], aligned, options.alignment, options.uncertainty)
        # Odds that are twice as high as usual double the standard deviation.
        C = C * np.exp(2 * min(found.assessment.excess, 5.0))
        notes = [found.how, found.assessment.reason]
        if lit and not aligned.photometric:
            notes.append("the albedo took no part")
        status: Literal["tracked", "predicted"] = "tracked"
        if len(aligned.unobservable) == 6:
            status = "predicted"
            notes.insert(0, "all directions are degenerate")
        links: tuple[Link, ...] = ()
        if keyframe is self._last or self._keyframes.is_far(found.T, keyframe):
            if not self._connected:
                links = self._relocalizer.links(
                    view, self._keyframes, self._component, self._usual
                )
                self._connected = any(link.certain for link in links)
            self._keyframes.add(Keyframe(view, found.T, self._component))
        return Step(
            status,
            "; ".join(filter(None, notes)),
            found.T,
            keyframe.view.index,
            _registration(aligned, keyframe.T_component_camera, C),
            view,
            self._component,
            links,
            doubtful,
        )


class _Attempts:
    """Attempts that are made when they are asked for, and kept."""

    def __init__(self, attempts: Iterator[_Attempt]) -> None:
        self._coming = attempts
        self._made: list[_Attempt] = []

    def __iter__(self) -> Iterator[_Attempt]:
        yield from self._made
        for attempt in self._coming:
            self._made.append(attempt)
            yield attempt

    @property
    def objection(self) -> str:
        """What speaks against the likeliest one, in words."""
        for attempt in self._made:
            if attempt.assessment.reason:
                return attempt.assessment.reason
        return "it is far from where the motion leads" if self._made else ""


def _turns(view: SurfaceMap) -> list[Float64]:
    """Motions of the camera to try: none, and turns about itself and about what it sees."""
    centre = np.eye(4)
    centre[2, 3] = view.depth
    motions = [np.eye(4)]
    for angle in np.radians([-12, -6, 6, 12]):
        for axis in (3, 4):
            twist = np.zeros(6)
            twist[axis] = angle
            turn = se3.exp(twist)
            motions += [turn, centre @ turn @ se3.inverse(centre)]
    return motions


def _registration(
    aligned: Aligned, T_component_reference: Float64, covariance: Float64
) -> Registration:
    directions = aligned.unobservable * UNITS
    lengths = np.linalg.norm(directions, axis=1, keepdims=True)
    information = np.asarray(np.linalg.inv(covariance), np.float64)
    return Registration(
        T_target_source=se3.inverse(T_component_reference) @ aligned.T_world_source,
        converged=aligned.converged,
        iterations=aligned.iterations,
        correspondences=aligned.inliers,
        points=max(aligned.compared, 1),
        error=aligned.scale,
        rms_m=aligned.rms_m,
        information=information,
        unobservable=directions / np.maximum(lengths, 1e-12),
    )
