"""Alignments of a view with the last keyframe and the last frame, the likeliest first."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tofuse.arrays import Float64
from tofuse.geometry import se3
from tofuse.odometry.keyframe_map import Keyframe
from tofuse.registration.prepared_view import PreparedView
from tofuse.registration.projective import Aligned, Level, ProjectiveOptions, Target, align
from tofuse.registration.verification import PATIENT, Assessment, UsualFit

# A turn must explain more than standing still does: a flat wall fits any.
_CLEARLY = 1.03
# What is nearly aligned needs a few more iterations, at the resolution of tracking.
_SETTLING = (Level(4, 8, 0.005, 0.02), Level(2, 8, 0.0, 0.0))


@dataclass(frozen=True, eq=False)
class Reference:
    """A keyframe, and its view as it is aligned with: without what has moved since."""

    keyframe: Keyframe
    target: Target


@dataclass(frozen=True, eq=False)
class Attempt:
    """An alignment of the view with a keyframe, and how it compares with usual ones.

    Attributes
    ----------
    view
        What was aligned: the view without what moves by itself.
    predicted
        Whether it began where the motion leads.
    how
        In words, where that is out of the ordinary.
    """

    aligned: Aligned
    view: PreparedView
    reference: Reference
    predicted: bool
    how: str
    assessment: Assessment

    @property
    def keyframe(self) -> Keyframe:
        """What the view was aligned with."""
        return self.reference.keyframe

    @property
    def T_component_camera(self) -> Float64:
        """(4, 4) pose of the view."""
        return self.aligned.T_world_source

    @property
    def T_keyframe_camera(self) -> Float64:
        """(4, 4) the same in the frame of the keyframe."""
        T = se3.inverse(self.keyframe.T_component_camera) @ self.T_component_camera
        return np.asarray(T, np.float64)


class Attempts:
    """Attempts that are made when they are asked for, and kept.

    Parameters
    ----------
    whole, view
        The view, and the same without what moves by itself.
    references
        To align with, the likeliest first.
    expected, steady
        (4, 4) where the camera is expected, where alignments begin; and where degenerate directions
        stay. None where nothing is expected.
    T_last
        (4, 4) where the camera was.

    Attributes
    ----------
    segmented
        The same alignments without what moves by itself, of those of which they were made.
    """

    def __init__(
        self,
        whole: PreparedView,
        view: PreparedView,
        references: Sequence[Reference],
        expected: Float64 | None,
        steady: Float64 | None,
        T_last: Float64,
        options: ProjectiveOptions,
        usual: UsualFit,
    ) -> None:
        self.whole, self.view, self.references = whole, view, references
        self.expected, self.T_last = expected, T_last
        self._steady = steady
        self._options, self._usual = options, usual
        self._coming = self._make()
        self._made: list[Attempt] = []
        self.segmented: dict[Attempt, tuple[Attempt, ...]] = {}

    def __iter__(self) -> Iterator[Attempt]:
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

    def again(
        self, T: Float64, view: PreparedView, reference: Reference, *, predicted: bool
    ) -> Attempt:
        """Align once more from a pose T (4, 4): other pixels take part now."""
        aligned = self._align(view, reference, T, self._options)
        return self._attempt(aligned, view, reference, "", predicted=predicted)

    def converged(self, attempt: Attempt) -> Attempt:
        """The attempt after as many iterations as it takes: few do for small motions alone."""
        if attempt.aligned.converged:
            return attempt
        view, r, T = attempt.view, attempt.reference, attempt.T_component_camera
        kept = T if self._steady is None or not attempt.predicted else self._steady
        settling = replace(self._options, levels=_SETTLING)
        aligned = self._align(view, r, kept, settling, start=T)
        made = self._attempt(aligned, view, r, attempt.how, predicted=attempt.predicted)
        return made if aligned.score >= attempt.aligned.score else attempt

    def _make(self) -> Iterator[Attempt]:
        expected, view = self.expected, self.view
        if expected is not None:
            kept = expected if self._steady is None else self._steady
            for r in self.references:
                aligned = self._align(view, r, kept, self._options, start=expected)
                yield self._attempt(aligned, view, r, "", predicted=True)
        unknown = "nothing predicted it" if expected is None else "the prediction did not fit"
        for r in self.references:
            aligned, where = self._turned(r)
            how = f"{unknown}: found from {where}"
            yield self._attempt(aligned, view, r, how, predicted=False)

    def _attempt(
        self,
        aligned: Aligned,
        view: PreparedView,
        reference: Reference,
        how: str,
        *,
        predicted: bool,
    ) -> Attempt:
        return Attempt(aligned, view, reference, predicted, how, self._usual.assess(aligned))

    def _turned(self, reference: Reference) -> tuple[Aligned, str]:
        """Align from where the camera was, or from the turn of it that fits best."""
        view = self.view
        coarse = replace(self._options, levels=PATIENT[:1])
        motions = _turns(view)
        still, *turned = [
            self._align(view, reference, self.T_last @ motion, coarse) for motion in motions
        ]
        best = max(range(len(turned)), key=lambda k: turned[k].score)
        moves = turned[best].score > _CLEARLY * still.score
        chosen, where = (turned[best], "a turn") if moves else (still, "where the camera was")
        if moves:
            where += f" by {np.degrees(se3.angle(motions[1 + best])):.0f} degrees"
        # With no prediction to keep to, what little the data says is the better guess.
        how = replace(self._options, levels=PATIENT, common_tilt=0.0, common_slope=0.0)
        T = chosen.T_world_source if moves else self.T_last
        start = chosen.T_world_source
        return self._align(view, reference, T, how, start=start), where

    def _align(
        self,
        view: PreparedView,
        reference: Reference,
        T: Float64,
        options: ProjectiveOptions,
        *,
        start: Float64 | None = None,
    ) -> Aligned:
        scale = self._usual.noise_scale
        return align(view, [reference.target], T, options, start=start, usual_scale=scale)


def _turns(view: PreparedView) -> list[Float64]:
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
