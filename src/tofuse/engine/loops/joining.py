"""Joins components: parts of a recording that were tracked separately, each in its own frame.

Links are registrations of single views across components. They come from relocalization during
tracking, and at the end from candidates with similar descriptors. No link joins two components by
itself. Those between the same two components are reduced to the largest pairwise consistent set
(Mangelson 2018). The pose of this set is verified with several views of both sides, by support and
free space; it must have no rival, and the camera must have been able to get there in time. This is
decided after tracking: best first, each join together with those made before. A join that rests on
a single link is then undone and searched for again, as more views have been joined to both sides
since. A component without a join stays separate.

The largest set of pairwise consistent measurements (Mangelson et al., ICRA 2018).

Correct measurements between two maps are all consistent; wrong ones are rarely consistent with each
other. Each is a vertex, each consistent pair an edge: the maximum clique is accepted.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Literal

import numpy as np

from tofuse.engine.alignment import Link
from tofuse.engine.arrays import Bool, Float64
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.geometry import se3
from tofuse.engine.loops.join_checks import VERIFY, JoinChecks, link_of
from tofuse.engine.loops.merged_components import (
    Join,
    JoinKind,
    MergedComponent,
    MergedComponents,
    TrackedComponent,
    View,
    cut_edges,
    extrapolated,
    odometry_over,
)
from tofuse.engine.search import (
    DISTINCT_M,
    SearchOptions,
    pose_probability,
    register_pair,
    verification,
)
from tofuse.engine.views import view_descriptors


def maximum_consistent_set(consistent: Bool, weights: Sequence[float] | None = None) -> list[int]:
    """Return the clique of largest weight, ascending; of equals the one with the lowest indices.

    Exact, by branch and bound: made for tens of measurements, not for thousands.

    Parameters
    ----------
    consistent
        (N, N) symmetric; whether two measurements agree. The diagonal does not matter.
    weights
        (N,) above 0; 1 each unless given.
    """
    n = len(consistent)
    weight = np.ones(n) if weights is None else np.asarray(weights, float)
    # Heavy ones first, so that a good bound is found soon.
    order = np.lexsort((np.arange(n), -weight))
    best: list[int] = []
    best_weight = 0.0

    def grow(chosen: list[int], total: float, candidates: list[int]) -> None:
        nonlocal best, best_weight
        if total > best_weight:
            best, best_weight = list(chosen), total
        remaining = float(sum(weight[c] for c in candidates))
        for k, c in enumerate(candidates):
            if total + remaining <= best_weight:
                return
            remaining -= float(weight[c])
            compatible = [d for d in candidates[k + 1 :] if consistent[c, d]]
            grow([*chosen, c], total + float(weight[c]), compatible)

    grow([], 0.0, [int(k) for k in order])
    return sorted(best)


# Frames for each additional search, as long recordings have more places.
_FRAMES_PER_SEARCH = 50
# View pairs that may confirm a join whose probability is not required.
_MAX_CONFIRMING = 4
# Independence from a link, see `_Joiner._probability`, from which another one says much more.
_APART = 0.5
# Largest weight of rival links, relative to the accepted ones.
_MAX_RIVAL = 0.5
_MAX_SHIFT = 0.35
# Up to this many views, all pairs of descriptors are compared.
_MAX_EXHAUSTIVE = 512


@dataclass(frozen=True, eq=False)
class Group:
    """Joined components in one frame, that of the component with the earliest frame.

    Attributes
    ----------
    T_group_component
        (4, 4) by component.
    joins
        Edges between the components.
    frames
        Number of their frames.
    bridged
        Components that only motion over a gap connects to the first one, and its source.
    reached
        Largest probability of a join with the main group, if it did not suffice; 0 without any.
    """

    T_group_component: Mapping[int, Float64]
    joins: tuple[Join, ...]
    frames: int
    bridged: Mapping[int, JoinKind] = field(default_factory=dict)
    reached: float = 0.0

    def connection(self, component: int) -> JoinKind:
        """Return how a component is connected to the first one."""
        return self.bridged.get(component, "links")


@dataclass(frozen=True)
class Joining(Bounded):
    """Options of joining components.

    Attributes
    ----------
    searches
        Maximum number of searches, in addition to one for each component and for every 50 frames.
    bridge
        Whether gaps may be bridged by motion alone, odometry or extrapolated; switch it off for a
        camera that stops or jumps.
    tries
        Largest number of view pairs that are tried between the same two components.
    min_probability
        Smallest probability of a join, given the number of tried view pairs (multiple testing). 0:
        not required, as the motion between the two sides supports the join as well.
    main
        The main group: that with most frames ("largest"), or with the component of the lowest
        number ("first").
    """

    searches: Annotated[int, Bounds(0, 1_000_000)] = 12
    bridge: bool = True
    tries: Annotated[int, Bounds(0, 1_000_000)] = 4
    min_probability: Annotated[float, Bounds(0, 0.999999)] = 0.0
    main: Literal["largest", "first"] = "largest"

    def join(
        self,
        components: Sequence[TrackedComponent],
        links: Sequence[Link],
        search: SearchOptions | None = None,
    ) -> list[Group]:
        """Join components as far as possible; the main group first, then by decreasing size.

        Parameters
        ----------
        components
            The components.
        links
            Between frames of different components, from relocalization during tracking.
        search
            Range and effort of exhaustive searches for a pose; the default ones unless given.
        """
        if len(components) == 1:
            single = components[0]
            return [Group({single.component: np.eye(4)}, (), len(single.frames))]
        joiner = _Joiner(self, components, search or SearchOptions())
        for link in sorted(
            links, key=lambda link: (not link.certain, -(link.registration.probability or 0.0))
        ):
            joiner.add(link)
        joiner.decide()
        joiner.search_links()
        joiner.reconsider()
        joiner.decide(single=True)
        if self.bridge:
            joiner.bridge_gaps()
        return joiner.groups()


class _Joiner:
    def __init__(
        self, options: Joining, components: Sequence[TrackedComponent], search: SearchOptions
    ) -> None:
        self._options, self._search = options, search
        self._merged = MergedComponents(components)
        self._checks = JoinChecks(self._merged)
        self._links: list[Link] = []
        self._tried: set[tuple[int, int]] = set()  # pairs of views that were registered
        self._refused: set[tuple[int, ...]] = set()
        # Insufficient probabilities of the last joins that were tried, by pairs of components.
        self._reached: dict[frozenset[int], float] = {}
        self._proposals: dict[tuple[int, ...], tuple[float, list[Link]]] = {}
        total = sum(len(s.frames) for s in components)
        self._searches = options.searches + len(components) + total // _FRAMES_PER_SEARCH

    def add(self, link: Link) -> None:
        """Add a link."""
        if {link.i, link.j} <= self._merged.component_of.keys():
            self._links.append(link)
            self._tried.add((link.i, link.j))
            self._merged.add_path_nodes(link)

    def decide(self, *, single: bool = False) -> None:
        """Join merged components as long as links support it, those with the largest weight first.

        A single link is considered only at the end (`single`), unless the gap is too
        short to reach another place: another room may look the same, and only links elsewhere
        contradict.
        """
        while True:
            proposals = []
            for (a, b), links in self._links_between().items():
                proposal = self._proposal(self._merged.all[a], self._merged.all[b], links)
                if proposal is not None:
                    weight, chosen = proposal
                    proposals.append((-weight, a, b, chosen))
            for _, a, b, chosen in sorted(proposals, key=lambda p: p[:3]):
                first, second = self._merged.all[a], self._merged.all[b]
                if len(chosen) < 2 and not (single or self._can_join_early(first, second, chosen)):
                    continue
                if self._join(first, second, chosen):
                    break
            else:
                return

    def _can_join_early(self, a: MergedComponent, b: MergedComponent, links: list[Link]) -> bool:
        """Whether a single link may join two merged components before all searches are done."""
        T_a_b = self._merged.T_a_b(a, b, _best(links))
        if np.isfinite(self._checks.speed).all():
            return self._checks.is_near(a, b, T_a_b, verification.MAX_OVERLAP_DISTANCE)
        # Unordered views are joined one by one, so that the next is compared with more of them.
        # Joins that rest on one link are reconsidered later.
        return any(link.certain for link in links) or bool(self._confirming(a, b, T_a_b, links))

    def _links_between(self) -> dict[tuple[int, int], list[Link]]:
        """Links by the positions (a, b), a < b, of the merged components that they connect."""
        position = {c: k for k, merged in enumerate(self._merged.all) for c in merged.T}
        links: dict[tuple[int, int], list[Link]] = {}
        for link in self._links:
            a, b = sorted(position[self._merged.component_of[f]] for f in (link.i, link.j))
            if a != b:
                links.setdefault((a, b), []).append(link)
        return links

    def search_links(self) -> None:
        """Register views of different merged components, most similar first, within the budget.

        If joins need a probability, half of the tries are of pairs away from the links so far, as
        evidence of one place hardly adds up.
        """
        views = sorted(self._merged.views.values(), key=lambda v: v.index)
        if len(self._merged.all) < 2 or len(views) < 2:
            return
        component = np.array([self._merged.component_of[v.index] for v in views])
        descriptors = np.stack([view_descriptors.view_descriptor(v.view) for v in views])
        if len(descriptors) <= _MAX_EXHAUSTIVE:
            i, j = np.nonzero(np.triu(component[:, None] != component))
            difference = view_descriptors.mutual_dissimilarity(descriptors, _MAX_SHIFT)[i, j]
        else:  # by an index, as all pairs would be too many
            i, j = view_descriptors.similar_views(descriptors, _MAX_SHIFT)
            separate = component[i] != component[j]
            i, j = i[separate], j[separate]
            difference = view_descriptors.pairwise_dissimilarity(descriptors, i, j, _MAX_SHIFT)
        order = np.lexsort((j, i, difference))
        poses = np.stack([v.T_component_camera for v in views])

        def around(row: int) -> Bool:
            """(n,) whether views of its component are near one."""
            change = se3.change_of_view(se3.inverse(poses[row]) @ poses, views[row].depth)
            near = change < _APART * verification.MAX_OVERLAP_DISTANCE
            return np.asarray(near & (component == component[row]))

        rows = {view.index: row for row, view in enumerate(views)}

        def beside(first: int, second: int) -> Bool:
            """(K,) whether pairs of views are near another pair."""
            a, b = around(rows[first]), around(rows[second])
            return np.asarray((a[i] & b[j]) | (a[j] & b[i]))

        near_link = np.zeros(len(i), bool)
        for known in self._links if self._options.min_probability else ():
            if {known.i, known.j} <= rows.keys():
                near_link |= beside(known.i, known.j)
        tries, tried = self._options.tries, Counter[tuple[int, int]]()
        rounds = [(tries, False)]
        if self._options.min_probability:
            rounds.insert(0, (tries - tries // 2, True))
        for (limit, apart), k in itertools.product(rounds, order.tolist()):
            if self._searches < 1 or len(self._merged.all) < 2:
                return
            first, second = views[i[k]], views[j[k]]
            pair = first.index, second.index
            components = (int(component[i[k]]), int(component[j[k]]))
            if (
                tried[components] >= limit
                or (apart and near_link[k])
                or pair in self._tried
                or self._merged.is_joined(first, second)
            ):
                continue
            tried[components] += 1
            self._tried.add(pair)
            link = self._register(first, second)
            if link is not None:
                near_link |= beside(*pair)
                self.add(link)
                self.decide()

    def reconsider(self) -> None:
        """Undo joins that rest on a single link, and search for links again.

        At the time of the join, one of the sides may have been a single view, so that no other
        views could be compared.
        """
        weak = [
            merged.joins[k]
            for merged in self._merged.all
            for k in cut_edges([self._merged.components(join) for join in merged.joins])
        ]
        for join in weak:
            self._merged.cut(join)
        if weak:
            self._proposals.clear()
            self._refused.clear()
            self.search_links()

    def bridge_gaps(self) -> None:
        """Connect components across gaps by odometry, or by the motion before and after."""
        ordered = sorted(self._merged.tracked.values(), key=lambda s: int(s.frames[0]))
        for before, after in itertools.pairwise(ordered):
            a = self._merged.of_component(before.component)
            b = self._merged.of_component(after.component)
            if a is b or before.recordings[-1] != after.recordings[0]:
                continue
            bridges: list[tuple[Link | None, JoinKind]] = [
                (odometry_over(before, after), "odometry"),
                (extrapolated(before, after), "motion"),
            ]
            for link, how in bridges:
                if link is not None and not self._checks.contradicts(a, b, link):
                    self._merged.merge(a, b, link, [Join(link, how, True)])
                    break

    def groups(self) -> list[Group]:
        """Return the joined groups, the main one first, then by decreasing size."""
        tracked, result = self._merged.tracked, []
        for merged in self._merged.all:
            order = sorted(merged.T, key=lambda c: int(tracked[c].frames[0]))
            first = order[0]
            to_first = se3.inverse(merged.T[first])
            result.append(
                Group(
                    {c: to_first @ merged.T[c] for c in order},
                    tuple(merged.joins),
                    sum(len(tracked[c].frames) for c in merged.T),
                    self._merged.bridged_from(merged, first),
                )
            )
        first_frames = [int(tracked[next(iter(g.T_group_component))].frames[0]) for g in result]
        lowest = min(tracked) if self._options.main == "first" else None
        is_main = [lowest in g.T_group_component for g in result]
        order = sorted(
            range(len(result)), key=lambda k: (not is_main[k], -result[k].frames, first_frames[k])
        )
        main = result[order[0]].T_group_component
        return [
            group
            if group.T_group_component is main
            else replace(
                group,
                reached=max(
                    self._reached.get(frozenset(pair), 0.0)
                    for pair in itertools.product(main, group.T_group_component)
                ),
            )
            for group in (result[k] for k in order)
        ]

    def _register(self, first: View, second: View) -> Link | None:
        """Register two similar views; only an exhaustive search counts against the budget."""
        registration = register_pair(
            second.view,
            first.view,
            fit_statistics=self._checks.fit_statistics,
            options=self._search,
            rival_m=DISTINCT_M,
        )
        if registration is None or registration.margin is not None:
            self._searches -= 1
        return link_of(first, second, registration)

    def _proposal(
        self, a: MergedComponent, b: MergedComponent, links: list[Link]
    ) -> tuple[float, list[Link]] | None:
        """The consistent links between merged components, and their weight; None without one."""
        key = _key(a, b, links)
        if key in self._refused:
            return None
        if key in self._proposals:
            return self._proposals[key]
        T = [self._merged.T_a_b(a, b, link) for link in links]
        n = len(links)
        consistent = np.ones((n, n), bool)
        for p in range(n):
            for q in range(p + 1, n):
                consistent[p, q] = consistent[q, p] = self._merged.consistent(
                    a, b, links[p], links[q], T[p], T[q]
                )
        weights = [_weight(link) for link in links]
        chosen = maximum_consistent_set(consistent, weights)
        weight = sum(weights[k] for k in chosen)
        others = [k for k in range(n) if not consistent[k, chosen].all()]
        rivals = maximum_consistent_set(
            consistent[np.ix_(others, others)], [weights[k] for k in others]
        )
        if sum(weights[others[k]] for k in rivals) > _MAX_RIVAL * weight:
            self._refused.add(key)
            return None
        self._proposals[key] = weight, [links[k] for k in chosen]
        return self._proposals[key]

    def _join(self, a: MergedComponent, b: MergedComponent, links: list[Link]) -> bool:
        """Join two merged components if the pose of the links is verified."""
        best = _best(links)
        T_a_b = self._merged.T_a_b(a, b, best)
        confirming = self._confirming(a, b, T_a_b, links)
        certain = any(link.certain for link in links)
        min_probability = self._options.min_probability
        probability = self._probability(a, b, [*links, *confirming]) if min_probability else None
        is_doubtful = probability is not None and probability < min_probability
        if probability is not None:
            for pair in map(frozenset, itertools.product(a.T, b.T)):
                self._reached[pair] = probability if is_doubtful else 0.0
        if (
            not (certain or len(links) + len(confirming) > 1)
            or is_doubtful
            or self._checks.contradicts(a, b, best)
            or not self._checks.reachable(a, b, T_a_b)
        ):
            links_between = self._links_between()[self._merged.positions(a, b)]
            self._refused.add(_key(a, b, links_between))
            return False
        joins = [Join(link, "links", link is best, probability) for link in [*links, *confirming]]
        self._merged.merge(a, b, best, joins)
        return True

    def _probability(self, a: MergedComponent, b: MergedComponent, links: Sequence[Link]) -> float:
        """Probability that consistent links between two merged components are right.

        Odds multiply as far as views are independent, and are divided by the number of tried view
        pairs (Bonferroni).
        """
        counted: list[Link] = []
        log_odds = 0.0
        for link in sorted(links, key=lambda link: -(link.registration.probability or 0.0)):
            p = min(link.registration.probability or 0.0, pose_probability.MAX_PROBABILITY)
            if p <= 0:
                continue
            apart = min(
                (self._merged.separation(a, b, link, other) for other in counted), default=np.inf
            )
            independence = min(1.0, apart / verification.MAX_OVERLAP_DISTANCE)
            log_odds += independence * float(np.log(p / (1 - p)))
            counted.append(link)
        frames_a = {f for f, c in self._merged.component_of.items() if c in a.T}
        frames_b = {f for f, c in self._merged.component_of.items() if c in b.T}
        tried = sum(
            (i in frames_a and j in frames_b) or (i in frames_b and j in frames_a)
            for i, j in self._tried
        )
        return pose_probability.logistic(log_odds - float(np.log(max(tried, 1))))

    def _confirming(
        self, a: MergedComponent, b: MergedComponent, T_a_b: Float64, links: list[Link]
    ) -> list[Link]:
        count = VERIFY if self._options.min_probability else _MAX_CONFIRMING
        return self._checks.confirming(a, b, T_a_b, links, count)


def _best(links: Sequence[Link]) -> Link:
    """The link that defines the pose; the others confirm it."""
    return max(links, key=lambda link: (link.certain, _weight(link)))


def _key(a: MergedComponent, b: MergedComponent, links: Sequence[Link]) -> tuple[int, ...]:
    """Key of a decision: two merged components, and the number of links between them."""
    return (*sorted(a.T), -1, *sorted(b.T), -1, len(links))


def _weight(link: Link) -> float:
    """Weight of a link: a certain one counts twice."""
    return (2.0 if link.certain else 1.0) * (0.5 + (link.registration.support or 0.0))
