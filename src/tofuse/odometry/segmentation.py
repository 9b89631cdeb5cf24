"""Alignments without what moves by itself."""

from __future__ import annotations

import numpy as np

from tofuse.arrays import Float64
from tofuse.geometry import se3
from tofuse.odometry.attempts import Attempt, Attempts, Reference
from tofuse.odometry.keyframe_map import Keyframe
from tofuse.odometry.moving import Moving, MovingObjects, without_pixels
from tofuse.odometry.relocalization import Relocalizer
from tofuse.registration.prepared_view import PreparedView
from tofuse.registration.projective import Target

# Fraction of a view that moves, from which the rest is aligned once more, and which is reported.
NOTICED = 0.01
# Moving objects are looked for in every n-th frame, and wherever something indicates them: what
# fits worse than usual, so many points in free space, or objects in the frame before.
_LOOK_EVERY, _IN_FRONT = 4, 0.005


class Segmentation:
    """Leaves what moves by itself out of alignments, before and after they are made."""

    def __init__(self, relocalizer: Relocalizer) -> None:
        self._relocalizer = relocalizer
        self._objects = MovingObjects()
        self._moved = False  # whether something did in the last frame

    def reset(self) -> None:
        """Begin anew, in another frame of reference."""
        self._objects.reset()
        self._moved = False

    def rest_of(self, view: PreparedView, T_component_camera: Float64) -> PreparedView:
        """A view, expected at a pose (4, 4), without what moved in the last one."""
        if not self._moved:
            return view
        return without_pixels(view, self._objects.predicted_mask(T_component_camera, view))

    def reference(self, keyframe: Keyframe) -> Reference:
        """A keyframe as it is aligned with: without what has moved."""
        mask = self._objects.reference_mask(keyframe.view)
        if not mask.any():
            return Reference(keyframe, keyframe.target)
        view = without_pixels(keyframe.view, mask)
        return Reference(keyframe, Target(view, se3.inverse(keyframe.T_component_camera)))

    def alternatives(self, attempt: Attempt, attempts: Attempts) -> tuple[Attempt, ...]:
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
                moving = self._segmented(attempts.whole, T, k, suspected=True)
                if not moving.reliable or moving.fraction <= NOTICED:
                    continue
                again = _again(T, k, moving, attempts, predicted=predicted)
                T_keyframe_camera = again.T_keyframe_camera
                agrees = self._relocalizer.agrees
                if self._moved or agrees(attempts.whole, k, T_keyframe_camera) is not False:
                    found.append(again)
            attempts.segmented[attempt] = tuple(found)
        return attempts.segmented[attempt]

    def follow(self, found: Attempt, attempts: Attempts) -> tuple[Attempt, Moving | None]:
        """Segment what moves by itself where something may, and align the rest if much does."""
        view, a = attempts.whole, found.aligned
        suspected = found.view is not attempts.view
        look = (
            self._moved
            or suspected
            or not found.assessment.usual
            or a.in_front > _IN_FRONT * a.compared
            or view.index % _LOOK_EVERY == 0
        )
        if not look:
            return found, None
        k = found.keyframe
        moving = self._segmented(view, found.T_component_camera, k, suspected=suspected)
        left_out = np.count_nonzero(view.planes[..., 3]) - np.count_nonzero(
            found.view.planes[..., 3]
        )
        if moving.reliable and moving.fraction - left_out / view.pixels > NOTICED:
            T = found.T_component_camera
            again = _again(T, k, moving, attempts, predicted=found.predicted)
            if again.assessment.usual or not found.assessment.usual:
                found = again
                moving = self._segmented(view, again.T_component_camera, k, suspected=suspected)
        self._objects.learn(moving)
        self._moved = moving.fraction > 0
        return found, moving

    def _segmented(
        self, view: PreparedView, T: Float64, keyframe: Keyframe, *, suspected: bool
    ) -> Moving:
        k = keyframe
        return self._objects.compare(view, T, k.view, k.T_component_camera, suspected=suspected)


def _again(
    T: Float64, keyframe: Keyframe, moving: Moving, attempts: Attempts, *, predicted: bool
) -> Attempt:
    """Align once more, from T (4, 4), without what moves by itself."""
    k = keyframe
    target = Target(moving.applied_to_reference(k.view), se3.inverse(k.T_component_camera))
    view = moving.applied(attempts.whole)
    return attempts.again(T, view, Reference(k, target), predicted=predicted)
