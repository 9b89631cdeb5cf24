"""Joins components: parts of a recording that were tracked separately, each in its own frame.

Links are registrations of single views across components. They come from relocalization during
tracking, and at the end from candidates with similar descriptors. No link joins two components by
itself. Those between the same two components are reduced to the largest pairwise consistent set
(Mangelson 2018). The pose of this set is verified with several views of both sides, by support and
free space; it must have no rival, and the camera must have been able to get there in time. This is
decided after tracking: best first, each join together with those made before. A join that rests on
a single link is then undone and searched for again, as more views have been joined to both sides
since. A component that nothing joins stays separate.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Literal

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from tofuse.arrays import Float64
from tofuse.bounds import Bounded, Bounds
from tofuse.geometry import se3
from tofuse.posegraph.cut_edges import cut_edges, sides_without
from tofuse.posegraph.gaps import (
    CONVERGENCE,
    Stretch,
    View,
    end_speeds,
    extrapolated,
    largest_motion,
    motion_over,
    odometry_over,
)
from tofuse.posegraph.pairwise_consistency import maximum_consistent_set
from tofuse.registration.agreement import Agreement, agreement
from tofuse.registration.base import Link, Registration
from tofuse.registration.confidence import CONTRADICTION, logistic
from tofuse.registration.projective import ProjectiveOptions, Target, align
from tofuse.registration.search import DISTINCT_M, DISTINCT_RAD, SearchOptions, differ
from tofuse.registration.verification import IN_SIGHT, PATIENT, UsualFit, self_scaled
from tofuse.registration.view_descriptor import (
    mutual_dissimilarity,
    pairwise_dissimilarity,
    similar_views,
    view_descriptor,
)
from tofuse.registration.view_pair import follow, register_pair

How = Literal["links", "motion", "odometry"]

# Pairs of neighbouring views from which the usual fit of this camera's views is learnt.
_LEARN = 16
# One search for so many frames, as long recordings have more places.
_FRAMES_PER_SEARCH = 50
# View pairs that verify a join, besides those of the links; and their smallest overlap.
_VERIFY, _OVERLAP = 8, 0.2
# Contradiction is unusual beyond this many standard deviations above the median of neighbours.
# Wrong poses within one scene contradict by more than the last number in any case.
_SIGMAS, _MIN_SPREAD, _MAX_CONTRADICTION = 3.0, 0.02, 0.2
# Largest drift within components, as a fraction of the path; largest error of a link: fraction of
# the depth, and rad.
_DRIFT, _LINK_ERROR = 0.05, 0.02
# A motion that is always possible: fraction of the depth, and rad.
_NEAR = 0.3
# Factor on the 90 % quantile of the speed that the camera hardly exceeds. Where it had no time to
# lose sight of the place, up to this fraction of the overlap may contradict.
_HARDLY, _SAME_PLACE = 2.0, 0.3
# Largest weight of rival links, relative to the accepted ones.
_RIVAL = 0.5
_SHIFT = 0.35
# Up to this many views, all pairs of descriptors are compared.
_ALL = 512
# Probabilities are not extrapolated beyond the data that their model was fitted to, a few hundred
# poses.
_MAX_PROBABILITY = 0.998
_NEARBY = ProjectiveOptions(levels=PATIENT, prior_m=3.0, prior_rad=3.0)


@dataclass(frozen=True, eq=False)
class Join:
    """An edge that joins components.

    Attributes
    ----------
    link
        The measurement T_i_j between frames i and j.
    how
        "links"; "odometry", or "motion" where the motion over a gap was extrapolated.
    needed
        Whether it defines the pose of the component; otherwise it confirms another one.
    probability
        That the pose given by all links between the two sides is right; None if not computed.
    """

    link: Link
    how: How
    needed: bool
    probability: float | None = None


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
        Components that only motion over a gap connects to the first one, and how it is known.
    """

    T_group_component: Mapping[int, Float64]
    joins: tuple[Join, ...]
    frames: int
    bridged: Mapping[int, How] = field(default_factory=dict)

    def joined(self, component: int) -> How:
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
        Whether gaps may be bridged by motion alone, odometry or extrapolated.
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
        stretches: Sequence[Stretch],
        links: Sequence[Link],
        search: SearchOptions | None = None,
    ) -> list[Group]:
        """Join components as far as possible; the main group first, then by decreasing size.

        Parameters
        ----------
        stretches
            The components.
        links
            Between frames of different components, from relocalization during tracking.
        search
            Range and effort of exhaustive searches for a pose; the default ones unless given.
        """
        if len(stretches) == 1:
            only = stretches[0]
            return [Group({only.component: np.eye(4)}, (), len(only.frames))]
        joiner = _Joiner(self, stretches, search or SearchOptions())
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


