"""The keyframe tracker at work: continue the component, or begin a new one."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from tofuse.errors import InputError
from tofuse.geometry import se3
from tofuse.maps.surface_map import SurfaceMap, surface_map
from tofuse.odometry.attempts import Attempt, Attempts, Reference
from tofuse.odometry.base import Step, Tracker
from tofuse.odometry.keyframe_map import Keyframe, KeyframeMap
from tofuse.odometry.keyframes import Keyframes
from tofuse.odometry.motion import Moment, Motion, is_small
from tofuse.odometry.moving import Moving, MovingObjects, without_pixels
from tofuse.odometry.relocalization import Relocalizer
from tofuse.recordings.frames import Frame, RangeFrame
from tofuse.registration.agreement import agreement
from tofuse.registration.base import Registration
from tofuse.registration.projective import UNITS, Target
from tofuse.registration.uncertainty import covariance
from tofuse.registration.verification import Link, UsualFit, comparable, finely_scaled, self_scaled

Bool = NDArray[np.bool_]
Float64 = NDArray[np.float64]

# Moving objects are looked for in every n-th frame, and wherever something indicates them: what
# fits worse than usual, so many points in free space, or objects in the frame before.
_LOOK_EVERY, _IN_FRONT = 4, 0.005
# Between rival poses, what a deviation from the usual motion costs, as a fraction of the points:
# little, as where a scene determines the pose a wrong one loses more.
_MOTION = 0.05
# By which fraction of the points a rival must explain more: what differs less is the same pose.
_CLEARLY = 0.03
# Fraction of a view that moves, from which the rest is aligned once more, and which is reported.
_NOTICED = 0.01


class KeyframeTracker(Tracker):
    """See `Keyframes`."""

    def __init__(self, options: Keyframes) -> None:
        self._options = options
        self._keyframes = KeyframeMap(options.keyframe_angle, options.keyframe_distance)
        self._relocalizer = Relocalizer(options.belief if options.searches else None)
        self._usual = UsualFit(options.unusual)
        self._motion = Motion()
        self._moving = MovingObjects()
        self._moved = False  # whether something did in the last frame
        self._component = -1
        self._connected = True  # whether a certain link joins the component to an earlier one
        self._last: Keyframe | None = None  # the last frame of the component
        self._T_odometry: Float64 | None = None
        self._in_sequence = False  # whether the frame just before has a pose in the component

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
            return self._lose(reason)
        view = surface_map(frame, self._options.surface) if surface is None else surface
        if np.count_nonzero(view.planes[..., 3] > 0) < self._options.minimum_points:
            return self._lose("too few pixels have a surface")
        now = Moment(frame.index, frame.timestamp)
        attempts = self._attempts(view, now, T_odometry)
        found = (
            self._first_usual(view, attempts, now)
            or self._unrivalled(view, attempts, now)
            or self._searched(attempts, now)
        )
        if found is None:
            step = self._begin_component(view, attempts)
        else:
            step = self._continue_component(frame, view, found, attempts)
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

    def _attempts(self, view: SurfaceMap, now: Moment, T_odometry: Float64 | None) -> Attempts:
        """Alignments with the last keyframe and the last frame."""
        last, options = self._last, self._options
        T_last = np.eye(4) if last is None else last.T_component_camera
        references = []
        if last is not None:
            keyframes = [self._keyframes.newest]
            if last.view.index != keyframes[0].view.index:
                keyframes.append(last)
            references = [self._reference(k) for k in keyframes if comparable(view.depth, k.depth)]
        expected = None if last is None else self._predicted(last, now, T_odometry)
        steady = self._motion.steadily(now) if options.guess == "previous" else None
        if self._moved:
            T = T_last if expected is None else expected
            view = without_pixels(view, self._moving.predicted_mask(T, view))
        if options.guess == "identity":
            expected = None
        return Attempts(view, references, expected, steady, T_last, options.alignment, self._usual)

    def _reference(self, keyframe: Keyframe) -> Reference:
        """A keyframe as it is aligned with: without what has moved."""
        mask = self._moving.reference_mask(keyframe.view)
        if not mask.any():
            return Reference(keyframe, keyframe.target)
        view = without_pixels(keyframe.view, mask)
        return Reference(keyframe, Target(view, se3.inverse(keyframe.T_component_camera)))

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

    def _first_usual(self, view: SurfaceMap, attempts: Attempts, now: Moment) -> Attempt | None:
        """The first alignment that fits as usual, and that the camera's motion allows.

        While it is not known what is usual for the camera, both images must agree as well. So they
        must where a fit is only noisier than usual: a view farther from the keyframe shares less of
        its systematic errors, and a chain of nearer references would drift. Where a reference
        contradicts, what moves by itself may explain it; else another pose must explain all
        references as well: an alignment with the last frame may follow what moves since then.
        """
        rival = -np.inf
        for attempt in attempts:
            usual, predicted = attempt.assessment.usual, attempt.predicted
            if self._is_surprising(attempt, now):
                continue
            if not usual and (attempt.assessment.conflict or not predicted):
                if predicted:
                    for again in self._with_segmentation(view, attempt, attempts):
                        if again.assessment.usual and not self._is_surprising(again, now):
                            return again
                    rival = max(rival, self._explained(attempt, attempts, now))
                continue
            if not predicted and not self._is_verified(attempt):
                continue
            if np.isfinite(rival) and self._explained(attempt, attempts, now) < rival - _CLEARLY:
                continue
            if (usual and self._usual.is_known) or self._agreement(attempt) > 0:
                return attempt
        return None

    def _searched(self, attempts: Attempts, now: Moment) -> Attempt | None:
        """A quick motion that nothing predicted, which a search is certain of in sequence."""
        if not self._in_sequence:
            return None
        for r in attempts.references:
            link = self._relocalizer.link(attempts.view, r.keyframe, self._usual, adjacent=False)
            if link is None or not link.certain:
                continue
            T = r.keyframe.T_component_camera @ link.T_i_j
            found = attempts.again(T, attempts.view, r, predicted=False)
            if found.assessment.usual and self._motion.is_possible(found.T_component_camera, now):
                return replace(found, how=f"the prediction did not fit: {link.how}")
        return None

    def _explained(self, attempt: Attempt, attempts: Attempts, now: Moment) -> float:
        """How well a pose explains the view beside all references, and the camera's motion.

        A doubtful reference is no witness, unless there is no other: its own pose may follow what
        moves by itself.
        """
        T, compare = attempt.T_component_camera, finely_scaled(self._usual)
        references = [
            attempt.reference if r.keyframe is attempt.keyframe else r for r in attempts.references
        ]
        sure = [r for r in references if not r.keyframe.doubtful] or references
        fits = np.mean(
            [
                agreement(attempt.view, r.target.view, r.target.T_target_world @ T, compare).score
                for r in sure
            ]
        )
        return float(fits - _MOTION * np.log1p(self._motion.deviation(T, now) ** 2))

    def _agreement(self, attempt: Attempt) -> float:
        """Support less contradiction, of both images, for an alignment."""
        target = attempt.reference.target.view
        compare = self_scaled(self._usual)
        return agreement(attempt.view, target, attempt.T_keyframe_camera, compare).score

    def _is_surprising(self, attempt: Attempt, now: Moment) -> bool:
        """Whether the camera can hardly have moved like this."""
        return bool(self._motion.surprise(attempt.T_component_camera, now))

    def _is_small(self, attempt: Attempt) -> bool:
        """Whether the camera hardly moved, which needs no prediction."""
        assert self._last is not None
        return is_small(se3.inverse(self._last.T_component_camera) @ attempt.T_component_camera)

    def _is_verified(self, attempt: Attempt) -> bool:
        """Whether a step that nothing predicted is small, or a search finds the same."""
        if self._is_small(attempt):
            return True
        if not attempt.aligned.converged or len(attempt.aligned.unobservable):
            return False
        k, T = attempt.keyframe, attempt.T_keyframe_camera
        return self._agreement(attempt) > 0 and self._relocalizer.confirms(attempt.view, k, T)

    def _unrivalled(self, view: SurfaceMap, attempts: Attempts, now: Moment) -> Attempt | None:
        """The alignment that explains the view best, unless both images contradict even that.

        A poor fit is believed in sequence only, where the motion leads; never after a gap.
        """
        if self._last is None or not self._in_sequence:
            return None
        best, best_score = None, -np.inf
        made = list(attempts)
        segmented = [a for m in made for a in self._with_segmentation(view, m, attempts)]
        for attempt in (*segmented, *made):
            if not np.isfinite(attempt.aligned.rms_m) or self._is_surprising(attempt, now):
                continue
            if not (attempt.predicted or self._is_small(attempt)):
                continue
            if self._agreement(attempt) <= 0:
                continue
            score = self._explained(attempt, attempts, now)
            if score > best_score:
                best, best_score = attempt, score
        return best

    def _with_segmentation(
        self, view: SurfaceMap, attempt: Attempt, attempts: Attempts
    ) -> tuple[Attempt, ...]:
        """The same alignment without what moves by itself, if it ended where the camera is.

        What moves may fill so much of the view that the alignment follows it: then the prediction
        is the better guess. Where something begins to move, the camera may as well have jumped: a
        search must not say so.
        """
        if attempt not in attempts.segmented:
            k, predicted = attempt.keyframe, attempt.predicted
            poses = [attempt.T_component_camera]
            if predicted and attempts.expected is not None:
                poses.insert(0, attempts.expected)
            found = []
            for T in poses:
                moving = self._segment(view, T, k, suspected=True)
                if not moving.reliable or moving.fraction <= _NOTICED:
                    continue
                again = self._without_moving(view, T, k, moving, attempts, predicted)
                if self._moved or not self._relocalizer.contradicts(
                    view, k, again.T_keyframe_camera
                ):
                    found.append(again)
            attempts.segmented[attempt] = tuple(found)
        return attempts.segmented[attempt]

    def _segment(
        self, view: SurfaceMap, T: Float64, keyframe: Keyframe, *, suspected: bool = False
    ) -> Moving:
        k = keyframe
        return self._moving.compare(view, T, k.view, k.T_component_camera, suspected=suspected)

    def _without_moving(
        self,
        view: SurfaceMap,
        T: Float64,
        keyframe: Keyframe,
        moving: Moving,
        attempts: Attempts,
        predicted: bool,
    ) -> Attempt:
        """Align once more, from T, without what moves by itself."""
        k = keyframe
        target = Target(moving.applied_to_reference(k.view), se3.inverse(k.T_component_camera))
        reference = Reference(k, target)
        return attempts.again(T, moving.applied(view), reference, predicted=predicted)

    def _followed(
        self, view: SurfaceMap, found: Attempt, attempts: Attempts
    ) -> tuple[Attempt, Moving | None]:
        """Segment what moves by itself where something may, and align the rest if much does."""
        a = found.aligned
        look = (
            self._moved
            or found.view is not attempts.view
            or not found.assessment.usual
            or a.in_front > _IN_FRONT * a.compared
            or view.index % _LOOK_EVERY == 0
        )
        if not look:
            return found, None
        T, k = found.T_component_camera, found.keyframe
        suspected = found.view is not attempts.view
        moving = self._segment(view, T, k, suspected=suspected)
        left_out = np.count_nonzero(view.planes[..., 3]) - np.count_nonzero(
            found.view.planes[..., 3]
        )
        if moving.reliable and moving.fraction - left_out / view.pixels > _NOTICED:
            again = self._without_moving(view, T, k, moving, attempts, found.predicted)
            if again.assessment.usual or not found.assessment.usual:
                found = again
                moving = self._segment(view, again.T_component_camera, k, suspected=suspected)
        self._moving.learn(moving)
        self._moved = moving.fraction > 0
        return found, moving

    def _begin_component(self, view: SurfaceMap, attempts: Attempts) -> Step:
        """Start anew with a view that can't be connected, and look for where it may belong."""
        self._component += 1
        last = None if self._last is None else self._last.view.index
        adjacent = last if self._in_sequence else None
        links = self._relocalizer.links(
            view, self._keyframes, self._component, self._usual, adjacent
        )
        self._connected = any(link.certain for link in links)
        self._keyframes.add(Keyframe(view, np.eye(4), self._component))
        if self._in_sequence:  # the camera still moves as it did
            self._motion.restart()
        else:
            self._motion.interrupt()
        self._moving.reset()
        self._moved = False
        reason = ""
        if self._component:
            why = attempts.objection or "nothing comparable was seen before"
            reason = f"begins component {self._component}: {why}"
            if links:
                reason += f"; {links[-1].how} in frame {links[-1].i}"
        return Step(
            "tracked", reason, np.eye(4), surface=view, component=self._component, links=links
        )

    def _continue_component(
        self, frame: RangeFrame, view: SurfaceMap, found: Attempt, attempts: Attempts
    ) -> Step:
        found, moving = self._followed(view, attempts.converged(found), attempts)
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
        if keyframe is self._last or self._keyframes.is_far(T, keyframe):
            if not self._connected:
                links = self._relocalizer.links(view, self._keyframes, self._component, self._usual)
                self._connected = any(link.certain for link in links)
            doubtful = not found.assessment.usual
            self._keyframes.add(Keyframe(view, T, self._component, doubtful))
        mask = None
        if moving is not None and moving.fraction > _NOTICED:
            mask = _at_size(moving.view, frame)
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
            not found.assessment.usual,
            mask,
        )

    def _registration(self, found: Attempt) -> Registration:
        a, options = found.aligned, self._options
        targets = [found.reference.target]
        C = covariance(found.view, targets, a, options.alignment, options.uncertainty)
        # Odds that are twice as high as usual double the standard deviation.
        C = C * np.exp(2 * min(found.assessment.excess, 5.0))
        directions = a.unobservable * UNITS
        lengths = np.linalg.norm(directions, axis=1, keepdims=True)
        return Registration(
            T_target_source=found.T_keyframe_camera,
            converged=a.converged,
            iterations=a.iterations,
            correspondences=a.inliers,
            points=max(a.compared, 1),
            error=a.scale,
            rms_m=a.rms_m,
            information=np.asarray(np.linalg.inv(C), np.float64),
            unobservable=directions / np.maximum(lengths, 1e-12),
        )


def _at_size(mask: Bool, frame: RangeFrame) -> Bool:
    """A mask of the prepared view at the size of the frame's image."""
    rows, columns = frame.valid.shape
    step = columns // mask.shape[1]
    large = np.kron(mask, np.ones((step, step), np.bool_))
    out = np.zeros((rows, columns), np.bool_)
    out[: large.shape[0], : large.shape[1]] = large[:rows, :columns]
    return out
