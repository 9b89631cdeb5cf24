"""Loop closure between range images: places that the camera revisits."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import numpy as np

from tofuse.arrays import Float32, Float64
from tofuse.bounds import Bounded, Bounds
from tofuse.geometry import se3
from tofuse.kernels.executors import executor
from tofuse.parts import part
from tofuse.posegraph.appearance import MAX_VIEW_DISTANCE, Appearance
from tofuse.posegraph.covariances import relative_covariance
from tofuse.posegraph.graph import LoopRecord
from tofuse.posegraph.information_gain import InformationGain
from tofuse.posegraph.loops import (
    ClosedLoop,
    LoopDetector,
    Loops,
    PriorLoop,
    close_prior_loop,
    in_order,
)
from tofuse.posegraph.view_store import (
    CoarseView,
    HasCoarseView,
    PosedView,
    Spacing,
    Spilled,
    SpilledCoarseView,
    ViewStore,
    overlaps,
    sampled_points,
)
from tofuse.recordings.frames import Frame
from tofuse.registration.base import Registration
from tofuse.registration.prepared_view import PreparedView
from tofuse.registration.projective import Level, ProjectiveOptions, Target, align
from tofuse.registration.search import DISTINCT_M, SearchOptions
from tofuse.registration.verification import FitStatistics
from tofuse.registration.view_descriptor import view_descriptor
from tofuse.registration.view_pair import follow, register_pair

View = PosedView[PreparedView]

_POINTS = 600
# The trajectory has drifted when a loop closes. Neighbouring pixels share their noise, so that all
# of them have hardly more information than every second one.
_LEVELS = (Level(4, 15, 0.03, 0.1), Level(2, 8, 0.005, 0.02), Level(2, 8, 0.0, 0.0))
# Nearly without a prior.
_WEAK_PRIOR = ProjectiveOptions(
    levels=_LEVELS, prior_m=3.0, prior_rad=3.0, constrained=1e6, common_tilt=0.0, common_slope=0.0
)
_REJECTED = "fits worse than is typical of this camera, or alignments from both ends disagree"
_TOO_FAR = "looks similar, but the trajectory can't have drifted that far"
# Selection of the views that are tried: neighbours overlap by most of an image.
_SPACING = Spacing(angle=0.15, distance=0.08, max_views=200)
# A candidate is a revisit if some view in between overlaps either view by less than this.
_MAX_OVERLAP_BETWEEN = 0.1
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
# Number of views that the limits on searches refer to.
_VIEWS_PER_BUDGET = 200


@dataclass(frozen=True, eq=False)
class _Entry(SpilledCoarseView):
    """Data for the selection of candidates: little memory per view."""

    descriptor: Float32


@part("loops", "revisits")
@dataclass(frozen=True)
class Revisits(Bounded, LoopDetector):
    """Registers views that overlap, according to the trajectory, after the camera left the place.

    A loop is registered from the relative pose of the trajectory (`registration.view_pair.follow`),
    and accepted if it is verified and constrained in most directions. The best of the other
    candidates are searched exhaustively (`register_pair`). The result of a search is accepted if
    its margin is large enough or another loop nearby is consistent with it: places may look
    similar, but two false loops are hardly consistent.

    Of more candidates than limits allow, those with the largest information gain are tried first
    (`information_gain`). Otherwise laps that are already consistent, and so overlap most, would
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

    overlap: Annotated[float, Bounds(_MAX_OVERLAP_BETWEEN, 1)] = 0.4
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

    def candidates(
        self,
        views: Sequence[HasCoarseView],
        poses: Float64,
        *,
        first: int = 0,
        gain: InformationGain | None = None,
    ) -> dict[tuple[int, int], float]:
        """Return the overlaps of the views that may form a loop, by their positions (i, j), i < j.

        Parameters
        ----------
        views
            N views.
        poses
            (N, 4, 4) T_world_camera.
        first
            Smallest j.
        gain
            Information gain of loops between the views, if available.
        """
        gain = gain or InformationGain(np.zeros(len(views)))
        pairs, overlap_of = overlaps(views, poses, _MAX_OVERLAP_BETWEEN, first=first)
        loops: dict[tuple[int, int], float] = {}
        ends = np.searchsorted(pairs[:, 1], np.arange(len(views) + 1))
        for j in range(first, len(views)):
            rows = slice(ends[j], ends[j + 1])
            partners, overlap = pairs[rows, 0], overlap_of[rows]
            # The camera never left the unbroken run of partners up to this view.
            overlapping = np.zeros(j + 1, bool)
            overlapping[partners], overlapping[j] = True, True
            last_gap = int(np.flatnonzero(~overlapping)[-1]) if not overlapping.all() else -1
            revisited = (partners < last_gap) & (overlap >= self.overlap)
            if not revisited.any():
                continue
            partners, overlap = partners[revisited], overlap[revisited]
            largest_overlap = np.argsort(-overlap, kind="stable")[: self.per_view]
            largest_gain = np.lexsort((-overlap, -gain.of(partners, j)))[: min(1, self.per_view)]
            selected = np.union1d(largest_overlap, largest_gain)
            loops |= {(int(partners[k]), j): float(overlap[k]) for k in selected}
        return loops


