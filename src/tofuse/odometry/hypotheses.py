"""Pose hypotheses: alignments with the last keyframe and the last frame, the likeliest first."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tofuse.arrays import Float64
from tofuse.geometry import se3
from tofuse.odometry.keyframe_map import Keyframe
from tofuse.registration.prepared_view import PreparedView
from tofuse.registration.projective import Aligned, Level, ProjectiveOptions, Target, align
from tofuse.registration.verification import PATIENT, Assessment, FitStatistics

# Minimum score of a rotated start relative to the unrotated one: a flat wall fits under any.
_MIN_ROTATED_SCORE_RATIO = 1.03
# A nearly aligned view needs a few more iterations, at the resolution of tracking.
_CONVERGENCE_LEVELS = (Level(4, 8, 0.005, 0.02), Level(2, 8, 0.0, 0.0))


@dataclass(frozen=True, eq=False)
class Reference:
    """A keyframe, and its view without moved objects as the target of alignments."""

    keyframe: Keyframe
    target: Target


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
    assessment
        Comparison with usual alignments.
    """

    aligned: Aligned
    view: PreparedView
    reference: Reference
    predicted: bool
    note: str
    assessment: Assessment

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
    """The hypotheses of one view, evaluated lazily and cached.

    Parameters
    ----------
    full_view, static_view
        The view, and the same without moving objects.
    references
        To align with, the likeliest first.
    T_predicted, T_smoothed
        (4, 4) predicted poses: the start of alignments, and the one that degenerate directions
        keep. None without a prediction.
    T_last
        (4, 4) pose of the last frame.
    options
        How views are aligned.
    fit_statistics
        Usual fit of views of this camera.

    Attributes
    ----------
    segmented
        Alternatives without moving objects to the hypotheses for which they were evaluated.
    """

    def __init__(
        self,
        full_view: PreparedView,
        static_view: PreparedView,
        references: Sequence[Reference],
        T_predicted: Float64 | None,
        T_smoothed: Float64 | None,
        T_last: Float64,
        options: ProjectiveOptions,
        fit_statistics: FitStatistics,
    ) -> None:
        self.full_view, self.static_view, self.references = full_view, static_view, references
        self.T_predicted, self.T_last = T_predicted, T_last
        self._T_smoothed = T_smoothed
        self._options, self._fit_statistics = options, fit_statistics
        self._pending = self._generate()
        self._evaluated: list[Hypothesis] = []
        self.segmented: dict[Hypothesis, tuple[Hypothesis, ...]] = {}

    def __iter__(self) -> Iterator[Hypothesis]:
        yield from self._evaluated
        for hypothesis in self._pending:
            self._evaluated.append(hypothesis)
            yield hypothesis

    @property
    def first_rejection(self) -> str:
        """The reason why the likeliest hypothesis was rejected, in words."""
        for hypothesis in self._evaluated:
            if hypothesis.assessment.reason:
                return hypothesis.assessment.reason
        return "it is far from the predicted pose" if self._evaluated else ""

    def realigned(
        self, T: Float64, view: PreparedView, reference: Reference, *, predicted: bool
    ) -> Hypothesis:
        """Realign from a pose T (4, 4), with other pixels of the view or the reference."""
        aligned = self._align(view, reference, T, self._options)
        return self._hypothesis(aligned, view, reference, "", predicted=predicted)

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

    def _hypothesis(
        self,
        aligned: Aligned,
        view: PreparedView,
        reference: Reference,
        note: str,
        *,
        predicted: bool,
    ) -> Hypothesis:
        return Hypothesis(
            aligned, view, reference, predicted, note, self._fit_statistics.assess(aligned)
        )

    def _from_best_rotation(self, reference: Reference) -> tuple[Aligned, str]:
        """Align from the last pose, or its rotation that fits best; and name the start."""
        view = self.static_view
        coarse = replace(self._options, levels=PATIENT[:1])
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
        options = replace(self._options, levels=PATIENT, common_tilt=0.0, common_slope=0.0)
        prior = best_aligned.T_world_source if rotates else self.T_last
        start = best_aligned.T_world_source
        return self._align(view, reference, prior, options, start=start), name

    def _align(
        self,
        view: PreparedView,
        reference: Reference,
        T: Float64,
        options: ProjectiveOptions,
        *,
        start: Float64 | None = None,
    ) -> Aligned:
        scale = self._fit_statistics.noise_scale
        return align(view, [reference.target], T, options, start=start, usual_scale=scale)


def _rotation_candidates(view: PreparedView) -> list[Float64]:
    """Return motions (4, 4) to try: none, and rotations about the camera and the scene."""
    centre = np.eye(4)
    centre[2, 3] = view.depth
    motions = [np.eye(4)]
    for angle in np.radians([-12, -6, 6, 12]):
        for axis in (3, 4):
            twist = np.zeros(6)
            twist[axis] = angle
            rotation = se3.exp(twist)
            motions += [rotation, centre @ rotation @ se3.inverse(centre)]
    return motions
