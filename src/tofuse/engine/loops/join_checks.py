"""Verification of joins: whether views, drift and elapsed time permit the relative pose."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tofuse.engine.alignment import Link, Registration, projective
from tofuse.engine.arrays import Float64
from tofuse.engine.frames import evenly_spaced
from tofuse.engine.geometry import se3
from tofuse.engine.loops.merged_components import (
    CONVERGENCE,
    DRIFT,
    MergedComponent,
    MergedComponents,
    TrackedComponent,
    View,
    end_speeds,
    largest_motion,
    motion_over,
    transformed,
)
from tofuse.engine.normal import robust_sigma
from tofuse.engine.search import (
    are_distinct_poses,
    follow,
    pair_agreement,
    pose_probability,
    verification,
)

# View pairs that verify a join, besides those of the links; and their smallest overlap.
VERIFY, _OVERLAP = 8, 0.2
# Pairs of neighbouring views from which the usual fit of this camera's views is learnt.
_MAX_LEARNT_PAIRS = 16
# Contradiction is unusual if it exceeds the median of neighbours by this many standard deviations.
# Wrong poses within one scene contradict by more than the last number in any case.
_SIGMAS, _MIN_SPREAD, _MAX_CONTRADICTION = 3.0, 0.02, 0.2
# Largest error of a link: fraction of the depth, and rad.
_LINK_ERROR = 0.02
# A motion that is always possible: fraction of the depth, and rad.
_SMALL_MOTION = 0.3
# Factor on the 90 % quantile of the speed, which the camera hardly exceeds. If it had no time to
# lose sight of the place, up to this fraction of the overlap may contradict.
_SPEED_FACTOR, _MAX_CONTRADICTION_NEAR = 2.0, 0.3
_ALIGNMENT = projective.ProjectiveOptions(levels=verification.PATIENT, prior_m=3.0, prior_rad=3.0)


class JoinChecks:
    """Checks of joins, with limits learnt from neighbouring views of one component.

    Parameters
    ----------
    merged
        The merged components.

    Attributes
    ----------
    fit_statistics
        The usual fit of this camera's views.
    speed
        (2,) m/s and rad/s that the camera hardly exceeds; inf where unknown.
    """

    def __init__(self, merged: MergedComponents) -> None:
        self._merged = merged
        self.fit_statistics = verification.FitStatistics()
        self.max_contradiction = pose_probability.CONTRADICTION
        tracked = list(merged.tracked.values())
        measured = np.concatenate([end_speeds(s, end=True) for s in tracked])
        # Motions during which tracking failed may have been faster than all others.
        unbounded = np.full((_tracking_failures(tracked), 2), np.inf)
        speeds = np.concatenate([measured, unbounded])
        self.speed = np.full(2, np.inf)
        if len(measured):
            self.speed = _SPEED_FACTOR * np.quantile(speeds, 0.9, axis=0, method="higher")
        self._learn_from_neighbours()

    def _learn_from_neighbours(self) -> None:
        """Learn the usual fit and contradiction from neighbouring views of one component."""
        pairs = [
            (a, b) for s in self._merged.tracked.values() for a, b in itertools.pairwise(s.views)
        ]
        options = projective.ProjectiveOptions(levels=verification.PATIENT)
        contradictions = []
        for a, b in evenly_spaced(pairs, _MAX_LEARNT_PAIRS):
            T_a_b = se3.inverse(a.T_component_camera) @ b.T_component_camera
            aligned = projective.align(b.view, [projective.Target(a.view)], T_a_b, options)
            if aligned.overlap >= _OVERLAP:
                self.fit_statistics.learn(aligned, b.depth)
                result = pair_agreement.agreement(
                    b.view, a.view, T_a_b, verification.usual_tolerances(self.fit_statistics)
                )
                contradictions.append(result.contradiction)
        if len(contradictions) > 3:
            median = float(np.median(contradictions))
            spread = robust_sigma(np.array(contradictions) - median)
            limit = median + _SIGMAS * max(spread, _MIN_SPREAD)
            self.max_contradiction = max(self.max_contradiction, min(limit, _MAX_CONTRADICTION))

    def _overlapping(
        self, a: MergedComponent, b: MergedComponent, T_a_b: Float64
    ) -> list[tuple[View, View, Float64, pair_agreement.Agreement]]:
        """View pairs of both sides that overlap most under T_a_b: T_i_j, and their agreement."""
        compare = verification.usual_tolerances(self.fit_statistics)
        views_a, views_b = self._merged.views_of(a), self._merged.views_of(b)
        candidates: list[tuple[float, int, int]] = []
        if not views_a or not views_b:
            return []
        Ta = np.stack([self._merged.T_merged(a, v.index) for v in views_a])
        Tb = np.stack([T_a_b @ self._merged.T_merged(b, v.index) for v in views_b])
        for p, v in enumerate(views_a):
            distance = se3.change_of_view(se3.inverse(Ta[p]) @ Tb, v.depth)
            candidates += [
                (float(distance[q]), p, int(q))
                for q in np.flatnonzero(distance < verification.MAX_OVERLAP_DISTANCE)
            ]
        overlapping = []
        for _, p, q in sorted(candidates)[: 3 * VERIFY]:
            T = se3.inverse(Ta[p]) @ Tb[q]
            result = pair_agreement.agreement(views_b[q].view, views_a[p].view, T, compare)
            if result.overlap >= _OVERLAP:
                overlapping.append((views_a[p], views_b[q], T, result))
            if len(overlapping) >= VERIFY:
                break
        return overlapping

    def contradicts(self, a: MergedComponent, b: MergedComponent, link: Link) -> bool:
        """Return whether views of both sides contradict each other more than neighbours do.

        Components have drifted, the more the longer the path from the link. A contradiction at the
        implied pose counts only if no pose within the drift removes it, and is ignored where the
        drift may exceed the range of convergence of an alignment.
        """
        overlap = contradicting = 0.0
        T_a_b = self._merged.T_a_b(a, b, link)
        i, j = self._merged.ends(a, link)
        from_i, from_j = self._merged.path(a, i), self._merged.path(b, j)
        for first, second, T, at_implied in self._overlapping(a, b, T_a_b):
            drift = DRIFT * (from_i[first.index] + from_j[second.index])
            if drift > CONVERGENCE:
                continue
            agreed = at_implied
            if agreed.contradiction > self.max_contradiction:
                target = [projective.Target(first.view)]
                scale = self.fit_statistics.noise_scale
                aligned = projective.align(second.view, target, T, _ALIGNMENT, usual_scale=scale)
                limit = drift + _LINK_ERROR
                moved = se3.inverse(T) @ aligned.T_world_source
                if se3.is_within(moved, limit * first.depth, limit):
                    realigned = pair_agreement.agreement(
                        second.view,
                        first.view,
                        aligned.T_world_source,
                        verification.usual_tolerances(self.fit_statistics),
                    )
                    agreed = min(agreed, realigned, key=lambda result: result.contradiction)
            overlap += agreed.overlap
            contradicting += agreed.violation + agreed.clash
        limit = self.max_contradiction
        if self.is_near(a, b, T_a_b, _SMALL_MOTION):
            # Contradictions come from moving objects or errors of the pose.
            limit = max(limit, _MAX_CONTRADICTION_NEAR)
        return overlap > 0 and contradicting / overlap > limit

    def is_near(
        self, a: MergedComponent, b: MergedComponent, T_a_b: Float64, max_motion: float
    ) -> bool:
        """Return whether there was no time for a large motion between the sides, and T_a_b agrees.

        `max_motion` is a fraction of the depth, and rad. A pose beyond the possible motion of the
        camera is contradicted by the short time, not supported.
        """
        T = {**a.T, **transformed(b.T, T_a_b)}
        for before, after in self._merged.of_same_recording(a, b):
            elapsed = float(after.times[0] - before.times[-1])
            if elapsed <= 0:  # clocks that stand still tell no speed either
                continue
            reach = self.speed * elapsed
            if reach[0] < max_motion * before.depth and reach[1] < max_motion:
                motion = motion_over(before, after, T)
                if se3.is_within(motion, max_motion * before.depth, max_motion):
                    return True
        return False

    def confirming(
        self, a: MergedComponent, b: MergedComponent, T_a_b: Float64, links: list[Link], count: int
    ) -> list[Link]:
        """Return registrations of other view pairs, `count` at most, that agree with T_a_b."""
        linked = {frozenset((link.i, link.j)) for link in links}
        registrations = []
        for first, second, T, _ in self._overlapping(a, b, T_a_b)[:count]:
            if frozenset((first.index, second.index)) in linked:
                continue
            # Along degenerate directions an alignment stays at its guess, which confirms nothing.
            registration = follow(second.view, first.view, T, fit_statistics=self.fit_statistics)
            link = link_of(first, second, registration)
            if link is None or len(link.registration.unobservable):
                continue
            if not are_distinct_poses(link.T_i_j, T):
                registrations.append(replace(link, certain=False))
        return registrations

    def reachable(self, a: MergedComponent, b: MergedComponent, T_a_b: Float64) -> bool:
        """Return whether the camera had the time to move from one side to the other."""
        T = {**a.T, **transformed(b.T, T_a_b)}
        for first, second in self._merged.of_same_recording(a, b):
            motion = motion_over(first, second, T)
            max_motion = largest_motion(first, second)
            max_m = max_motion[0] + _SMALL_MOTION * first.depth
            if not se3.is_within(motion, max_m, max_motion[1] + _SMALL_MOTION):
                return False
        return True


def link_of(first: View, second: View, registration: Registration | None) -> Link | None:
    """Return a registration of two views as a link, None if it is not probable."""
    if registration is None or not registration.is_probable:
        return None
    return Link(first.index, second.index, registration, registration.is_decisive, registration.how)


def _tracking_failures(components: Sequence[TrackedComponent]) -> int:
    """Number of components that end where the next frame of the recording begins another one."""
    first = {(int(s.recordings[0]), int(s.frames[0])) for s in components}
    return sum((int(s.recordings[-1]), int(s.frames[-1]) + 1) in first for s in components)
