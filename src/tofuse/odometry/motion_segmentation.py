"""Alignments without moving objects."""

from __future__ import annotations

import numpy as np

from tofuse.arrays import Float64
from tofuse.geometry import se3
from tofuse.odometry.hypotheses import Hypotheses, Hypothesis, Reference
from tofuse.odometry.keyframe_map import Keyframe
from tofuse.odometry.moving_objects import Moving, MovingObjects, without_pixels
from tofuse.odometry.relocalization import Relocalizer
from tofuse.registration.prepared_view import PreparedView
from tofuse.registration.projective import Target

# Moving fraction of a view above which the static rest is realigned, and the mask reported.
MIN_MOVING_FRACTION = 0.01
# Every n-th frame is segmented, and any with an indication of moving objects: an unusual fit, more
# than this fraction of points in free space, or objects in the frame before.
_SEGMENT_EVERY, _MAX_IN_FRONT = 4, 0.005


class MotionSegmentation:
    """Excludes moving objects from views before alignment, and segments them afterwards."""

    def __init__(self, relocalizer: Relocalizer) -> None:
        self._relocalizer = relocalizer
        self._objects = MovingObjects()
        self._moved = False  # whether objects moved in the last frame

    def reset(self) -> None:
        """Restart in another frame of reference."""
        self._objects.reset()
        self._moved = False

    def static_part(self, view: PreparedView, T_component_camera: Float64) -> PreparedView:
        """Return a view with a predicted pose (4, 4) without the objects that moved before."""
        if not self._moved:
            return view
        return without_pixels(view, self._objects.predicted_mask(T_component_camera, view))

    def reference(self, keyframe: Keyframe) -> Reference:
        """Return a keyframe without moved objects, as a reference for alignment."""
        mask = self._objects.reference_mask(keyframe.view)
        if not mask.any():
            return Reference(keyframe, keyframe.target)
        view = without_pixels(keyframe.view, mask)
        return Reference(keyframe, Target(view, se3.inverse(keyframe.T_component_camera)))

    def alternatives(
        self, hypothesis: Hypothesis, hypotheses: Hypotheses
    ) -> tuple[Hypothesis, ...]:
        """Return the same alignment without moving objects, if its pose is that of the camera.

        A moving object may fill so much of the view that the alignment follows it: then the
        predicted pose is the better start. Where objects begin to move, the camera itself may have
        jumped instead; so a search must not confirm that.
        """
        if hypothesis not in hypotheses.segmented:
            keyframe, predicted = hypothesis.keyframe, hypothesis.predicted
            poses = [hypothesis.T_component_camera]
            if predicted and hypotheses.T_predicted is not None:
                poses.insert(0, hypotheses.T_predicted)
            accepted = []
            for T in poses:
                moving = self._segmented(hypotheses.full_view, T, keyframe, suspected=True)
                if not moving.reliable or moving.fraction <= MIN_MOVING_FRACTION:
                    continue
                static = _realigned(T, keyframe, moving, hypotheses, predicted=predicted)
                confirms = self._relocalizer.confirms
                if (
                    self._moved
                    or confirms(hypotheses.full_view, keyframe, static.T_keyframe_camera)
                    is not False
                ):
                    accepted.append(static)
            hypotheses.segmented[hypothesis] = tuple(accepted)
        return hypotheses.segmented[hypothesis]

    def segment(
        self, hypothesis: Hypothesis, hypotheses: Hypotheses
    ) -> tuple[Hypothesis, Moving | None]:
        """Segment moving objects where there may be any, and realign the rest of the view.

        Returns
        -------
        The accepted hypothesis, realigned if enough moves; and the segmentation, if any.
        """
        view, aligned = hypotheses.full_view, hypothesis.aligned
        suspected = hypothesis.view is not hypotheses.static_view
        is_due = (
            self._moved
            or suspected
            or not hypothesis.assessment.is_usual
            or aligned.in_front > _MAX_IN_FRONT * aligned.compared
            or view.index % _SEGMENT_EVERY == 0
        )
        if not is_due:
            return hypothesis, None
        keyframe, T = hypothesis.keyframe, hypothesis.T_component_camera
        moving = self._segmented(view, T, keyframe, suspected=suspected)
        excluded = np.count_nonzero(view.planes[..., 3]) - np.count_nonzero(
            hypothesis.view.planes[..., 3]
        )
        if moving.reliable and moving.fraction - excluded / view.pixels > MIN_MOVING_FRACTION:
            static = _realigned(T, keyframe, moving, hypotheses, predicted=hypothesis.predicted)
            if static.assessment.is_usual or not hypothesis.assessment.is_usual:
                hypothesis = static
                moving = self._segmented(
                    view, static.T_component_camera, keyframe, suspected=suspected
                )
        self._objects.update(moving)
        self._moved = moving.fraction > 0
        return hypothesis, moving

    def _segmented(
        self, view: PreparedView, T: Float64, keyframe: Keyframe, *, suspected: bool
    ) -> Moving:
        k = keyframe
        return self._objects.compare(view, T, k.view, k.T_component_camera, suspected=suspected)


def _realigned(
    T: Float64, keyframe: Keyframe, moving: Moving, hypotheses: Hypotheses, *, predicted: bool
) -> Hypothesis:
    """Realign from T (4, 4), without moving objects."""
    k = keyframe
    target = Target(moving.applied_to_reference(k.view), se3.inverse(k.T_component_camera))
    view = moving.applied(hypotheses.full_view)
    return hypotheses.realigned(T, view, Reference(k, target), predicted=predicted)