class _RevisitLoops(Loops):
    points: ClassVar[bool] = False

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
        self._spacing, self._appearance = spacing, appearance
        self._store = views
        self._chosen: ViewStore[PreparedView] = ViewStore(spacing)
        self._latest: int | None = None  # index of the latest frame
        # Of views only, as long recordings have many more frames.
        self._poses: dict[int, Float64] = {}
        self._prior_loops = prior
        self._entries: dict[int, _Entry] = {}
        self._decisions: dict[tuple[int, int], ClosedLoop] = {}
        self._fit_statistics = FitStatistics()
        self._learnt: set[tuple[int, int]] = set()
        self._covariances: dict[int, Float64] = {}
        self._path_length: dict[int, Float64] = {}
        self._variance: dict[int, float] = {}  # of the positions by odometry, m^2
        # Accepted by an earlier `finish`, at other poses.
        self._closed: dict[tuple[int, int], ClosedLoop] = {}

    def push(self, view: Frame, T_component_camera: Float64) -> None:
        """See `Loops.push`."""
        self._latest = view.index
        newest = self._store.views[-1] if self._store.views else None
        if newest is not None and newest.index == view.index:
            self._poses[view.index] = T_component_camera
            self._chosen.push_posed(newest)

    @property
    def repeat_worthwhile(self) -> bool:
        """See `Loops.repeat_worthwhile`."""
        return len(self._chosen.views) > self._spacing.max_views

    def candidates_change(self, poses: Mapping[int, Float64]) -> bool:
        """See `Loops.candidates_change`."""
        posed = self._chosen.of(poses)
        before = np.array([self._poses[p.index] for p in posed])
        change = se3.inverse(before) @ np.array([poses[p.index] for p in posed])
        depth = np.array([p.depth for p in posed])
        motion = np.linalg.norm(change[:, :3, 3], axis=1) / depth + np.asarray(se3.angle(change))
        if motion.max() <= _MAX_MOTION:
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
        poses = np.stack([p.T_component_camera for p in posed])
        candidates = self._options.candidates(self._entries_of(posed), poses, first=len(posed) - 1)
        pairs = [(posed[i], posed[j]) for i, j in candidates]
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
        posed, path_lengths = self._chosen.of(poses), _path_lengths(poses)
        stored = {p.index: p for p in self._store.of(poses)}
        indices = {p.index for p in posed} | stored.keys()
        self._poses = {index: poses[index].copy() for index in indices}
        self._covariances = {index: covariances[index].copy() for index in indices}
        self._path_length = {index: path_lengths[index].copy() for index in indices}
        del path_lengths
        self._learn(posed)
        view_poses = np.array([poses[p.index] for p in posed]).reshape(-1, 4, 4)
        entries = self._entries_of(posed)
        gain = self._gain(posed, self._decisions | self._closed)
        overlap = self._options.candidates(entries, view_poses, gain=gain)
        confirmed = self._confirm_all([(posed[i], posed[j]) for i, j in overlap])
        closed = {pair: loop for pair, loop in self._closed.items() if poses.keys() >= set(pair)}
        closed |= {(loop.record.i, loop.record.j): loop for loop in confirmed}
        self._search_rejected(posed, entries, overlap, closed)
        self._closed = {p: c for p, c in closed.items() if c.record.accepted}
        for loop in self._prior_loops:
            closed[loop.i, loop.j] = close_prior_loop(
                loop, stored, lambda i, j: self._confirm(stored[i], stored[j])
            )
        return in_order(closed)

    def _search_rejected(
        self,
        posed: Sequence[View],
        entries: Sequence[_Entry],
        overlap: Mapping[tuple[int, int], float],
        closed: dict[tuple[int, int], ClosedLoop],
    ) -> None:
        """Search rejected candidates and similar views; `closed` receives the results.

        `overlap` is that of the candidates, by the positions of the views.
        """
        gain = self._gain(posed, closed)
        budget_factor = max(1, -(-len(posed) // _VIEWS_PER_BUDGET))
        similar, implausible = self._similar(posed, entries, gain, closed, budget_factor)
        closed |= {p: ClosedLoop(LoopRecord(*p, False, _TOO_FAR)) for p in implausible}
        frames = {pair: (posed[pair[0]].index, posed[pair[1]].index) for pair in overlap}
        rejected = [pair for pair in overlap if not closed[frames[pair]].record.accepted]
        failures = self._options.searches * budget_factor
        chosen = _largest_gain(rejected, overlap, gain, failures)
        by_index = {p.index: p for p in posed}
        while chosen or similar:
            requested = [frames[pair] for pair in chosen]
            closed |= self._search_pairs([*requested, *similar], by_index, closed, similar)
            failures -= sum(not closed[pair].record.accepted for pair in requested)
            rejected = [pair for pair in rejected if pair not in chosen]
            chosen = _largest_gain(rejected, overlap, gain, failures, min_gain=1.0)
            similar = []

    def _gain(
        self, posed: Sequence[View], closed: Mapping[tuple[int, int], ClosedLoop]
    ) -> InformationGain:
        """Return the information gain of loops between the views, given the `closed` loops."""
        for p in posed:  # the first covariances are those of odometry; NaN where not constrained
            variance = np.trace(self._covariances[p.index][:3, :3])
            self._variance.setdefault(p.index, float(np.nan_to_num(variance)))
        gain = InformationGain(np.array([self._variance[p.index] for p in posed]))
        position = {p.index: k for k, p in enumerate(posed)}
        for (i, j), loop in closed.items():
            if loop.record.accepted and i in position and j in position:
                gain.add(position[i], position[j])
        return gain

    def _entries_of(self, posed: Sequence[View]) -> list[_Entry]:
        """The entries of these views, each computed once."""
        previous = self._entries
        self._entries = {p.index: previous.get(p.index) or self._entry_of(p) for p in posed}
        return list(self._entries.values())

    def _entry_of(self, posed: View) -> _Entry:
        surface = posed.view.without_caches()
        coarse = CoarseView.of(surface, sampled_points(surface, _POINTS))
        spilled = Spilled(coarse, self._store.coarse)
        return _Entry(coarse.centroid, spilled, view_descriptor(surface))

    def _learn(self, posed: Sequence[View]) -> None:
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
            target = [Target(a.view.without_caches(), np.eye(4))]
            scale = self._fit_statistics.noise_scale
            aligned = align(b.view.without_caches(), target, guess, _WEAK_PRIOR, usual_scale=scale)
            if aligned.overlap >= _MIN_OVERLAP:
                self._fit_statistics.learn(aligned, b.view.depth)

    def _confirm(self, target: View, source: View) -> ClosedLoop:
        """Register the later view with the earlier one in both directions, once for each pair."""
        pair = target.index, source.index
        if pair not in self._decisions:
            self._decisions[pair] = self._decide(
                pair, register_near(*self._registration_arguments(target, source))
            )
        return self._decisions[pair]

    def _confirm_all(self, pairs: Sequence[tuple[View, View]]) -> list[ClosedLoop]:
        """As `_confirm`, for many pairs (target, source)."""
        new = [(a, b) for a, b in pairs if (a.index, b.index) not in self._decisions]
        registrations = executor().map(
            register_near, len(new), lambda k: self._registration_arguments(*new[k])
        )
        for (a, b), registration in zip(new, registrations, strict=True):
            pair = a.index, b.index
            self._decisions[pair] = self._decide(pair, registration)
        return [self._decisions[a.index, b.index] for a, b in pairs]

    def _registration_arguments(
        self, target: View, source: View
    ) -> tuple[PreparedView, PreparedView, Float64, FitStatistics]:
        """Arguments of `register_near`, with the initial guess of the trajectory."""
        guess = se3.inverse(self._poses[target.index]) @ self._poses[source.index]
        # Without caches, or the data derived for the comparison would stay in memory.
        return (
            source.view.without_caches(),
            target.view.without_caches(),
            guess,
            self._fit_statistics,
        )

    def _decide(self, pair: tuple[int, int], registration: Registration | None) -> ClosedLoop:
        """Accept or reject the registration of frames (i, j)."""
        if registration is None:
            return ClosedLoop(LoopRecord(*pair, False, _REJECTED))
        reason = self._rejection_reason(registration)
        explanation = reason or f"right with a probability of {registration.probability:.0%}"
        record = LoopRecord.of(pair, not reason, explanation, registration)
        return ClosedLoop.of(record, registration)

    def _similar(
        self,
        posed: Sequence[View],
        entries: Sequence[_Entry],
        gain: InformationGain,
        closed: Mapping[tuple[int, int], ClosedLoop],
        budget_factor: int,
    ) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
        """Frames (i, j) of similar views that aren't candidates yet: plausible and implausible."""
        position = {p.index: k for k, p in enumerate(posed)}
        accepted = [
            (position[i], position[j]) for (i, j), loop in closed.items() if loop.record.accepted
        ]
        appearance = replace(self._appearance, pairs=self._appearance.pairs * budget_factor)
        candidates = appearance.candidates(
            [s.descriptor for s in entries],
            lambda i, j: self._plausible(posed[i], posed[j], np.eye(4), MAX_VIEW_DISTANCE),
            accepted,
            lambda i, j: float(gain.of(i, j)),
        )
        frames = [[(posed[i].index, posed[j].index) for i, j in pairs] for pairs in candidates]
        return (
            [pair for pair in frames[0] if pair not in closed],
            [pair for pair in frames[1] if pair not in closed],
        )

    def _search_pairs(
        self,
        pairs: Sequence[tuple[int, int]],
        posed: Mapping[int, View],
        closed: Mapping[tuple[int, int], ClosedLoop],
        similar: Sequence[tuple[int, int]],
    ) -> dict[tuple[int, int], ClosedLoop]:
        """Register views by exhaustive search, without a guess.

        Returns accepted loops, and rejected ones with the reason.
        """
        registrations, margins = {}, {}
        reasons = {p: "looks similar" if p in similar else closed[p].record.reason for p in pairs}
        results = executor().map(
            register_anywhere,
            len(pairs),
            lambda k: (
                *(posed[n].view for n in reversed(pairs[k])),
                self._fit_statistics,
                self._search,
            ),
            large=True,
        )
        for (i, j), registration in zip(pairs, results, strict=True):
            if registration is None:
                reasons[i, j] += "; there are too few surfaces for a search"
                continue
            margins[i, j] = registration.margin
            if not registration.is_probable:
                reasons[i, j] += f"; by a search {registration.reason}"
                continue
            if (i, j) in similar and not self._plausible(
                posed[i], posed[j], registration.T_target_source
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
            if isolated and not registration.stands_alone:
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

    def _plausible(self, target: View, source: View, T: Float64, tolerance: float = 0.0) -> bool:
        """Whether the drift implied by T_target_source `T` (4, 4) is plausible."""
        T_target_source = se3.inverse(self._poses[target.index]) @ self._poses[source.index]
        correction = se3.inverse(T_target_source) @ T
        depth = 0.5 * (target.depth + source.depth)
        C = relative_covariance(
            T_target_source, self._covariances[target.index], self._covariances[source.index]
        )
        path = self._path_length[source.index] - self._path_length[target.index]
        length, rotation = path.tolist()
        return self._appearance.plausible(correction, length, rotation, depth, C, tolerance)

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
            return f"only {registration.overlap:.0%} of the points project into the other view"
        if len(registration.unobservable) > _MAX_DEGENERATE:
            return f"{len(registration.unobservable)} directions are degenerate"
        return "" if registration.believed else registration.reason


def register_near(
    source: PreparedView, target: PreparedView, guess: Float64, fit_statistics: FitStatistics
) -> Registration | None:
    """Register two views from the guess (4, 4) T_target_source of the trajectory."""
    return follow(source, target, guess, fit_statistics=fit_statistics)


def register_anywhere(
    source: PreparedView,
    target: PreparedView,
    fit_statistics: FitStatistics,
    options: SearchOptions,
) -> Registration | None:
    """Register two views by exhaustive search, without a guess."""
    return register_pair(
        source, target, fit_statistics=fit_statistics, options=options, rival_m=DISTINCT_M
    )


def _largest_gain(
    pairs: Sequence[tuple[int, int]],
    overlap: Mapping[tuple[int, int], float],
    gain: InformationGain,
    count: int,
    *,
    min_gain: float = 0.0,
) -> list[tuple[int, int]]:
    """Choose pairs of views greedily: each with the largest gain given those before, then overlap.

    `min_gain` is the smallest gain.
    """
    remaining = list(pairs)
    chosen: list[tuple[int, int]] = []
    while remaining and len(chosen) < count:
        gains = gain.of(*np.transpose(remaining))
        best = max(range(len(remaining)), key=lambda k: (gains[k], overlap[remaining[k]]))
        if gains[best] < min_gain:
            break
        chosen.append(remaining.pop(best))
        gain.add(*chosen[-1])
    return chosen


def _path_lengths(poses: Mapping[int, Float64]) -> dict[int, Float64]:
    """(2,) path length, m, and accumulated rotation, rad, from the first frame to each."""
    indices = sorted(poses)
    trajectory = np.stack([poses[k] for k in indices])
    steps = se3.inverse(trajectory[:-1]) @ trajectory[1:]
    lengths = np.concatenate([np.zeros((1, 2)), np.cumsum(se3.lengths(steps), axis=0)])
    return dict(zip(indices, lengths, strict=True))