@dataclass(eq=False)
class _Island:
    """Components that are joined so far, each with T_island_component."""

    T: dict[int, Float64]
    joins: list[Join] = field(default_factory=list)


class _Joiner:
    def __init__(
        self, options: Joining, stretches: Sequence[Stretch], search: SearchOptions
    ) -> None:
        self._options, self._search = options, search
        self._stretches = {s.component: s for s in stretches}
        self._component_of = {int(f): s.component for s in stretches for f in s.frames}
        self._views = {v.index: v for s in stretches for v in s.views}
        self._poses = {int(f): T for s in stretches for f, T in zip(s.frames, s.poses, strict=True)}
        self._islands = [_Island({s.component: np.eye(4)}) for s in stretches]
        self._links: list[Link] = []
        self._tried: set[tuple[int, int]] = set()  # pairs of views that were registered
        self._refused: set[tuple[int, ...]] = set()
        # Frames of each component that links or verification refer to.
        self._nodes = {s.component: {v.index for v in s.views} for s in stretches}
        self._proposals: dict[tuple[int, ...], tuple[float, list[Link]]] = {}
        self._paths: dict[tuple[int, ...], dict[int, float]] = {}
        total = sum(len(s.frames) for s in stretches)
        self._searches = options.searches + len(stretches) + total // _FRAMES_PER_SEARCH
        self._usual = UsualFit()
        self._contradiction = CONTRADICTION
        steps = [end_speeds(s, end=True) for s in stretches]
        known = np.concatenate(steps)
        # (2,) m/s and rad/s that the camera hardly exceeds. Motions at which tracking failed may
        # have been faster than all others.
        unknown = np.full((_tracking_failures(stretches), 2), np.inf)
        speeds = np.concatenate([known, unknown])
        self._speed = np.full(2, np.inf)
        if len(known):
            self._speed = _HARDLY * np.quantile(speeds, 0.9, axis=0, method="higher")
        self._learn_from_neighbours()

    def add(self, link: Link) -> None:
        """Add a link."""
        if {link.i, link.j} <= self._poses.keys():
            self._links.append(link)
            self._tried.add((link.i, link.j))
            self._remember_ends(link)

    def _remember_ends(self, link: Link) -> None:
        for frame in (link.i, link.j):
            self._nodes[self._component_of[frame]].add(frame)

    def decide(self, *, single: bool = False) -> None:
        """Join islands as long as links support it, those with the largest weight first.

        A single link is considered only at the end (`single`), unless the gap is too
        short to reach another place: another room may look the same, and only links elsewhere
        contradict.
        """
        while True:
            proposals = []
            for (a, b), links in self._links_between().items():
                found = self._proposal(self._islands[a], self._islands[b], links)
                if found is not None:
                    weight, chosen = found
                    proposals.append((-weight, a, b, chosen))
            for _, a, b, chosen in sorted(proposals, key=lambda p: p[:3]):
                first, second = self._islands[a], self._islands[b]
                if len(chosen) < 2 and not (single or self._need_not_wait(first, second, chosen)):
                    continue
                if self._join(first, second, chosen):
                    break
            else:
                return

    def _need_not_wait(self, a: _Island, b: _Island, links: list[Link]) -> bool:
        """Whether a single link may join two islands before all searches are done."""
        T_a_b = self._T_a_b(a, b, _best(links))
        if np.isfinite(self._speed).all():
            return self._is_near(a, b, T_a_b, IN_SIGHT)
        # Unordered views are joined one by one, so that the next is compared with more of them.
        # Joins that rest on one link are reconsidered later.
        return any(link.certain for link in links) or bool(self._confirming(a, b, T_a_b, links))

    def _links_between(self) -> dict[tuple[int, int], list[Link]]:
        """Links by the positions (a, b), a < b, of the islands that they connect."""
        place = {c: k for k, island in enumerate(self._islands) for c in island.T}
        found: dict[tuple[int, int], list[Link]] = {}
        for link in self._links:
            a, b = sorted(place[self._component_of[f]] for f in (link.i, link.j))
            if a != b:
                found.setdefault((a, b), []).append(link)
        return found

    def search_links(self) -> None:
        """Register views of different islands, most similar first, within the budget."""
        views = sorted(self._views.values(), key=lambda v: v.index)
        if len(self._islands) < 2 or len(views) < 2:
            return
        component = np.array([self._component_of[v.index] for v in views])
        descriptors = np.stack([view_descriptor(v.view) for v in views])
        if len(descriptors) <= _ALL:
            i, j = np.nonzero(np.triu(component[:, None] != component))
            far = mutual_dissimilarity(descriptors, _SHIFT)[i, j]
        else:  # by an index, as all pairs would be too many
            i, j = similar_views(descriptors, _SHIFT)
            across = component[i] != component[j]
            i, j = i[across], j[across]
            far = pairwise_dissimilarity(descriptors, i, j, _SHIFT)
        order = np.lexsort((j, i, far))
        between: dict[tuple[int, int], int] = {}
        for k in order.tolist():
            if self._searches < 1 or len(self._islands) < 2:
                return
            first, second = views[i[k]], views[j[k]]
            pair = first.index, second.index
            if pair in self._tried or self._is_joined(first, second):
                continue
            ends = (int(component[i[k]]), int(component[j[k]]))
            between[ends] = between.get(ends, 0) + 1
            if between[ends] > self._options.tries:
                continue
            self._tried.add(pair)
            link = self._registered(first, second)
            if link is not None:
                self.add(link)
                self.decide()

    def reconsider(self) -> None:
        """Undo joins that rest on a single link, and search for links again.

        At the time of the join, one of the sides may have been a single view, so that no other
        views could be compared.
        """
        weak = [
            island.joins[k]
            for island in self._islands
            for k in cut_edges([self._components(join) for join in island.joins])
        ]
        for join in weak:
            self._cut(join)
        if weak:
            self._proposals.clear()
            self._refused.clear()
            self._paths.clear()
            self.search_links()

    def _components(self, join: Join) -> tuple[int, int]:
        return self._component_of[join.link.i], self._component_of[join.link.j]

    def _cut(self, join: Join) -> None:
        """Split an island at a join that alone connects its two sides."""
        whole = self._island_of(self._components(join)[0])
        self._islands.remove(whole)
        edges = [self._components(other) for other in whole.joins]
        for side in sides_without(edges, whole.joins.index(join)):
            T = {c: whole.T[c] for c in whole.T if c in side}
            inside = [j for j in whole.joins if j is not join and self._components(j)[0] in side]
            self._islands.append(_Island(T, inside))

    def bridge_gaps(self) -> None:
        """Connect components across gaps by odometry, or by the motion before and after."""
        ordered = sorted(self._stretches.values(), key=lambda s: int(s.frames[0]))
        for before, after in itertools.pairwise(ordered):
            a, b = self._island_of(before.component), self._island_of(after.component)
            if a is b or before.recording != after.recording:
                continue
            bridges: list[tuple[Link | None, How]] = [
                (odometry_over(before, after), "odometry"),
                (extrapolated(before, after), "motion"),
            ]
            for link, how in bridges:
                if link is not None and not self._contradicts(a, b, link):
                    self._merge(a, b, link, [Join(link, how, True)])
                    break

    def groups(self) -> list[Group]:
        """Return the joined groups, the main one first, then by decreasing size."""
        found = []
        for island in self._islands:
            first = min(island.T, key=lambda c: int(self._stretches[c].frames[0]))
            to_first = se3.inverse(island.T[first])
            order = sorted(island.T, key=lambda c: int(self._stretches[c].frames[0]))
            found.append(
                Group(
                    {c: to_first @ island.T[c] for c in order},
                    tuple(island.joins),
                    sum(len(self._stretches[c].frames) for c in island.T),
                    self._bridged_from(island, first),
                )
            )
        began = [int(self._stretches[next(iter(g.T_group_component))].frames[0]) for g in found]
        lowest = min(self._stretches) if self._options.main == "first" else None
        main = [lowest in g.T_group_component for g in found]
        order = sorted(range(len(found)), key=lambda k: (not main[k], -found[k].frames, began[k]))
        return [found[k] for k in order]

    def _bridged_from(self, island: _Island, first: int) -> dict[int, How]:
        """Components that no chain of links connects to the first one, and what does."""

        def reached(*ways: How) -> set[int]:
            out, changed = {first}, True
            joined = [
                {self._component_of[j.link.i], self._component_of[j.link.j]}
                for j in island.joins
                if j.how in ways
            ]
            while changed:
                more = {c for ends in joined if ends & out for c in ends}
                changed = not more <= out
                out |= more
            return out

        by_links, by_odometry = reached("links"), reached("links", "odometry")
        bridged: dict[int, How] = dict.fromkeys(island.T.keys() - by_links, "motion")
        bridged.update(dict.fromkeys(by_odometry - by_links, "odometry"))
        return bridged

    def _learn_from_neighbours(self) -> None:
        """Learn the usual fit and contradiction from neighbouring views of one component."""
        pairs = [(a, b) for s in self._stretches.values() for a, b in itertools.pairwise(s.views)]
        some = np.linspace(0, len(pairs) - 1, min(len(pairs), _LEARN)).round().astype(int)
        options = ProjectiveOptions(levels=PATIENT)
        seen = []
        for k in some:
            a, b = pairs[k]
            T_a_b = se3.inverse(a.T_component_camera) @ b.T_component_camera
            aligned = align(b.view, [Target(a.view, np.eye(4))], T_a_b, options)
            if aligned.overlap >= _OVERLAP:
                self._usual.learn(aligned, b.depth)
                found = agreement(b.view, a.view, T_a_b, self_scaled(self._usual))
                seen.append(found.contradiction)
        if len(seen) > 3:
            median = float(np.median(seen))
            spread = 1.48 * float(np.median(np.abs(np.array(seen) - median)))
            limit = median + _SIGMAS * max(spread, _MIN_SPREAD)
            self._contradiction = max(self._contradiction, min(limit, _MAX_CONTRADICTION))

    def _registered(self, first: View, second: View) -> Link | None:
        """Register two similar views; only an exhaustive search counts against the budget."""
        found = register_pair(
            second.view, first.view, usual=self._usual, options=self._search, rival_m=DISTINCT_M
        )
        if found is None or found.margin is not None:
            self._searches -= 1
        return _link(first, second, found)

    def _island_of(self, component: int) -> _Island:
        return next(island for island in self._islands if component in island.T)

    def _is_joined(self, a: View, b: View) -> bool:
        return self._component_of[b.index] in self._island_of(self._component_of[a.index]).T

    def _T_island(self, island: _Island, frame: int) -> Float64:
        T = island.T[self._component_of[frame]] @ self._poses[frame]
        return np.asarray(T, np.float64)

    def _T_a_b(self, a: _Island, b: _Island, link: Link) -> Float64:
        """T_a_b that a link between two islands implies, whatever its direction."""
        i, j, T = link.i, link.j, link.T_i_j
        if self._component_of[i] not in a.T:
            i, j, T = j, i, se3.inverse(T)
        return np.asarray(self._T_island(a, i) @ T @ se3.inverse(self._T_island(b, j)), np.float64)

    def _proposal(
        self, a: _Island, b: _Island, between: list[Link]
    ) -> tuple[float, list[Link]] | None:
        """The consistent links between two islands, and their weight; None if there are none."""
        key = _key(a, b, between)
        if key in self._refused:
            return None
        if key in self._proposals:
            return self._proposals[key]
        T = [self._T_a_b(a, b, link) for link in between]
        n = len(between)
        agree = np.ones((n, n), bool)
        for p in range(n):
            for q in range(p + 1, n):
                agree[p, q] = agree[q, p] = self._consistent(
                    a, b, between[p], between[q], T[p], T[q]
                )
        weights = [_weight(link) for link in between]
        chosen = maximum_consistent_set(agree, weights)
        weight = sum(weights[k] for k in chosen)
        rest = [k for k in range(n) if not agree[k, chosen].all()]
        rivals = maximum_consistent_set(agree[np.ix_(rest, rest)], [weights[k] for k in rest])
        if sum(weights[rest[k]] for k in rivals) > _RIVAL * weight:
            self._refused.add(key)
            return None
        self._proposals[key] = weight, [between[k] for k in chosen]
        return self._proposals[key]

    def _consistent(
        self, a: _Island, b: _Island, first: Link, second: Link, T: Float64, other: Float64
    ) -> bool:
        """Whether the T_a_b of two links agree at the view of the first one.

        Drift between the views of the two links, on both sides, is tolerated.
        """
        i, j = self._ends(a, first)
        k, m = self._ends(a, second)
        drift = _DRIFT * (self._path(a, i).get(k, np.inf) + self._path(b, j).get(m, np.inf))
        at = self._T_island(b, j)
        between = se3.inverse(T @ at) @ other @ at
        depth = self._depth_of(j)
        return bool(
            np.linalg.norm(between[:3, 3]) <= DISTINCT_M + drift * depth
            and se3.angle(between) <= DISTINCT_RAD + drift
        )

    def _ends(self, a: _Island, link: Link) -> tuple[int, int]:
        """The frames of a link: the one in `a`, and the other."""
        return (link.i, link.j) if self._component_of[link.i] in a.T else (link.j, link.i)

    def _depth_of(self, frame: int) -> float:
        return self._stretches[self._component_of[frame]].depth

    def _path(self, island: _Island, start: int) -> dict[int, float]:
        """Path length, which drift grows with, from a frame to those with stored views or joins.

        Along the poses of components, and across joins; rotation in rad plus translation as a
        fraction of the depth.
        """
        # Nodes are only added, so their number identifies the set.
        key = (start, sum(len(self._nodes[c]) for c in island.T), *sorted(island.T))
        if key not in self._paths:
            nodes = set().union(*(self._nodes[c] for c in island.T))
            self._paths[key] = self._path_over(nodes | {start}, island, start)
        return self._paths[key]

    def _path_over(self, nodes: set[int], island: _Island, start: int) -> dict[int, float]:
        order = sorted(nodes, key=lambda f: (self._component_of[f], f))
        T = np.stack([self._T_island(island, f) for f in order])
        row = {f: k for k, f in enumerate(order)}
        edges = [
            (row[f], row[g])
            for f, g in itertools.pairwise(order)
            if self._component_of[f] == self._component_of[g]
        ]
        edges += [(row[join.link.i], row[join.link.j]) for join in island.joins]
        if not edges:
            return {start: 0.0}
        i, j = np.array(edges).T
        between = se3.inverse(T[i]) @ T[j]
        depth = np.array([self._depth_of(order[k]) for k in i])
        far = np.linalg.norm(between[:, :3, 3], axis=1) / depth + np.asarray(se3.angle(between))
        graph = csr_array((far + 1e-9, (i, j)), shape=(len(order), len(order)))
        away = dijkstra(graph, directed=False, indices=row[start])
        return {f: float(away[k]) for f, k in row.items()}

    def _join(self, a: _Island, b: _Island, links: list[Link]) -> bool:
        """Join two islands if the pose of the links is verified."""
        best = _best(links)
        T_a_b = self._T_a_b(a, b, best)
        extra = self._confirming(a, b, T_a_b, links)
        certain = any(link.certain for link in links)
        minimum = self._options.min_probability
        probability = self._probability(a, b, [*links, *extra]) if minimum else None
        if (
            not (certain or len(links) + len(extra) > 1)
            or (probability is not None and probability < minimum)
            or self._contradicts(a, b, best)
            or not self._reachable(a, b, T_a_b)
        ):
            between = self._links_between()[self._positions(a, b)]
            self._refused.add(_key(a, b, between))
            return False
        joins = [Join(link, "links", link is best, probability) for link in [*links, *extra]]
        self._merge(a, b, best, joins)
        return True

    def _probability(self, a: _Island, b: _Island, links: Sequence[Link]) -> float:
        """Probability that consistent links between two islands are right.

        Odds multiply as far as views are independent, and are divided by the number of tried view
        pairs (Bonferroni).
        """
        counted: list[Link] = []
        total = 0.0
        for link in sorted(links, key=lambda link: -(link.registration.probability or 0.0)):
            p = min(link.registration.probability or 0.0, _MAX_PROBABILITY)
            if p <= 0:
                continue
            new = min([1.0, *(self._apart(a, b, link, other) / IN_SIGHT for other in counted)])
            total += new * float(np.log(p / (1 - p)))
            counted.append(link)
        ours = {f for f, c in self._component_of.items() if c in a.T}
        theirs = {f for f, c in self._component_of.items() if c in b.T}
        tried = sum(
            (i in ours and j in theirs) or (i in theirs and j in ours) for i, j in self._tried
        )
        return logistic(total - float(np.log(max(tried, 1))))

    def _apart(self, a: _Island, b: _Island, link: Link, other: Link) -> float:
        """Distance between the views of two links, on the side where it is larger.

        Translation as a fraction of the depth plus rotation in rad.
        """
        far = []
        for island, i, k in zip((a, b), self._ends(a, link), self._ends(a, other), strict=True):
            T = se3.inverse(self._T_island(island, i)) @ self._T_island(island, k)
            metres = float(np.linalg.norm(T[:3, 3]))
            far.append(metres / self._depth_of(i) + float(se3.angle(T)))
        return max(far)

    def _positions(self, a: _Island, b: _Island) -> tuple[int, int]:
        first, second = sorted((self._islands.index(a), self._islands.index(b)))
        return first, second

    def _merge(self, a: _Island, b: _Island, link: Link, joins: list[Join]) -> None:
        T_a_b = self._T_a_b(a, b, link)
        a.T.update(_transformed(b.T, T_a_b))
        a.joins += [*b.joins, *joins]
        for join in joins:
            self._remember_ends(join.link)
        self._islands.remove(b)

    def _overlapping(
        self, a: _Island, b: _Island, T_a_b: Float64
    ) -> list[tuple[View, View, Float64, Agreement]]:
        """View pairs of both sides that overlap most under T_a_b: T_i_j, and their agreement."""
        compare = self_scaled(self._usual)
        ours = [self._views[i] for i in self._views if self._component_of[i] in a.T]
        theirs = [self._views[i] for i in self._views if self._component_of[i] in b.T]
        near: list[tuple[float, int, int]] = []
        if not ours or not theirs:
            return []
        Ta = np.stack([self._T_island(a, v.index) for v in ours])
        Tb = np.stack([T_a_b @ self._T_island(b, v.index) for v in theirs])
        for p, v in enumerate(ours):
            between = se3.inverse(Ta[p]) @ Tb
            apart = np.linalg.norm(between[:, :3, 3], axis=1) / v.depth
            away = apart + np.asarray(se3.angle(between))
            near += [(float(away[q]), p, int(q)) for q in np.flatnonzero(away < IN_SIGHT)]
        found = []
        for _, p, q in sorted(near)[: 3 * _VERIFY]:
            T = se3.inverse(Ta[p]) @ Tb[q]
            seen = agreement(theirs[q].view, ours[p].view, T, compare)
            if seen.overlap >= _OVERLAP:
                found.append((ours[p], theirs[q], T, seen))
            if len(found) >= _VERIFY:
                break
        return found

    def _contradicts(self, a: _Island, b: _Island, link: Link) -> bool:
        """Whether views of both sides contradict each other more than neighbours do.

        Islands have drifted, the more the longer the path from the link. A contradiction at the
        implied pose counts only if no pose within the drift removes it, and is ignored where the
        drift may exceed the range of convergence of an alignment.
        """
        overlap = against = 0.0
        T_a_b = self._T_a_b(a, b, link)
        i, j = self._ends(a, link)
        from_i, from_j = self._path(a, i), self._path(b, j)
        for first, second, T, at_implied in self._overlapping(a, b, T_a_b):
            drift = _DRIFT * (from_i[first.index] + from_j[second.index])
            if drift > CONVERGENCE:
                continue
            seen = at_implied
            if seen.contradiction > self._contradiction:
                at = [Target(first.view, np.eye(4))]
                scale = self._usual.noise_scale
                aligned = align(second.view, at, T, _NEARBY, usual_scale=scale)
                if self._drifted(T, aligned.T_world_source, first.depth, drift):
                    near = agreement(
                        second.view, first.view, aligned.T_world_source, self_scaled(self._usual)
                    )
                    seen = min(seen, near, key=lambda found: found.contradiction)
            overlap += seen.overlap
            against += seen.violation + seen.clash
        limit = self._contradiction
        if self._is_near(a, b, T_a_b, _NEAR):
            # Contradictions come from moving objects or errors of the pose.
            limit = max(limit, _SAME_PLACE)
        return overlap > 0 and against / overlap > limit

    def _is_near(self, a: _Island, b: _Island, T_a_b: Float64, far: float) -> bool:
        """Whether the camera had no time to move by `far` between the two sides, and T_a_b agrees.

        `far` is a fraction of the depth, and rad. A pose further away than the camera can have
        moved is contradicted by the short time, not supported.
        """
        T = {**a.T, **_transformed(b.T, T_a_b)}
        for c in a.T:
            for d in b.T:
                before, after = self._in_time(c, d)
                elapsed = float(after.times[0] - before.times[-1])
                if before.recording != after.recording or elapsed < 0:
                    continue
                reach = self._speed * elapsed
                if reach[0] < far * before.depth and reach[1] < far:
                    between = motion_over(before, after, T)
                    metres = float(np.linalg.norm(between[:3, 3]))
                    if metres < far * before.depth and float(se3.angle(between)) < far:
                        return True
        return False

    def _in_time(self, c: int, d: int) -> tuple[Stretch, Stretch]:
        first, second = self._stretches[c], self._stretches[d]
        return (first, second) if first.frames[0] < second.frames[0] else (second, first)

    def _drifted(self, T: Float64, other: Float64, depth: float, drift: float) -> bool:
        """Whether two poses differ by no more than drift and the error of a single link."""
        between = se3.inverse(T) @ other
        limit = drift + _LINK_ERROR
        return bool(np.linalg.norm(between[:3, 3]) <= limit * depth and se3.angle(between) <= limit)

    def _confirming(self, a: _Island, b: _Island, T_a_b: Float64, known: list[Link]) -> list[Link]:
        """Registrations of other view pairs that agree with T_a_b."""
        seen = {frozenset((link.i, link.j)) for link in known}
        found = []
        count = _VERIFY if self._options.min_probability else 4
        for first, second, T, _ in self._overlapping(a, b, T_a_b)[:count]:
            if frozenset((first.index, second.index)) in seen:
                continue
            # Along degenerate directions an alignment stays at its guess, which confirms nothing.
            made = follow(second.view, first.view, T, usual=self._usual)
            link = _link(first, second, made)
            if link is None or len(link.registration.unobservable):
                continue
            if not differ(link.T_i_j, T):
                found.append(replace(link, certain=False))
        return found

    def _reachable(self, a: _Island, b: _Island, T_a_b: Float64) -> bool:
        """Whether the camera can have moved from one side to the other in the elapsed time."""
        T = {**a.T, **_transformed(b.T, T_a_b)}
        for c in a.T:
            for d in b.T:
                first, second = self._in_time(c, d)
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


