"""Verification of joins: whether views, drift and elapsed time permit the relative pose."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tofuse.arrays import Float64
from tofuse.geometry import se3
from tofuse.posegraph.gaps import (
    CONVERGENCE,
    TrackedComponent,
    View,
    end_speeds,
    largest_motion,
    motion_over,
)
from tofuse.posegraph.merged_components import DRIFT, MergedComponent, MergedComponents, transformed
from tofuse.registration.agreement import Agreement, agreement
from tofuse.registration.base import Link, Registration
from tofuse.registration.pose_probability import CONTRADICTION
from tofuse.registration.projective import ProjectiveOptions, Target, align
from tofuse.registration.search import differ
from tofuse.registration.verification import IN_SIGHT, PATIENT, FitStatistics, self_scaled
from tofuse.registration.view_pair import follow

# View pairs that verify a join, besides those of the links; and their smallest overlap.
VERIFY, _OVERLAP = 8, 0.2
# Pairs of neighbouring views from which the usual fit of this camera's views is learnt.
_LEARN = 16
# Contradiction is unusual beyond this many standard deviations above the median of neighbours.
# Wrong poses within one scene contradict by more than the last number in any case.
_SIGMAS, _MIN_SPREAD, _MAX_CONTRADICTION = 3.0, 0.02, 0.2
# Largest error of a link: fraction of the depth, and rad.
_LINK_ERROR = 0.02
# A motion that is always possible: fraction of the depth, and rad.
_NEAR = 0.3
# Factor on the 90 % quantile of the speed that the camera hardly exceeds. Where it had no time to
# lose sight of the place, up to this fraction of the overlap may contradict.
_HARDLY, _SAME_PLACE = 2.0, 0.3
_NEARBY = ProjectiveOptions(levels=PATIENT, prior_m=3.0, prior_rad=3.0)


class JoinChecks:
    """Checks of joins, with limits learnt from neighbouring views of one component.

    Parameters
    ----------
    merged
        The merged components.

    Attributes
    ----------
    usual
        The usual fit of this camera's views.
    speed
        (2,) m/s and rad/s that the camera hardly exceeds; inf where unknown.
    """

    def __init__(self, merged: MergedComponents) -> None:
        self._merged = merged
        self.usual = FitStatistics()
        self._contradiction = CONTRADICTION
        stretches = list(merged.stretches.values())
        known = np.concatenate([end_speeds(s, end=True) for s in stretches])
        # Motions at which tracking failed may have been faster than all others.
        unknown = np.full((_tracking_failures(stretches), 2), np.inf)
        speeds = np.concatenate([known, unknown])
        self.speed = np.full(2, np.inf)
        if len(known):
            self.speed = _HARDLY * np.quantile(speeds, 0.9, axis=0, method="higher")
        self._learn_from_neighbours()

    def _learn_from_neighbours(self) -> None:
        """Learn the usual fit and contradiction from neighbouring views of one component."""
        pairs = [
            (a, b) for s in self._merged.stretches.values() for a, b in itertools.pairwise(s.views)
        ]
        some = np.linspace(0, len(pairs) - 1, min(len(pairs), _LEARN)).round().astype(int)
        options = ProjectiveOptions(levels=PATIENT)
        seen = []
        for k in some:
            a, b = pairs[k]
            T_a_b = se3.inverse(a.T_component_camera) @ b.T_component_camera
            aligned = align(b.view, [Target(a.view, np.eye(4))], T_a_b, options)
            if aligned.overlap >= _OVERLAP:
                self.usual.learn(aligned, b.depth)
                found = agreement(b.view, a.view, T_a_b, self_scaled(self.usual))
                seen.append(found.contradiction)
        if len(seen) > 3:
            median = float(np.median(seen))
            spread = 1.48 * float(np.median(np.abs(np.array(seen) - median)))
            limit = median + _SIGMAS * max(spread, _MIN_SPREAD)
            self._contradiction = max(self._contradiction, min(limit, _MAX_CONTRADICTION))

    def _overlapping(
        self, a: MergedComponent, b: MergedComponent, T_a_b: Float64
    ) -> list[tuple[View, View, Float64, Agreement]]:
        """View pairs of both sides that overlap most under T_a_b: T_i_j, and their agreement."""
        compare = self_scaled(self.usual)
        ours = [
            self._merged.views[i] for i in self._merged.views if self._merged.component_of[i] in a.T
        ]
        theirs = [
            self._merged.views[i] for i in self._merged.views if self._merged.component_of[i] in b.T
        ]
        near: list[tuple[float, int, int]] = []
        if not ours or not theirs:
            return []
        Ta = np.stack([self._merged.T_merged(a, v.index) for v in ours])
        Tb = np.stack([T_a_b @ self._merged.T_merged(b, v.index) for v in theirs])
        for p, v in enumerate(ours):
            between = se3.inverse(Ta[p]) @ Tb
            apart = np.linalg.norm(between[:, :3, 3], axis=1) / v.depth
            away = apart + np.asarray(se3.angle(between))
            near += [(float(away[q]), p, int(q)) for q in np.flatnonzero(away < IN_SIGHT)]
        found = []
        for _, p, q in sorted(near)[: 3 * VERIFY]:
            T = se3.inverse(Ta[p]) @ Tb[q]
            seen = agreement(theirs[q].view, ours[p].view, T, compare)
            if seen.overlap >= _OVERLAP:
                found.append((ours[p], theirs[q], T, seen))
            if len(found) >= VERIFY:
                break
        return found

    def contradicts(self, a: MergedComponent, b: MergedComponent, link: Link) -> bool:
        """Return whether views of both sides contradict each other more than neighbours do.

        Components have drifted, the more the longer the path from the link. A contradiction at the
        implied pose counts only if no pose within the drift removes it, and is ignored where the
        drift may exceed the range of convergence of an alignment.
        """
        overlap = against = 0.0
        T_a_b = self._merged.T_a_b(a, b, link)
        i, j = self._merged.ends(a, link)
        from_i, from_j = self._merged.path(a, i), self._merged.path(b, j)
        for first, second, T, at_implied in self._overlapping(a, b, T_a_b):
            drift = DRIFT * (from_i[first.index] + from_j[second.index])
            if drift > CONVERGENCE:
                continue
            seen = at_implied
            if seen.contradiction > self._contradiction:
                at = [Target(first.view, np.eye(4))]
                scale = self.usual.noise_scale
                aligned = align(second.view, at, T, _NEARBY, usual_scale=scale)
                if self._drifted(T, aligned.T_world_source, first.depth, drift):
                    near = agreement(
                        second.view, first.view, aligned.T_world_source, self_scaled(self.usual)
                    )
                    seen = min(seen, near, key=lambda found: found.contradiction)
            overlap += seen.overlap
            against += seen.violation + seen.clash
        limit = self._contradiction
        if self.is_near(a, b, T_a_b, _NEAR):
            # Contradictions come from moving objects or errors of the pose.
            limit = max(limit, _SAME_PLACE)
        return overlap > 0 and against / overlap > limit

    def is_near(self, a: MergedComponent, b: MergedComponent, T_a_b: Float64, far: float) -> bool:
        """Return whether the camera had no time to move far between both sides, and T_a_b agrees.

        `far` is a fraction of the depth, and rad. A pose further away than the camera can have
        moved is contradicted by the short time, not supported.
        """
        T = {**a.T, **transformed(b.T, T_a_b)}
        for c in a.T:
            for d in b.T:
                before, after = self._merged.in_time(c, d)
                elapsed = float(after.times[0] - before.times[-1])
                if before.recording != after.recording or elapsed < 0:
                    continue
                reach = self.speed * elapsed
                if reach[0] < far * before.depth and reach[1] < far:
                    between = motion_over(before, after, T)
                    metres = float(np.linalg.norm(between[:3, 3]))
                    if metres < far * before.depth and float(se3.angle(between)) < far:
                        return True
        return False

    def _drifted(self, T: Float64, other: Float64, depth: float, drift: float) -> bool:
        """Whether two poses differ by no more than drift and the error of a single link."""
        between = se3.inverse(T) @ other
        limit = drift + _LINK_ERROR
        return bool(np.linalg.norm(between[:3, 3]) <= limit * depth and se3.angle(between) <= limit)

    def confirming(
        self, a: MergedComponent, b: MergedComponent, T_a_b: Float64, known: list[Link], count: int
    ) -> list[Link]:
        """Return registrations of other view pairs, `count` at most, that agree with T_a_b."""
        seen = {frozenset((link.i, link.j)) for link in known}
        found = []
        for first, second, T, _ in self._overlapping(a, b, T_a_b)[:count]:
            if frozenset((first.index, second.index)) in seen:
                continue
            # Along degenerate directions an alignment stays at its guess, which confirms nothing.
            made = follow(second.view, first.view, T, usual=self.usual)
            link = link_of(first, second, made)
            if link is None or len(link.registration.unobservable):
                continue
            if not differ(link.T_i_j, T):
                found.append(replace(link, certain=False))
        return found

    def reachable(self, a: MergedComponent, b: MergedComponent, T_a_b: Float64) -> bool:
        """Return whether the camera had the time to move from one side to the other."""
        T = {**a.T, **transformed(b.T, T_a_b)}
        for c in a.T:
            for d in b.T:
                first, second = self._merged.in_time(c, d)
                if first.recording != second.recording:
                    continue
                between = motion_over(first, second, T)
                farthest = largest_motion(first, second)
                depth = first.depth
                if (
                    np.linalg.norm(between[:3, 3]) > farthest[0] + _NEAR * depth
                    or float(se3.angle(between)) > farthest[1] + _NEAR
                ):
                    return False
        return True


def link_of(first: View, second: View, found: Registration | None) -> Link | None:
    """Return a registration of two views as a link, None if it is not probable."""
    if found is None or not found.is_probable:
        return None
    return Link(first.index, second.index, found, found.stands_alone, found.how)


def _tracking_failures(stretches: Sequence[TrackedComponent]) -> int:
    """Number of components that end where the next frame of the recording begins another one."""
    first = {(s.recording, int(s.frames[0])) for s in stretches}
    return sum((s.recording, int(s.frames[-1]) + 1) in first for s in stretches)
