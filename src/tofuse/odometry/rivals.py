"""Which explanation of a view is believed: of alignments, moving objects and quick motions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tofuse.geometry import se3
from tofuse.odometry.attempts import Attempt, Attempts
from tofuse.odometry.motion import Moment, Motion, is_small
from tofuse.odometry.relocalization import Relocalizer
from tofuse.odometry.segmentation import Segmentation
from tofuse.registration.agreement import AgreementOptions, agreement
from tofuse.registration.verification import UsualFit, finely_scaled, self_scaled

# Between rival poses, what a deviation from the usual motion costs, as a fraction of the points:
# little, as where a scene determines the pose a wrong one loses more.
_MOTION = 0.05
# By which fraction of the points a rival must explain more: what differs less is the same pose.
_CLEARLY = 0.03
# Degenerate directions of a view of a plane: two translations and a rotation.
_PLANE = 3


class Rivals:
    """Chooses between the explanations of a view."""

    def __init__(
        self,
        usual: UsualFit,
        motion: Motion,
        segmentation: Segmentation,
        relocalizer: Relocalizer,
    ) -> None:
        self._usual, self._motion = usual, motion
        self._segmentation, self._relocalizer = segmentation, relocalizer
        # Degenerate directions of the last view.
        self._degenerate = 0

    def best(self, attempts: Attempts, now: Moment, *, in_sequence: bool) -> Attempt | None:
        """The explanation to believe; None where everything contradicts.

        A poor fit is believed in sequence only, where the motion leads; never after a gap.
        """
        found = self._first_usual(attempts, now)
        if found is None and in_sequence:
            found = self._unrivalled(attempts, now) or self._searched(attempts, now)
        elif found is not None and in_sequence and self._slipped(found):
            found = self._constrained(found, attempts, now)
        self._degenerate = 0 if found is None else len(found.aligned.unobservable)
        return found

    def _slipped(self, attempt: Attempt) -> bool:
        """Whether a view is less constrained than the one before it was.

        What constrains it may be out of reach of an alignment that began at the wrong place, and
        the rest fits anywhere along a wall.
        """
        return len(attempt.aligned.unobservable) > self._degenerate

    def _constrained(self, attempt: Attempt, attempts: Attempts, now: Moment) -> Attempt:
        """The pose of a search, where that is better constrained and explains the view better."""
        other = self._searched(attempts, now)
        if other is None or len(other.aligned.unobservable) >= len(attempt.aligned.unobservable):
            return attempt
        poses = self._explained(other, attempts, now), self._explained(attempt, attempts, now)
        return other if poses[0] > poses[1] else attempt

    def _first_usual(self, attempts: Attempts, now: Moment) -> Attempt | None:
        """The first alignment that fits as usual, and that the camera's motion allows.

        While it is not known what is usual for the camera, both images must agree as well. So they
        must where a fit is only noisier than usual: a view farther from the keyframe shares less of
        its systematic errors, and a chain of nearer references would drift. Where a reference
        contradicts, what moves by itself may explain it; else another pose must explain all
        references as well: an alignment with the last frame may follow what moves since then.
        """
        rival = -np.inf
        for attempt in attempts:
            usual, predicted = attempt.assessment.usual, self._is_predicted(attempt, now)
            if self._is_surprising(attempt, now):
                continue
            if not usual and (attempt.assessment.conflict or not predicted):
                if predicted:
                    for again in self._segmentation.alternatives(attempt, attempts):
                        if again.assessment.usual and not self._is_surprising(again, now):
                            return again
                    rival = max(rival, self._explained(attempt, attempts, now))
                continue
            if not predicted and not self._is_verified(attempt, attempts):
                continue
            if np.isfinite(rival) and self._explained(attempt, attempts, now) < rival - _CLEARLY:
                continue
            if (usual and self._usual.is_known) or self._agreement(attempt) > 0:
                return attempt
        return None

    def _unrivalled(self, attempts: Attempts, now: Moment) -> Attempt | None:
        """The alignment that explains the view best, unless both images contradict even that."""
        best, best_score = None, -np.inf
        made = list(attempts)
        segmented = [a for m in made for a in self._segmentation.alternatives(m, attempts)]
        for attempt in (*segmented, *made):
            if not np.isfinite(attempt.aligned.rms_m) or self._is_surprising(attempt, now):
                continue
            if not (self._is_predicted(attempt, now) or _is_small(attempt, attempts)):
                continue
            if len(attempt.aligned.unobservable) >= _PLANE and attempt.assessment.conflict:
                continue  # the motion model, on which most of it relies, explains the view badly
            if self._agreement(attempt, finely_scaled(self._usual)) <= 0:
                continue
            score = self._explained(attempt, attempts, now)
            if score > best_score:
                best, best_score = attempt, score
        return best

    def _searched(self, attempts: Attempts, now: Moment) -> Attempt | None:
        """A quick motion that nothing predicted, of which a search is certain."""
        for r in attempts.references:
            link = self._relocalizer.link(attempts.view, r.keyframe, adjacent=False)
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
        fits = [
            agreement(attempt.view, r.target.view, r.target.T_target_world @ T, compare).score
            for r in sure
        ]
        off = self._motion.deviation(T, now)
        return float(np.mean(fits) - _MOTION * np.log1p(off * off))

    def _agreement(self, attempt: Attempt, compare: AgreementOptions | None = None) -> float:
        """Support less contradiction, of both images, for an alignment."""
        target = attempt.reference.target.view
        compare = compare or self_scaled(self._usual)
        return agreement(attempt.view, target, attempt.T_keyframe_camera, compare).score

    def _is_surprising(self, attempt: Attempt, now: Moment) -> bool:
        """Whether the camera can hardly have moved like this."""
        surprise = self._motion.surprise(attempt.T_component_camera, now)
        return bool(surprise) and not self._motion.is_guess

    def _is_predicted(self, attempt: Attempt, now: Moment) -> bool:
        """Whether an alignment began where the motion leads, and ended there if that is a guess."""
        surprise = self._motion.is_guess and self._motion.surprise(attempt.T_component_camera, now)
        return attempt.predicted and not surprise

    def _is_verified(self, attempt: Attempt, attempts: Attempts) -> bool:
        """Whether a step that nothing predicted is small, or a search finds the same."""
        if _is_small(attempt, attempts):
            return True
        if not attempt.aligned.converged or len(attempt.aligned.unobservable):
            return False
        k, T = attempt.keyframe, attempt.T_keyframe_camera
        return self._agreement(attempt) > 0 and bool(self._relocalizer.agrees(attempt.view, k, T))


def _is_small(attempt: Attempt, attempts: Attempts) -> bool:
    """Whether the camera hardly moved, which needs no prediction."""
    return is_small(se3.inverse(attempts.T_last) @ attempt.T_component_camera)
