"""Selection of a pose hypothesis, with regard to moving objects and quick motions."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from tofuse.geometry import se3
from tofuse.odometry.hypotheses import Hypotheses, Hypothesis
from tofuse.odometry.motion import Moment, MotionModel, is_small
from tofuse.odometry.motion_segmentation import MotionSegmentation
from tofuse.odometry.relocalization import Relocalizer
from tofuse.registration.agreement import MIN_LEAD, AgreementOptions, agreement
from tofuse.registration.projective import UNITS
from tofuse.registration.search import DISTINCT_M, DISTINCT_RAD
from tofuse.registration.verification import FitStatistics, fine_tolerances, usual_tolerances

# Weight of the deviation from the predicted motion, as a fraction of the points: small, as a wrong
# pose loses more where the scene constrains it.
_MOTION_WEIGHT = 0.05
# Degenerate directions of a view of a plane: two translations and a rotation.
_PLANE_DEGENERACY = 3
# Maximum number of starts along a degenerate direction, for either sign: the gate is wide where the
# camera accelerates.
_MAX_DISPLACED = 5


class HypothesisSelector:
    """Selects the pose hypothesis that explains a view."""

    def __init__(
        self,
        fit_statistics: FitStatistics,
        motion: MotionModel,
        segmentation: MotionSegmentation,
        relocalizer: Relocalizer,
    ) -> None:
        self._fit_statistics, self._motion = fit_statistics, motion
        self._segmentation, self._relocalizer = segmentation, relocalizer
        self._last_degenerate = 0  # number of degenerate directions of the last view

    def best(self, hypotheses: Hypotheses, now: Moment, *, in_sequence: bool) -> Hypothesis | None:
        """Return the hypothesis to accept; None if all are contradicted.

        A poor fit is accepted only in sequence, near the predicted pose; never after a gap.
        """
        best = self._first_usual(hypotheses, now)
        if best is None and in_sequence:
            best = self._best_uncertain(hypotheses, now) or self._by_search(hypotheses, now)
        elif best is not None and in_sequence and len(best.aligned.unobservable):
            best = self._better_constrained(best, hypotheses, now)
        self._last_degenerate = 0 if best is None else len(best.aligned.unobservable)
        return best

    def _better_constrained(
        self, hypothesis: Hypothesis, hypotheses: Hypotheses, now: Moment
    ) -> Hypothesis:
        """Return the alignment with the best score among those that are better constrained.

        The structure that constrains a view may be outside the convergence basin of a wrong start,
        where a wall fits anywhere along itself. So other starts along the degenerate directions are
        tried, and a search if the previous view was better constrained.
        """
        best, best_score = hypothesis, self._explanation_score(hypothesis, hypotheses, now)
        degenerate = len(hypothesis.aligned.unobservable)
        searched = self._by_search(hypotheses, now) if degenerate > self._last_degenerate else None
        rivals = [(searched, 0.0)] if searched is not None else []
        rivals += [(rival, MIN_LEAD) for rival in self._displaced(hypothesis, hypotheses, now)]
        for rival, min_lead in rivals:
            if len(rival.aligned.unobservable) < degenerate:
                score = self._explanation_score(rival, hypotheses, now)
                if score > best_score + min_lead:
                    best, best_score = rival, score
        return best

    def _displaced(
        self, hypothesis: Hypothesis, hypotheses: Hypotheses, now: Moment
    ) -> Iterator[Hypothesis]:
        """Align from starts along the degenerate directions, within the gate."""
        T, view, r = hypothesis.T_component_camera, hypothesis.view, hypothesis.reference
        for direction in hypothesis.aligned.unobservable * UNITS:
            lengths = np.linalg.norm(direction.reshape(2, 3), axis=1)
            step = direction / np.max(lengths / (DISTINCT_M, DISTINCT_RAD))
            for sign in (-1, 1):
                for k in range(1, _MAX_DISPLACED + 1):
                    start = T @ se3.exp(sign * k * step)
                    if self._motion.gate_violation(start, now):
                        break
                    displaced = hypotheses.realigned(start, view, r, predicted=True)
                    if displaced.assessment.is_usual and not self._violates_gate(displaced, now):
                        yield displaced

    def _first_usual(self, hypotheses: Hypotheses, now: Moment) -> Hypothesis | None:
        """Return the first alignment with a usual fit and a motion inside of the gate.

        While the usual fit of the camera is unknown, both images must agree as well. The same holds
        for a fit that is only noisier than usual: a view farther from the keyframe shares less of
        its systematic errors, and a chain of nearer references would drift. If a reference
        contradicts, moving objects may explain it; else another pose must explain all references
        as well: an alignment with the last frame may follow an object that began to move.
        """
        rival_score = -np.inf
        for hypothesis in hypotheses:
            usual, predicted = hypothesis.assessment.is_usual, self._is_predicted(hypothesis, now)
            if self._violates_gate(hypothesis, now):
                continue
            if not usual and (hypothesis.assessment.conflict or not predicted):
                if predicted:
                    for static in self._segmentation.alternatives(hypothesis, hypotheses):
                        if static.assessment.is_usual and not self._violates_gate(static, now):
                            return static
                    rival_score = max(
                        rival_score, self._explanation_score(hypothesis, hypotheses, now)
                    )
                continue
            if not predicted and not self._is_verified(hypothesis, hypotheses):
                continue
            if (
                np.isfinite(rival_score)
                and self._explanation_score(hypothesis, hypotheses, now) < rival_score - MIN_LEAD
            ):
                continue
            if (usual and self._fit_statistics.is_known) or self._agreement(hypothesis) > 0:
                return hypothesis
        return None

    def _best_uncertain(self, hypotheses: Hypotheses, now: Moment) -> Hypothesis | None:
        """Return the alignment that explains the view best, unless both images contradict it."""
        best, best_score = None, -np.inf
        unsegmented = list(hypotheses)
        segmented = [
            alternative
            for h in unsegmented
            for alternative in self._segmentation.alternatives(h, hypotheses)
        ]
        for hypothesis in (*segmented, *unsegmented):
            if not np.isfinite(hypothesis.aligned.rms_m) or self._violates_gate(hypothesis, now):
                continue
            if not (self._is_predicted(hypothesis, now) or _is_small(hypothesis, hypotheses)):
                continue
            if (
                len(hypothesis.aligned.unobservable) >= _PLANE_DEGENERACY
                and hypothesis.assessment.conflict
            ):
                continue  # mostly predicted, and the prediction explains the view badly
            if self._agreement(hypothesis, fine_tolerances(self._fit_statistics)) <= 0:
                continue
            score = self._explanation_score(hypothesis, hypotheses, now)
            if score > best_score:
                best, best_score = hypothesis, score
        return best

    def _by_search(self, hypotheses: Hypotheses, now: Moment) -> Hypothesis | None:
        """Return a quick, unpredicted motion of which a search is certain."""
        for r in hypotheses.references:
            link = self._relocalizer.link(hypotheses.static_view, r.keyframe, adjacent=False)
            if link is None or not link.certain:
                continue
            T = r.keyframe.T_component_camera @ link.T_i_j
            hypothesis = hypotheses.realigned(T, hypotheses.static_view, r, predicted=False)
            if hypothesis.assessment.is_usual and self._motion.is_feasible(
                hypothesis.T_component_camera, now
            ):
                return replace(hypothesis, note=f"the prediction did not fit: {link.how}")
        return None

    def _explanation_score(
        self, hypothesis: Hypothesis, hypotheses: Hypotheses, now: Moment
    ) -> float:
        """Return the score of a pose: agreement with all references, less the deviation in motion.

        A doubtful reference counts only if there is no other: its own pose may follow a moving
        object.
        """
        T, options = hypothesis.T_component_camera, fine_tolerances(self._fit_statistics)
        references = [
            hypothesis.reference if r.keyframe is hypothesis.keyframe else r
            for r in hypotheses.references
        ]
        reliable = [r for r in references if not r.keyframe.doubtful] or references
        scores = [
            agreement(hypothesis.view, r.target.view, r.target.T_target_world @ T, options).score
            for r in reliable
        ]
        deviation = self._motion.normalised_deviation(T, now)
        return float(np.mean(scores) - _MOTION_WEIGHT * np.log1p(deviation * deviation))

    def _agreement(self, hypothesis: Hypothesis, options: AgreementOptions | None = None) -> float:
        """Return support minus contradiction of an alignment, over both images."""
        target = hypothesis.reference.target.view
        options = options or usual_tolerances(self._fit_statistics)
        return agreement(hypothesis.view, target, hypothesis.T_keyframe_camera, options).score

    def _violates_gate(self, hypothesis: Hypothesis, now: Moment) -> bool:
        """Whether the motion to a pose is outside of the gate."""
        violation = self._motion.gate_violation(hypothesis.T_component_camera, now)
        return bool(violation) and not self._motion.velocity_is_inherited

    def _is_predicted(self, hypothesis: Hypothesis, now: Moment) -> bool:
        """Whether an alignment began at the predicted pose; if inherited, it must end near it."""
        motion = self._motion
        violation = motion.velocity_is_inherited and motion.gate_violation(
            hypothesis.T_component_camera, now
        )
        return hypothesis.predicted and not violation

    def _is_verified(self, hypothesis: Hypothesis, hypotheses: Hypotheses) -> bool:
        """Whether an unpredicted motion is small, or confirmed by a search."""
        if _is_small(hypothesis, hypotheses):
            return True
        if not hypothesis.aligned.converged or len(hypothesis.aligned.unobservable):
            return False
        keyframe, T = hypothesis.keyframe, hypothesis.T_keyframe_camera
        return self._agreement(hypothesis) > 0 and bool(
            self._relocalizer.confirms(hypothesis.view, keyframe, T)
        )


def _is_small(hypothesis: Hypothesis, hypotheses: Hypotheses) -> bool:
    """Whether the camera hardly moved since the last frame."""
    return is_small(se3.inverse(hypotheses.T_last) @ hypothesis.T_component_camera)
