"""Selection of a pose hypothesis, with regard to moving objects and quick motions."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Literal

import numpy as np

from tofuse.engine.alignment import projective
from tofuse.engine.geometry import se3
from tofuse.engine.search import DISTINCT_M, DISTINCT_RAD, pair_agreement, verification
from tofuse.engine.tracking.hypotheses import Hypotheses, Hypothesis
from tofuse.engine.tracking.motion import is_small

# Weight of the deviation from the predicted motion, as a fraction of the points: small, as a wrong
# pose loses more where the scene constrains it.
_MOTION_WEIGHT = 0.05
# Degenerate directions of a view of a plane: two translations and a rotation.
_PLANE_DEGENERACY = 3
# Maximum number of starts along a degenerate direction, for either sign: the gate is wide where the
# camera accelerates.
_MAX_DISPLACED = 5

_Case = Literal["accept", "verify", "rival", "reject"]
# By the fit, and whether the motion is predicted; see `Selection`.
_CASES: dict[tuple[verification.FitKind, bool], _Case] = {
    ("usual", True): "accept",
    ("usual", False): "verify",
    ("noisy", True): "accept",
    ("noisy", False): "reject",
    ("conflicting", True): "rival",
    ("conflicting", False): "reject",
}


class Selection:
    """Selects the hypothesis that explains a view.

    The first acceptable one is taken, the likeliest first:

    ===========  ==========  ================================================================
    Fit          Predicted   Decision
    ===========  ==========  ================================================================
    usual        yes         accept
    usual        no          accept if the motion is small, or a search confirms it
    noisy        yes         accept
    noisy        no          reject
    conflicting  yes         accept a usual fit without moving objects; else it is a rival
    conflicting  no          reject
    any          outside of  reject
                 the gate
    ===========  ==========  ================================================================

    Two conditions hold for "accept". The pose must explain all references about as well as the
    rivals do: an alignment with the last frame may follow an object that began to move. And unless
    the fit is usual and the usual fit of the camera is known, both images must agree: a view
    farther from the keyframe shares less of its systematic errors, so that it only looks noisier,
    and a chain of nearer references would drift.

    In sequence, that is right after a frame with a pose, there is more to try:

    ===========================  ============================================================
    First acceptable             Decision
    ===========================  ============================================================
    well constrained             it
    degenerate                   the best of it and of better constrained alignments
    none                         the best uncertain one; else that of external odometry, where
                                 it is trusted; else one of which a search is certain
    ===========================  ============================================================
    """

    def __init__(self, hypotheses: Hypotheses) -> None:
        self._hypotheses, self._now = hypotheses, hypotheses.now
        self._state, self._motion = hypotheses.state, hypotheses.state.motion

    def best(self) -> Hypothesis | None:
        """Return the hypothesis to accept; None if all are contradicted."""
        first = self._first_acceptable()
        if not self._state.in_sequence:
            return first
        if first is None:
            return self._best_uncertain() or self._hypotheses.by_odometry() or self._by_search()
        return self._better_constrained(first) if len(first.aligned.unobservable) else first

    def _first_acceptable(self) -> Hypothesis | None:
        rival_score = -np.inf
        for hypothesis in self._hypotheses:
            case = self._case(hypothesis)
            if case == "reject":
                continue
            if case == "rival":
                for static in self._hypotheses.static(hypothesis):
                    if static.fit.is_usual and not self._violates_gate(static):
                        return static
                rival_score = max(rival_score, self._explanation_score(hypothesis))
                continue
            if case == "verify" and not self._is_verified(hypothesis):
                continue
            if not self._beats(rival_score, hypothesis):
                continue
            known = hypothesis.fit.is_usual and self._state.fit_statistics.is_known
            if known or self._agreement(hypothesis) > 0:
                return hypothesis
        return None

    def _case(self, hypothesis: Hypothesis) -> _Case:
        if self._violates_gate(hypothesis):
            return "reject"
        return _CASES[hypothesis.fit.kind, self._is_predicted(hypothesis)]

    def _beats(self, rival_score: float, hypothesis: Hypothesis) -> bool:
        """Whether a pose explains the references about as well as the best rival, if any."""
        if np.isinf(rival_score):
            return True
        return self._explanation_score(hypothesis) >= rival_score - pair_agreement.MIN_LEAD

    def _better_constrained(self, hypothesis: Hypothesis) -> Hypothesis:
        """Return the alignment with the best score among those that are better constrained.

        The structure that constrains a view may be outside the convergence basin of a wrong start,
        where a wall fits anywhere along itself. So other starts along the degenerate directions are
        tried, and a search if the previous view was better constrained and no external odometry
        measured the motion since.
        """
        best, best_score = hypothesis, self._explanation_score(hypothesis)
        degenerate = len(hypothesis.aligned.unobservable)
        needs_search = degenerate > self._state.degenerate and self._motion.odometry_pose() is None
        searched = self._by_search() if needs_search else None
        rivals = [(searched, 0.0)] if searched is not None else []
        rivals += [(rival, pair_agreement.MIN_LEAD) for rival in self._displaced(hypothesis)]
        for rival, min_lead in rivals:
            if len(rival.aligned.unobservable) < degenerate:
                score = self._explanation_score(rival)
                if score > best_score + min_lead:
                    best, best_score = rival, score
        return best

    def _displaced(self, hypothesis: Hypothesis) -> Iterator[Hypothesis]:
        """Align from starts along the degenerate directions, within the gate."""
        T, view, r = hypothesis.T_component_camera, hypothesis.view, hypothesis.reference
        for direction in hypothesis.aligned.unobservable * projective.UNITS:
            lengths = np.linalg.norm(direction.reshape(2, 3), axis=1)
            step = direction / np.max(lengths / (DISTINCT_M, DISTINCT_RAD))
            for sign in (-1, 1):
                for k in range(1, _MAX_DISPLACED + 1):
                    start = T @ se3.exp(sign * k * step)
                    if self._motion.gate_violation(start, self._now):
                        break
                    displaced = self._hypotheses.realigned(start, view, r, predicted=True)
                    if displaced.fit.is_usual and not self._violates_gate(displaced):
                        yield displaced

    def _best_uncertain(self) -> Hypothesis | None:
        """Return the alignment that explains the view best, unless both images contradict it."""
        best, best_score = None, -np.inf
        with_objects = list(self._hypotheses)
        static = [s for hypothesis in with_objects for s in self._hypotheses.static(hypothesis)]
        for hypothesis in (*static, *with_objects):
            if self._is_possible(hypothesis):
                score = self._explanation_score(hypothesis)
                if score > best_score:
                    best, best_score = hypothesis, score
        return best

    def _is_possible(self, hypothesis: Hypothesis) -> bool:
        """Whether neither the motion nor the images rule out an uncertain alignment."""
        aligned = hypothesis.aligned
        if not np.isfinite(aligned.rms_m) or self._violates_gate(hypothesis):
            return False
        if not (self._is_predicted(hypothesis) or self._is_small(hypothesis)):
            return False
        if len(aligned.unobservable) >= _PLANE_DEGENERACY and hypothesis.fit.kind == "conflicting":
            return False  # mostly predicted, and the prediction explains the view badly
        return (
            self._agreement(hypothesis, verification.fine_tolerances(self._state.fit_statistics))
            > 0
        )

    def _by_search(self) -> Hypothesis | None:
        """Return a quick, unpredicted motion of which a search is certain."""
        view = self._hypotheses.static_view
        for r in self._hypotheses.references:
            link = self._state.relocalizer.link(view, r.keyframe, adjacent=False)
            if link is None or not link.certain:
                continue
            T = r.keyframe.T_component_camera @ link.T_i_j
            hypothesis = self._hypotheses.realigned(T, view, r, predicted=False)
            T_aligned = hypothesis.T_component_camera
            if hypothesis.fit.is_usual and self._motion.is_feasible(T_aligned, self._now):
                return replace(hypothesis, note=f"the prediction did not fit: {link.how}")
        return None

    def _explanation_score(self, hypothesis: Hypothesis) -> float:
        """Return the score of a pose: agreement with all references, less the deviation in motion.

        A doubtful reference counts only if there is no other: its own pose may follow a moving
        object.
        """
        T = hypothesis.T_component_camera
        options = verification.fine_tolerances(self._state.fit_statistics)
        references = [
            hypothesis.reference if r.keyframe is hypothesis.keyframe else r
            for r in self._hypotheses.references
        ]
        reliable = [r for r in references if not r.keyframe.doubtful] or references
        scores = [
            pair_agreement.agreement(
                hypothesis.view, r.target.view, r.target.T_target_world @ T, options
            ).score
            for r in reliable
        ]
        deviation = self._motion.normalised_deviation(T, self._now)
        return float(np.mean(scores) - _MOTION_WEIGHT * np.log1p(deviation * deviation))

    def _agreement(
        self, hypothesis: Hypothesis, options: pair_agreement.AgreementOptions | None = None
    ) -> float:
        """Return support minus contradiction of an alignment, over both images."""
        target = hypothesis.reference.target.view
        options = options or verification.usual_tolerances(self._state.fit_statistics)
        return pair_agreement.agreement(
            hypothesis.view, target, hypothesis.T_keyframe_camera, options
        ).score

    def _violates_gate(self, hypothesis: Hypothesis) -> bool:
        """Whether a pose is outside of the gate; that of an inherited velocity rejects nothing."""
        violation = self._motion.gate_violation(hypothesis.T_component_camera, self._now)
        return bool(violation) and not self._motion.velocity_is_inherited

    def _is_predicted(self, hypothesis: Hypothesis) -> bool:
        """Whether an alignment began at the predicted pose; if inherited, it must end near it."""
        violation = self._motion.velocity_is_inherited and self._motion.gate_violation(
            hypothesis.T_component_camera, self._now
        )
        return hypothesis.predicted and not violation

    def _is_verified(self, hypothesis: Hypothesis) -> bool:
        """Whether an unpredicted motion is small, or confirmed by a search."""
        if self._is_small(hypothesis):
            return True
        if not hypothesis.aligned.converged or len(hypothesis.aligned.unobservable):
            return False
        keyframe, T = hypothesis.keyframe, hypothesis.T_keyframe_camera
        return self._agreement(hypothesis) > 0 and bool(
            self._state.relocalizer.confirms(hypothesis.view, keyframe, T)
        )

    def _is_small(self, hypothesis: Hypothesis) -> bool:
        """Whether the camera hardly moved since the last frame."""
        return is_small(se3.inverse(self._hypotheses.T_last) @ hypothesis.T_component_camera)
