"""Loop closure between range images: places that the camera revisits."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, ClassVar

import numpy as np

from tofuse.engine.alignment import Registration, projective
from tofuse.engine.arrays import Float64
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.compute import run_all
from tofuse.engine.frames import Frame
from tofuse.engine.geometry import se3
from tofuse.engine.graph import LoopRecord
from tofuse.engine.loops.appearance import Appearance
from tofuse.engine.loops.candidates import MAX_OVERLAP_BETWEEN, CandidateSelector, LoopView, Pair
from tofuse.engine.loops.loops import (
    ClosedLoop,
    LoopDetector,
    Loops,
    PriorLoop,
    close_prior_loop,
    in_order,
)
from tofuse.engine.parts import part
from tofuse.engine.quantities import percent, probability
from tofuse.engine.search import (
    DISTINCT_M,
    SearchOptions,
    follow,
    pair_agreement,
    register_pair,
    verification,
)
from tofuse.engine.stored_views import PosedView, Spacing, ViewStore
from tofuse.engine.views import PreparedView


def degraded_neighbours(
    views: Sequence[PosedView[PreparedView]],
    before: Float64,
    after: Float64,
    suspects: frozenset[int],
) -> Iterator[tuple[int, int]]:
    """Yield the frame indices i, j of neighbouring views that agree less after loops were closed.

    Least squares puts the gap of a loop where registrations are least certain. If the images there
    fit the poses before better, the registration was right, and the error is elsewhere.

    Parameters
    ----------
    views
        N views, ascending.
    before, after
        (N, 4, 4) poses before and after.
    suspects
        Indices of the frames with uncertain registrations: only neighbours i, j with one of them
        in (i, j] are compared.
    """
    relative = [se3.inverse(poses[:-1]) @ poses[1:] for poses in (before, after)]
    for a, b, T, T_closed in zip(views[:-1], views[1:], *relative, strict=True):
        if suspects.isdisjoint(range(a.index + 1, b.index + 1)):
            continue
        compared = pair_agreement.Comparison.of(b.view, a.view)
        if compared.at(T_closed).score < compared.at(T).score - pair_agreement.MIN_LEAD:
            yield a.index, b.index


# The trajectory has drifted when a loop closes. Neighbouring pixels share their noise, so that all
# of them have hardly more information than every second one.
_LEVELS = (
    projective.Level(4, 15, 0.03, 0.1),
    projective.Level(2, 8, 0.005, 0.02),
    projective.Level(2, 8, 0.0, 0.0),
)
# Nearly without a prior.
_WEAK_PRIOR = projective.ProjectiveOptions(
    levels=_LEVELS, prior_m=3.0, prior_rad=3.0, constrained=1e6, common_tilt=0.0, common_slope=0.0
)
_REJECTED = "fits worse than is typical of this camera, or alignments from both ends disagree"
_TOO_FAR = "looks similar, but the trajectory can't have drifted that far"
# Selection of the views that are tried: neighbours overlap by most of an image.
_SPACING = Spacing(angle=0.15, distance=0.08, max_views=200)
# Maximum difference of the poses of two consistent loops: the drift between them, m and rad.
_CONSISTENT_M, _CONSISTENT_RAD = 0.15, 0.1
# Maximum number of degenerate directions of a loop; its covariance is wide there.
_MAX_DEGENERATE = 2
# Smallest overlap of an alignment, above what occurs by chance.
_MIN_OVERLAP = 0.3
# Pairs of neighbouring views from which the usual fit of this camera's views is learnt.
_MAX_LEARNT_PAIRS = 40
# Candidates are selected again if poses have moved by more: fraction of the depth plus rad.
_MAX_MOTION = 0.1


@part("loops", "revisits")
@dataclass(frozen=True)
class Revisits(Bounded, LoopDetector):
    """Registers views that overlap, according to the trajectory, after the camera left the place.

    A loop is registered from the relative pose of the trajectory (`search.follow`),
    and accepted if it is verified and constrained in most directions. The best of the other
    candidates are searched exhaustively (`register_pair`). The result of a search is accepted if
    its margin is large enough or another loop nearby is consistent with it: places may look
    similar, but two false loops are hardly consistent.

    Of more candidates than limits allow, those with the largest information gain are tried first
    (`candidates`). Otherwise laps that are already consistent, and so overlap most, would
    displace the one that is not. Searches continue while they succeed and gain information.

    Attributes
    ----------
    overlap
        Minimum overlap of a candidate, as a fraction of its pixels; lower it where places are
        revisited from other directions.
    per_view
        Maximum number of candidates of each view with the largest overlap; unless it is 0, the one
        with the largest gain is another candidate.
    searches
        Maximum number of unsuccessful searches for rejected candidates, for each 200 views: those
        with the largest gain, then overlap.
    similar_pairs
        Maximum number of pairs with similar descriptors, wherever they are on the trajectory, that
        are searched for each 200 views; 0 disables place recognition by appearance.
    max_drift
        Maximum drift of the trajectory, as a fraction of the path and of the rotation along it.
        Similar views that imply more are considered different places (perceptual aliasing).
    """

    overlap: Annotated[float, Bounds(MAX_OVERLAP_BETWEEN, 1)] = 0.4
    per_view: Annotated[int, Bounds(0)] = 2
    searches: Annotated[int, Bounds(0)] = 6
    similar_pairs: Annotated[int, Bounds(0)] = 6
    max_drift: Annotated[float, Bounds(0.001, 1)] = 0.2

    def start(
        self,
        seed: int,
        prior: Sequence[PriorLoop],
        views: ViewStore[PreparedView],
        search: SearchOptions | None = None,
        *,
        spacing: Spacing = _SPACING,
        appearance: Appearance | None = None,
    ) -> Loops:
        """See `LoopDetector.start`; deterministic.

        `spacing` selects the views that are tried, and `appearance` pairs of similar views.
        """
        appearance = appearance or Appearance(self.similar_pairs, drift=self.max_drift)
        return _RevisitLoops(self, prior, views, search or SearchOptions(), spacing, appearance)


class _RevisitLoops(Loops):
    needs_points: ClassVar[bool] = False

    def __init__(
        self,
        options: Revisits,
        prior: Sequence[PriorLoop],
        views: ViewStore[PreparedView],
        search: SearchOptions,
        spacing: Spacing,
        appearance: Appearance,
    ) -> None:
        self._options, self._search = options, search
        self._spacing = spacing
        self._selector = CandidateSelector(
            options.overlap, options.per_view, appearance, views.coarse
        )
        self._store = views
        self._chosen: ViewStore[PreparedView] = ViewStore(spacing)
        self._latest: int | None = None  # index of the latest frame
        # Of views only, as long recordings have many more frames.
        self._poses: dict[int, Float64] = {}
        self._prior_loops = prior
        self._decisions: dict[Pair, ClosedLoop] = {}
        self._fit_statistics = verification.FitStatistics()
        self._learnt: set[Pair] = set()
        # Accepted by an earlier `finish`, at other poses.
        self._closed: dict[Pair, ClosedLoop] = {}

    def push(self, view: Frame, T_component_camera: Float64) -> None:
        """See `Loops.push`."""
        self._latest = view.index
        newest = self._store.views[-1] if self._store.views else None
        if newest is not None and newest.index == view.index:
            self._poses[view.index] = T_component_camera
            self._chosen.push_posed(newest)

    @property
    def is_long(self) -> bool:
        """See `Loops.is_long`."""
        return len(self._chosen.views) > self._spacing.max_views

    def candidates_change(self, poses: Mapping[int, Float64]) -> bool:
        """See `Loops.candidates_change`."""
        posed = self._chosen.of(poses)
        before = np.array([self._poses[p.index] for p in posed])
        change = se3.inverse(before) @ np.array([poses[p.index] for p in posed])
        if se3.change_of_view(change, np.array([p.depth for p in posed])).max() <= _MAX_MOTION:
            return False
        # With other initial poses, rejected loops may be accepted.
        self._decisions = {p: c for p, c in self._decisions.items() if c.record.accepted}
        return True

    def detection_job(self) -> Callable[[], list[ClosedLoop]] | None:
        """See `Loops.detection_job`. Only views of the same component are compared so far."""
        posed = self._chosen.views
        if not posed or posed[-1].index != self._latest:
            return None
        posed = [p for p in posed if p.component == posed[-1].component]
        by_index = {p.index: p for p in posed}
        pairs = [(by_index[i], by_index[j]) for i, j in self._selector.revisits_of_newest(posed)]
        if not pairs:
            return None

        def work() -> list[ClosedLoop]:
            self._learn(posed)
            return [self._confirm(*pair) for pair in pairs]

        return work

    def finish(
        self, poses: Mapping[int, Float64], covariances: Mapping[int, Float64]
    ) -> list[ClosedLoop]:
        """See `Loops.finish`. Given loops replace detected ones."""
        posed = self._chosen.of(poses)
        views = {p.index: p for p in posed}
        stored = {p.index: p for p in self._store.of(poses)}
        self._poses = {index: poses[index].copy() for index in views | stored}
        self._learn(posed)
        selector = self._selector
        selector.set_trajectory(posed, poses, covariances)
        selector.condition(_accepted(self._decisions | self._closed))
        candidates = selector.overlapping()
        confirmed = self._confirm_all([(views[i], views[j]) for i, j in candidates])
        closed = {pair: loop for pair, loop in self._closed.items() if poses.keys() >= set(pair)}
        closed |= {(loop.record.i, loop.record.j): loop for loop in confirmed}
        self._search_rejected(views, candidates, closed)
        self._closed = {pair: closed[pair] for pair in _accepted(closed)}
        for loop in self._prior_loops:
            closed[loop.i, loop.j] = close_prior_loop(
                loop, stored, lambda i, j: self._confirm(stored[i], stored[j])
            )
        return in_order(closed)

    def _search_rejected(
        self,
        views: Mapping[int, LoopView],
        candidates: Sequence[Pair],
        closed: dict[Pair, ClosedLoop],
    ) -> None:
        """Search rejected candidates and similar views; `closed` receives the results."""
        selector, accepted = self._selector, _accepted(closed)
        selector.condition(accepted)
        plausible, implausible = selector.similar(accepted)
        similar = [pair for pair in plausible if pair not in closed]
        closed |= {
            pair: ClosedLoop(LoopRecord(*pair, False, _TOO_FAR))
            for pair in implausible
            if pair not in closed
        }
        rejected = [pair for pair in candidates if not closed[pair].record.accepted]
        failures = self._options.searches * selector.budgets
        chosen = selector.most_informative(rejected, failures)
        while chosen or similar:
            closed |= self._search_pairs([*chosen, *similar], views, closed, similar)
            failures -= sum(not closed[pair].record.accepted for pair in chosen)
            rejected = [pair for pair in rejected if pair not in chosen]
            chosen = selector.most_informative(rejected, failures, min_gain=1.0)
            similar = []

    def _learn(self, posed: Sequence[LoopView]) -> None:
        """Learn the usual fit of neighbouring views of this camera."""
        for a, b in itertools.pairwise(posed):
            pair = a.index, b.index
            if (
                a.component != b.component
                or pair in self._learnt
                or len(self._learnt) >= _MAX_LEARNT_PAIRS
            ):
                continue
            self._learnt.add(pair)
            guess = se3.inverse(a.T_component_camera) @ b.T_component_camera
            target = [projective.Target(a.view.without_caches())]
            scale = self._fit_statistics.noise_scale
            aligned = projective.align(
                b.view.without_caches(), target, guess, _WEAK_PRIOR, usual_scale=scale
            )
            if aligned.overlap >= _MIN_OVERLAP:
                self._fit_statistics.learn(aligned, b.view.depth)

    def _confirm(self, target: LoopView, source: LoopView) -> ClosedLoop:
        """Register the later view with the earlier one in both directions, once for each pair."""
        return self._confirm_all([(target, source)])[0]

    def _confirm_all(self, pairs: Sequence[tuple[LoopView, LoopView]]) -> list[ClosedLoop]:
        """As `_confirm`, for many pairs (target, source)."""
        new = [(a, b) for a, b in pairs if (a.index, b.index) not in self._decisions]
        registrations = run_all(
            [partial(self._register_near, target, source) for target, source in new]
        )
        for (a, b), registration in zip(new, registrations, strict=True):
            pair = a.index, b.index
            self._decisions[pair] = self._decide(pair, registration)
        return [self._decisions[a.index, b.index] for a, b in pairs]

    def _register_near(self, target: LoopView, source: LoopView) -> Registration | None:
        """Register two views from the initial guess of the trajectory."""
        guess = se3.inverse(self._poses[target.index]) @ self._poses[source.index]
        # Without caches, or the data derived for the comparison would stay in memory.
        views = source.view.without_caches(), target.view.without_caches()
        return follow(*views, guess, fit_statistics=self._fit_statistics)

    def _decide(self, pair: Pair, registration: Registration | None) -> ClosedLoop:
        """Accept or reject the registration of frames (i, j)."""
        if registration is None:
            return ClosedLoop(LoopRecord(*pair, False, _REJECTED))
        reason = self._rejection_reason(registration)
        explanation = (
            reason or f"right with a probability of {probability(registration.probability)}"
        )
        record = LoopRecord.of(pair, not reason, explanation, registration)
        return ClosedLoop.of(record, registration)

    def _search_pairs(
        self,
        pairs: Sequence[Pair],
        posed: Mapping[int, LoopView],
        closed: Mapping[Pair, ClosedLoop],
        similar: Sequence[Pair],
    ) -> dict[Pair, ClosedLoop]:
        """Register views by exhaustive search, without a guess.

        Returns accepted loops, and rejected ones with the reason.
        """
        registrations, margins = {}, {}
        reasons = {p: "looks similar" if p in similar else closed[p].record.reason for p in pairs}
        for i, j in pairs:
            registration = register_pair(
                posed[j].view,
                posed[i].view,
                fit_statistics=self._fit_statistics,
                options=self._search,
                rival_m=DISTINCT_M,
            )
            if registration is None:
                reasons[i, j] += "; there are too few surfaces for a search"
                continue
            margins[i, j] = registration.margin
            if not registration.is_probable:
                reasons[i, j] += f"; by a search {registration.reason}"
                continue
            if (i, j) in similar and not self._selector.is_plausible(
                i, j, registration.T_target_source
            ):
                reasons[i, j] = _TOO_FAR
                continue
            registrations[i, j] = registration
        measured = {pair: loop.T_i_j for pair, loop in closed.items() if loop.T_i_j is not None}
        measured |= {
            pair: registration.T_target_source for pair, registration in registrations.items()
        }
        accepted = {}
        for (i, j), registration in registrations.items():
            T_i_j = measured[i, j]
            isolated = not any(self._consistent(i, j, T_i_j, *p, T) for p, T in measured.items())
            if isolated and not registration.is_decisive:
                reasons[i, j] += f"; by a search {registration.reason}, and no other loop agrees"
                continue
            reason = registration.how if isolated else f"{registration.how}; another loop agrees"
            if (i, j) in similar:
                reason = f"looks similar, {reason}"
            record = LoopRecord.of((i, j), True, reason, registration)
            accepted[i, j] = ClosedLoop.of(record, registration)
        rejected_loops = {}
        for p in pairs:
            record = LoopRecord(*p, False, "") if p in similar else closed[p].record
            rejected_loops[p] = ClosedLoop(
                replace(record, reason=reasons[p], margin=margins.get(p))
            )
        return rejected_loops | accepted

    def _consistent(self, i: int, j: int, T_i_j: Float64, k: int, m: int, T_k_m: Float64) -> bool:
        """Whether the loop (k, m) implies the same pose of j in i as the loop (i, j)."""
        if (i, j) == (k, m):
            return False
        poses = self._poses
        T_i_k = se3.inverse(poses[i]) @ poses[k]
        T_m_j = se3.inverse(poses[m]) @ poses[j]
        difference = se3.inverse(T_i_j) @ T_i_k @ T_k_m @ T_m_j
        return se3.is_within(difference, _CONSISTENT_M, _CONSISTENT_RAD)

    def _rejection_reason(self, registration: Registration) -> str:
        if registration.overlap is not None and registration.overlap < _MIN_OVERLAP:
            return f"only {percent(registration.overlap)} of the points project into the other view"
        if len(registration.unobservable) > _MAX_DEGENERATE:
            return f"{len(registration.unobservable)} directions are degenerate"
        return "" if registration.believed else registration.reason


def _accepted(closed: Mapping[Pair, ClosedLoop]) -> list[Pair]:
    return [pair for pair, loop in closed.items() if loop.record.accepted]