def _link(first: View, second: View, found: Registration | None) -> Link | None:
    """Return a registration of two views as a link, None if it is not probable."""
    if found is None or not found.is_probable:
        return None
    return Link(first.index, second.index, found, found.stands_alone, found.how)


def _transformed(T: Mapping[int, Float64], T_other: Float64) -> dict[int, Float64]:
    """Poses of components in another frame."""
    return {c: np.asarray(T_other @ T_c, np.float64) for c, T_c in T.items()}


def _best(links: Sequence[Link]) -> Link:
    """The link that defines the pose; the others confirm it."""
    return max(links, key=lambda link: (link.certain, _weight(link)))


def _tracking_failures(stretches: Sequence[Stretch]) -> int:
    """Number of components that end where the next frame of the recording begins another one."""
    first = {(s.recording, int(s.frames[0])) for s in stretches}
    return sum((s.recording, int(s.frames[-1]) + 1) in first for s in stretches)


def _key(a: _Island, b: _Island, between: Sequence[Link]) -> tuple[int, ...]:
    """Key of a decision: two islands, and the number of links between them."""
    return (*sorted(a.T), -1, *sorted(b.T), -1, len(between))


def _weight(link: Link) -> float:
    """Weight of a link: a certain one counts twice."""
    return (2.0 if link.certain else 1.0) * (0.5 + (link.registration.support or 0.0))
