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
from tofuse.posegraph.appearance import ALIKE, Appearance
from tofuse.posegraph.covariances import relative_covariance
from tofuse.posegraph.graph import LoopRecord
from tofuse.posegraph.information_gain import InformationGain
from tofuse.posegraph.loops import (
    ClosedLoop,
    GivenLoop,
    LoopDetector,
    Loops,
    given_loop,
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
_NEAR = (Level(4, 15, 0.03, 0.1), Level(2, 8, 0.005, 0.02), Level(2, 8, 0.0, 0.0))
# Nearly without a prior.
_WEAK_PRIOR = ProjectiveOptions(
    levels=_NEAR, prior_m=3.0, prior_rad=3.0, constrained=1e6, common_tilt=0.0, common_slope=0.0
)
_REJECTED = "fits worse than is typical of this camera, or alignments from both ends disagree"
_TOO_FAR = "looks similar, but the trajectory can't have drifted that far"
# Selection of the views that are tried: neighbours overlap by most of an image.
_SPACING = Spacing(angle=0.15, distance=0.08, most=200)
# A candidate revisits a place if some view in between overlaps either view by less than this.
_MAX_APART = 0.1
# Maximum difference of the poses of two consistent loops: the drift between them, m and rad.
_SAME_M, _SAME_RAD = 0.15, 0.1
# Maximum number of degenerate directions of a loop; its covariance is wide there.
_MAX_DEGENERATE = 2
# Smallest overlap of an alignment, above what occurs by chance.
_MIN_OVERLAP = 0.3
# Pairs of neighbouring views from which the usual fit of this camera's views is learnt.
_LEARN = 40
# Candidates are selected anew if poses have moved by more: fraction of the depth plus rad.
_MAX_MOTION = 0.1
# Number of views that the limits on searches refer to.
_VIEWS_PER_BUDGET = 200


@dataclass(frozen=True, eq=False)
class _Entry(SpilledCoarseView):
    """What candidates are selected by: little memory per view."""

    descriptor: Float32


@part("loops", "revisits")
@dataclass(frozen=True)
class Revisits(Bounded, LoopDetector):
    """Registers views that overlap again, according to the trajectory, after they did not.

    A loop is registered from the relative pose of the trajectory (`registration.view_pair.follow`),
    and accepted if it is verified and constrained in most directions. The best of the other
    candidates are searched exhaustively (`register_pair`). The result of a search is accepted if
    its margin is large enough or another loop nearby is consistent with it: places may look alike,
    but not twice in the same way.

    Of more candidates than limits allow, those with the largest information gain are tried first
    (`information_gain`). Otherwise the laps of a camera that agree already, and so overlap most,
    would displace the one that does not. Searches go on while they succeed and gain something.

    Attributes
    ----------
    overlap
        Minimum overlap of a candidate, as a fraction of its pixels.
    per_view
        Maximum number of candidates of each view with the largest overlap; unless it is 0, the one
        with the largest gain is another candidate.
    searches
        Maximum number of rejected candidates that are searched in vain, for each 200 views: those
        with the largest gain, then overlap.
    similar_pairs
        Maximum number of pairs with similar descriptors, wherever they are on the trajectory, that
        are searched for each 200 views; 0 disables place recognition by appearance.
    max_drift
        Maximum drift of the trajectory, as a fraction of the path and of the rotation along it.
        Similar views that imply more are taken for different places (perceptual aliasing).
    """

    overlap: Annotated[float, Bounds(_MAX_APART, 1)] = 0.4
    per_view: Annotated[int, Bounds(0)] = 2
    searches: Annotated[int, Bounds(0)] = 6
    similar_pairs: Annotated[int, Bounds(0)] = 6
    max_drift: Annotated[float, Bounds(0.001, 1)] = 0.2

    def start(
        self,
        seed: int,
        given: Sequence[GivenLoop],
        views: ViewStore[PreparedView],
        search: SearchOptions | None = None,
        *,
        spacing: Spacing = _SPACING,
        appearance: Appearance | None = None,
    ) -> Loops:
        """See `LoopDetector.start`; deterministic.

        `spacing` selects the views that are tried, and `appearance` those that look alike.
        """
        appearance = appearance or Appearance(self.similar_pairs, drift=self.max_drift)
        return _RevisitLoops(self, given, views, search or SearchOptions(), spacing, appearance)

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
            Information gain of loops between the views, if it is known.
        """
        gain = gain or InformationGain(np.zeros(len(views)))
        pairs, overlap_of = overlaps(views, poses, _MAX_APART, first=first)
        found: dict[tuple[int, int], float] = {}
        ends = np.searchsorted(pairs[:, 1], np.arange(len(views) + 1))
        for j in range(first, len(views)):
            mine = slice(ends[j], ends[j + 1])
            partners, overlap = pairs[mine, 0], overlap_of[mine]
            # The camera never left the unbroken run of partners up to this view.
            seen = np.zeros(j + 1, bool)
            seen[partners], seen[j] = True, True
            start = int(np.flatnonzero(~seen)[-1]) if not seen.all() else -1
            again = (partners < start) & (overlap >= self.overlap)
            if not again.any():
                continue
            partners, overlap = partners[again], overlap[again]
            chosen = np.argsort(-overlap, kind="stable")[: self.per_view]
            largest = np.lexsort((-overlap, -gain.of(partners, j)))[: min(1, self.per_view)]
            both = np.union1d(chosen, largest)
            found |= {(int(partners[k]), j): float(overlap[k]) for k in both}
        return found


class _RevisitLoops(Loops):
    points: ClassVar[bool] = False

    def __init__(
        self,
        options: Revisits,
        given: Sequence[GivenLoop],
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
        self._given_loops = given
        self._seen: dict[int, _Entry] = {}
        self._confirmed: dict[tuple[int, int], ClosedLoop] = {}
        self._usual = FitStatistics()
        self._learnt: set[tuple[int, int]] = set()
        self._covariances: dict[int, Float64] = {}
        self._path_length: dict[int, Float64] = {}
        self._variance: dict[int, float] = {}  # of the positions by odometry, m^2
        # Of an earlier `finish`, at other poses.
        self._closed: dict[tuple[int, int], ClosedLoop] = {}

    def push(self, view: Frame, T_component_camera: Float64) -> None:
        """See `Loops.push`."""
        self._latest = view.index
        newest = self._store.views[-1] if self._store.views else None
        if newest is not None and newest.index == view.index:
            self._poses[view.index] = T_component_camera
            self._chosen.push_posed(newest)

    @property
    def many(self) -> bool:
        """See `Loops.many`."""
        return len(self._chosen.views) > self._spacing.most

    def candidates_change(self, poses: Mapping[int, Float64]) -> bool:
        """See `Loops.candidates_change`."""
        posed = self._chosen.of(poses)
        before = np.array([self._poses[p.index] for p in posed])
        between = se3.inverse(before) @ np.array([poses[p.index] for p in posed])
        depth = np.array([p.depth for p in posed])
        off = np.linalg.norm(between[:, :3, 3], axis=1) / depth + np.asarray(se3.angle(between))
        if off.max() <= _MAX_MOTION:
            return False
        # From other guesses, rejected loops may fit.
        self._confirmed = {p: c for p, c in self._confirmed.items() if c.record.accepted}
        return True

    def detection_job(self) -> Callable[[], list[ClosedLoop]] | None:
        """See `Loops.detection_job`. So far, poses are comparable only within a component."""
        posed = self._chosen.views
        if not posed or posed[-1].index != self._latest:
            return None
        posed = [p for p in posed if p.component == posed[-1].component]
        poses = np.stack([p.T_component_camera for p in posed])
        pairs = self._options.candidates(self._views(posed), poses, first=len(posed) - 1)
        ends = [(posed[i], posed[j]) for i, j in pairs]
        if not ends:
            return None

        def work() -> list[ClosedLoop]:
            self._learn(posed)
            return [self._confirm(*pair) for pair in ends]

        return work

    def finish(
        self, poses: Mapping[int, Float64], covariances: Mapping[int, Float64]
    ) -> list[ClosedLoop]:
        """See `Loops.finish`. Given loops replace detected ones."""
        posed, path = self._chosen.of(poses), _path_lengths(poses)
        known = {p.index: p for p in self._store.of(poses)}
        views = {p.index for p in posed} | known.keys()
        self._poses = {index: poses[index].copy() for index in views}
        self._covariances = {index: covariances[index].copy() for index in views}
        self._path_length = {index: path[index].copy() for index in views}
        del path
        self._learn(posed)
        at = np.array([poses[p.index] for p in posed]).reshape(-1, 4, 4)
        seen = self._views(posed)
        gain = self._gain(posed, self._confirmed | self._closed)
        overlap = self._options.candidates(seen, at, gain=gain)
        found = self._confirm_all([(posed[i], posed[j]) for i, j in overlap])
        closed = {pair: loop for pair, loop in self._closed.items() if poses.keys() >= set(pair)}
        closed |= {(loop.record.i, loop.record.j): loop for loop in found}
        self._search_rejected(posed, seen, overlap, closed)
        self._closed = {p: c for p, c in closed.items() if c.record.accepted}
        for loop in self._given_loops:
            closed[loop.i, loop.j] = given_loop(
                loop, known, lambda i, j: self._confirm(known[i], known[j])
            )
        return in_order(closed)

    def _search_rejected(
        self,
        posed: Sequence[View],
        seen: Sequence[_Entry],
        overlap: Mapping[tuple[int, int], float],
        closed: dict[tuple[int, int], ClosedLoop],
    ) -> None:
        """Search rejected candidates and views that look alike; `closed` receives the results.

        `overlap` is that of the candidates, by the positions of the views.
        """
        gain = self._gain(posed, closed)
        times = max(1, -(-len(posed) // _VIEWS_PER_BUDGET))
        alike, impossible = self._alike(posed, seen, gain, closed, times)
        closed |= {p: ClosedLoop(LoopRecord(*p, False, _TOO_FAR)) for p in impossible}
        frames = {pair: (posed[pair[0]].index, posed[pair[1]].index) for pair in overlap}
        rejected = [pair for pair in overlap if not closed[frames[pair]].record.accepted]
        failures = self._options.searches * times
        chosen = _largest_gain(rejected, overlap, gain, failures)
        by_index = {p.index: p for p in posed}
        while chosen or alike:
            asked = [frames[pair] for pair in chosen]
            closed |= self._searched([*asked, *alike], by_index, closed, alike)
            failures -= sum(not closed[pair].record.accepted for pair in asked)
            rejected = [pair for pair in rejected if pair not in chosen]
            chosen = _largest_gain(rejected, overlap, gain, failures, least=1.0)
            alike = []

    def _gain(
        self, posed: Sequence[View], known: Mapping[tuple[int, int], ClosedLoop]
    ) -> InformationGain:
        """Return the information gain of loops between the views, given the `known` ones."""
        for p in posed:  # the first covariances are those of odometry; NaN where not constrained
            variance = np.trace(self._covariances[p.index][:3, :3])
            self._variance.setdefault(p.index, float(np.nan_to_num(variance)))
        gain = InformationGain(np.array([self._variance[p.index] for p in posed]))
        place = {p.index: k for k, p in enumerate(posed)}
        for (i, j), loop in known.items():
            if loop.record.accepted and i in place and j in place:
                gain.add(place[i], place[j])
        return gain

    def _views(self, posed: Sequence[View]) -> list[_Entry]:
        """The entries of these views, each computed once."""
        known = self._seen
        self._seen = {p.index: known.get(p.index) or self._entry_of(p) for p in posed}
        return list(self._seen.values())

    def _entry_of(self, posed: View) -> _Entry:
        surface = posed.view.without_caches()
        coarse = CoarseView.of(surface, sampled_points(surface, _POINTS))
        kept = Spilled(coarse, self._store.coarse)
        return _Entry(coarse.middle, kept, view_descriptor(surface))

    def _learn(self, posed: Sequence[View]) -> None:
        """Learn the usual fit of neighbouring views of this camera."""
        for a, b in itertools.pairwise(posed):
            pair = a.index, b.index
            if a.component != b.component or pair in self._learnt or len(self._learnt) >= _LEARN:
                continue
            self._learnt.add(pair)
            guess = se3.inverse(a.T_component_camera) @ b.T_component_camera
            target = [Target(a.view.without_caches(), np.eye(4))]
            scale = self._usual.noise_scale
            aligned = align(b.view.without_caches(), target, guess, _WEAK_PRIOR, usual_scale=scale)
            if aligned.overlap >= _MIN_OVERLAP:
                self._usual.learn(aligned, b.view.depth)

    def _confirm(self, target: View, source: View) -> ClosedLoop:
        """Register the later view with the earlier one in both directions, once for each pair."""
        pair = target.index, source.index
        if pair not in self._confirmed:
            self._confirmed[pair] = self._decided(
                pair, register_near(*self._guessed(target, source))
            )
        return self._confirmed[pair]

    def _confirm_all(self, pairs: Sequence[tuple[View, View]]) -> list[ClosedLoop]:
        """As `_confirm`, of many pairs (target, source)."""
        new = [(a, b) for a, b in pairs if (a.index, b.index) not in self._confirmed]
        found = executor().map(register_near, len(new), lambda k: self._guessed(*new[k]))
        for (a, b), made in zip(new, found, strict=True):
            pair = a.index, b.index
            self._confirmed[pair] = self._decided(pair, made)
        return [self._confirmed[a.index, b.index] for a, b in pairs]

    def _guessed(
        self, target: View, source: View
    ) -> tuple[PreparedView, PreparedView, Float64, FitStatistics]:
        """Arguments of `register_near`, with the guess of the trajectory."""
        guess = se3.inverse(self._poses[target.index]) @ self._poses[source.index]
        # Bare: otherwise the data derived for the comparison would stay in memory.
        return source.view.without_caches(), target.view.without_caches(), guess, self._usual

    def _decided(self, pair: tuple[int, int], made: Registration | None) -> ClosedLoop:
        """Accept or reject the registration of frames (i, j)."""
        if made is None:
            return ClosedLoop(LoopRecord(*pair, False, _REJECTED))
        reason = self._rejection_reason(made)
        record = LoopRecord(
            *pair,
            not reason,
            reason or f"right with a probability of {made.probability:.0%}",
            overlap=made.overlap,
            rms_m=made.rms_m if np.isfinite(made.rms_m) else None,
            free_space_violation=made.violation,
        )
        if reason:
            return ClosedLoop(record)
        return ClosedLoop(record, made.T_target_source, made.information)

    def _alike(
        self,
        posed: Sequence[View],
        seen: Sequence[_Entry],
        gain: InformationGain,
        closed: Mapping[tuple[int, int], ClosedLoop],
        times: int,
    ) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
        """Frames (i, j) that look alike and aren't candidates yet: plausible and implausible."""
        place = {p.index: k for k, p in enumerate(posed)}
        known = [(place[i], place[j]) for (i, j), loop in closed.items() if loop.record.accepted]
        appearance = replace(self._appearance, pairs=self._appearance.pairs * times)
        both = appearance.candidates(
            [s.descriptor for s in seen],
            lambda i, j: self._plausible(posed[i], posed[j], np.eye(4), ALIKE),
            known,
            lambda i, j: float(gain.of(i, j)),
        )
        indices = [[(posed[i].index, posed[j].index) for i, j in pairs] for pairs in both]
        return (
            [pair for pair in indices[0] if pair not in closed],
            [pair for pair in indices[1] if pair not in closed],
        )

    def _searched(
        self,
        pairs: Sequence[tuple[int, int]],
        posed: Mapping[int, View],
        closed: Mapping[tuple[int, int], ClosedLoop],
        alike: Sequence[tuple[int, int]],
    ) -> dict[tuple[int, int], ClosedLoop]:
        """Register views by exhaustive search, without a guess.

        Returns accepted loops, and rejected ones with the reason.
        """
        found, margins = {}, {}
        rejected = {p: "looks similar" if p in alike else closed[p].record.reason for p in pairs}
        made_all = executor().map(
            register_anywhere,
            len(pairs),
            lambda k: (
                *(posed[n].view for n in reversed(pairs[k])),
                self._usual,
                self._search,
            ),
            large=True,
        )
        for (i, j), made in zip(pairs, made_all, strict=True):
            if made is None:
                rejected[i, j] += "; there are too few surfaces for a search"
                continue
            margins[i, j] = made.margin
            if not made.is_probable:
                rejected[i, j] += f"; by a search {made.reason}"
                continue
            if (i, j) in alike and not self._plausible(posed[i], posed[j], made.T_target_source):
                rejected[i, j] = _TOO_FAR
                continue
            found[i, j] = made
        measured = {pair: loop.T_i_j for pair, loop in closed.items() if loop.T_i_j is not None}
        measured |= {pair: made.T_target_source for pair, made in found.items()}
        accepted = {}
        for (i, j), made in found.items():
            T_i_j = measured[i, j]
            alone = not any(self._consistent(i, j, T_i_j, *p, T) for p, T in measured.items())
            if alone and not made.stands_alone:
                rejected[i, j] += f"; by a search {made.reason}, and no other loop agrees"
                continue
            how = made.how if alone else f"{made.how}; another loop agrees"
            if (i, j) in alike:
                how = f"looks similar, {how}"
            record = LoopRecord(
                i,
                j,
                True,
                how,
                overlap=made.overlap,
                rms_m=made.rms_m if np.isfinite(made.rms_m) else None,
                free_space_violation=made.violation,
                margin=made.margin,
            )
            accepted[i, j] = ClosedLoop(record, made.T_target_source, made.information)
        others = {}
        for p in pairs:
            record = LoopRecord(*p, False, "") if p in alike else closed[p].record
            others[p] = ClosedLoop(replace(record, reason=rejected[p], margin=margins.get(p)))
        return others | accepted

    def _plausible(self, target: View, source: View, T: Float64, unsure: float = 0.0) -> bool:
        """Whether the drift implied by T_target_source `T` (4, 4) is plausible."""
        T_target_source = se3.inverse(self._poses[target.index]) @ self._poses[source.index]
        off = se3.inverse(T_target_source) @ T
        depth = 0.5 * (target.depth + source.depth)
        C = relative_covariance(
            T_target_source, self._covariances[target.index], self._covariances[source.index]
        )
        path = self._path_length[source.index] - self._path_length[target.index]
        length, turned = path.tolist()
        return self._appearance.plausible(off, length, turned, depth, C, unsure)

    def _consistent(self, i: int, j: int, T: Float64, k: int, m: int, other: Float64) -> bool:
        """Whether the loop (k, m) implies the same pose of j in i as the loop (i, j)."""
        if (i, j) == (k, m):
            return False
        poses = self._poses
        T_i_k = se3.inverse(poses[i]) @ poses[k]
        T_m_j = se3.inverse(poses[m]) @ poses[j]
        away = se3.inverse(T) @ T_i_k @ other @ T_m_j
        return bool(np.linalg.norm(away[:3, 3]) < _SAME_M and se3.angle(away) < _SAME_RAD)

    def _rejection_reason(self, made: Registration) -> str:
        if made.overlap is not None and made.overlap < _MIN_OVERLAP:
            return f"only {made.overlap:.0%} of the points project into the other view"
        if len(made.unobservable) > _MAX_DEGENERATE:
            return f"{len(made.unobservable)} directions are degenerate"
        return "" if made.believed else made.reason


def register_near(
    source: PreparedView, target: PreparedView, guess: Float64, usual: FitStatistics
) -> Registration | None:
    """Register two views from the guess (4, 4) T_target_source of the trajectory."""
    return follow(source, target, guess, usual=usual)


def register_anywhere(
    source: PreparedView, target: PreparedView, usual: FitStatistics, options: SearchOptions
) -> Registration | None:
    """Register two views by exhaustive search, without a guess."""
    return register_pair(source, target, usual=usual, options=options, rival_m=DISTINCT_M)


def _largest_gain(
    pairs: Sequence[tuple[int, int]],
    overlap: Mapping[tuple[int, int], float],
    gain: InformationGain,
    count: int,
    *,
    least: float = 0.0,
) -> list[tuple[int, int]]:
    """Choose pairs of views, each with the largest gain given those before, then overlap.

    `least` is the smallest gain.
    """
    left = list(pairs)
    chosen: list[tuple[int, int]] = []
    while left and len(chosen) < count:
        gains = gain.of(*np.transpose(left))
        best = max(range(len(left)), key=lambda k: (gains[k], overlap[left[k]]))
        if gains[best] < least:
            break
        chosen.append(left.pop(best))
        gain.add(*chosen[-1])
    return chosen


def _path_lengths(poses: Mapping[int, Float64]) -> dict[int, Float64]:
    """(2,) path length, m, and accumulated rotation, rad, from the first frame to each."""
    order = sorted(poses)
    path = np.stack([poses[k] for k in order])
    steps = se3.inverse(path[:-1]) @ path[1:]
    far = np.linalg.norm(steps[:, :3, 3], axis=1), np.asarray(se3.angle(steps))
    way = np.concatenate([np.zeros((1, 2)), np.cumsum(np.stack(far, 1), axis=0)])
    return dict(zip(order, way, strict=True))
