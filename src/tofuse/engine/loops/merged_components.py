"""Merged components: those joined so far, in a common frame, and the paths through them."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from tofuse.engine.alignment import Link
from tofuse.engine.arrays import Float64
from tofuse.engine.geometry import se3
from tofuse.engine.graph import bridges
from tofuse.engine.loops.gaps import TrackedComponent, View
from tofuse.engine.search import DISTINCT_M, DISTINCT_RAD

JoinKind = Literal["links", "motion", "odometry"]

# Largest drift within components, as a fraction of the path.
DRIFT = 0.05


@dataclass(frozen=True, eq=False)
class Join:
    """An edge that joins components.

    Attributes
    ----------
    link
        The measurement T_i_j between frames i and j.
    kind
        "links"; "odometry", or "motion" where the motion over a gap was extrapolated.
    defines_pose
        Whether it defines the pose of the component; otherwise it confirms another one.
    probability
        That the pose given by all links between the two sides is right; None if not computed.
    """

    link: Link
    kind: JoinKind
    defines_pose: bool
    probability: float | None = None


@dataclass(eq=False)
class MergedComponent:
    """Components that are joined so far.

    Attributes
    ----------
    T
        (4, 4) T_merged_component by component.
    joins
        Edges between them.
    """

    T: dict[int, Float64]
    joins: list[Join] = field(default_factory=list)


class MergedComponents:
    """All merged components; at first each component is one.

    Parameters
    ----------
    tracked
        The components.

    Attributes
    ----------
    all
        The merged components.
    tracked
        By component.
    component_of
        Component of each frame.
    views
        Stored views by frame.
    """

    def __init__(self, tracked: Sequence[TrackedComponent]) -> None:
        self.tracked = {s.component: s for s in tracked}
        self.component_of = {int(f): s.component for s in tracked for f in s.frames}
        self.views = {v.index: v for s in tracked for v in s.views}
        self.all = [MergedComponent({s.component: np.eye(4)}) for s in tracked]
        self._poses = {int(f): T for s in tracked for f, T in zip(s.frames, s.poses, strict=True)}
        # Frames of each component that links or verification refer to.
        self._nodes = {s.component: {v.index for v in s.views} for s in tracked}
        self._paths: dict[tuple[int, ...], dict[int, float]] = {}

    def of_component(self, component: int) -> MergedComponent:
        """Return the merged component that contains a component."""
        return next(merged for merged in self.all if component in merged.T)

    def is_joined(self, a: View, b: View) -> bool:
        """Return whether two views are in the same merged component."""
        return self.component_of[b.index] in self.of_component(self.component_of[a.index]).T

    def T_merged(self, merged: MergedComponent, frame: int) -> Float64:
        """Return the (4, 4) T_merged_camera of a frame."""
        T = merged.T[self.component_of[frame]] @ self._poses[frame]
        return np.asarray(T, np.float64)

    def T_a_b(self, a: MergedComponent, b: MergedComponent, link: Link) -> Float64:
        """Return the (4, 4) T_a_b implied by a link from a to b, or from b to a."""
        i, j, T = link.i, link.j, link.T_i_j
        if self.component_of[i] not in a.T:
            i, j, T = j, i, se3.inverse(T)
        return np.asarray(self.T_merged(a, i) @ T @ se3.inverse(self.T_merged(b, j)), np.float64)

    def ends(self, a: MergedComponent, link: Link) -> tuple[int, int]:
        """Return the frames of a link: the one in `a`, and the other."""
        return (link.i, link.j) if self.component_of[link.i] in a.T else (link.j, link.i)

    def depth_of(self, frame: int) -> float:
        """Return the typical depth of a frame's component, m."""
        return self.tracked[self.component_of[frame]].depth

    def path(self, merged: MergedComponent, start: int) -> dict[int, float]:
        """Return the path lengths from a frame to those with stored views or joins.

        Drift grows with them. They are measured along the poses of components, and across joins:
        rotation in rad plus translation as a fraction of the depth.
        """
        # Nodes are only added, so their number identifies the set.
        key = (start, sum(len(self._nodes[c]) for c in merged.T), *sorted(merged.T))
        if key not in self._paths:
            nodes = set().union(*(self._nodes[c] for c in merged.T))
            self._paths[key] = self._path_over(nodes | {start}, merged, start)
        return self._paths[key]

    def _path_over(self, nodes: set[int], merged: MergedComponent, start: int) -> dict[int, float]:
        order = sorted(nodes, key=lambda f: (self.component_of[f], f))
        T = np.stack([self.T_merged(merged, f) for f in order])
        row = {f: k for k, f in enumerate(order)}
        edges = [
            (row[f], row[g])
            for f, g in itertools.pairwise(order)
            if self.component_of[f] == self.component_of[g]
        ]
        edges += [(row[join.link.i], row[join.link.j]) for join in merged.joins]
        if not edges:
            return {start: 0.0}
        i, j = np.array(edges).T
        motion = se3.inverse(T[i]) @ T[j]
        depth = np.array([self.depth_of(order[k]) for k in i])
        lengths = np.linalg.norm(motion[:, :3, 3], axis=1) / depth + np.asarray(se3.angle(motion))
        graph = csr_array((lengths + 1e-9, (i, j)), shape=(len(order), len(order)))
        distances = dijkstra(graph, directed=False, indices=row[start])
        return {f: float(distances[k]) for f, k in row.items()}

    def consistent(
        self,
        a: MergedComponent,
        b: MergedComponent,
        first: Link,
        second: Link,
        T_first: Float64,
        T_second: Float64,
    ) -> bool:
        """Return whether the T_a_b of two links agree at the view of the first one.

        Drift between the views of the two links, on both sides, is tolerated.
        """
        i, j = self.ends(a, first)
        k, m = self.ends(a, second)
        drift = DRIFT * (self.path(a, i).get(k, np.inf) + self.path(b, j).get(m, np.inf))
        T_b_j = self.T_merged(b, j)
        difference = se3.inverse(T_first @ T_b_j) @ T_second @ T_b_j
        depth = self.depth_of(j)
        return se3.is_within(difference, DISTINCT_M + drift * depth, DISTINCT_RAD + drift)

    def separation(self, a: MergedComponent, b: MergedComponent, link: Link, other: Link) -> float:
        """Return the distance between the views of two links, on the side where it is larger.

        Translation as a fraction of the depth plus rotation in rad.
        """
        distances = []
        for merged, i, k in zip((a, b), self.ends(a, link), self.ends(a, other), strict=True):
            T = se3.inverse(self.T_merged(merged, i)) @ self.T_merged(merged, k)
            distance_m = float(np.linalg.norm(T[:3, 3]))
            distances.append(distance_m / self.depth_of(i) + float(se3.angle(T)))
        return max(distances)

    def by_start_time(self, c: int, d: int) -> tuple[TrackedComponent, TrackedComponent]:
        """Return two components in the order in which they began."""
        first, second = self.tracked[c], self.tracked[d]
        return (first, second) if first.frames[0] < second.frames[0] else (second, first)

    def positions(self, a: MergedComponent, b: MergedComponent) -> tuple[int, int]:
        """Return the positions of two merged components, ascending."""
        first, second = sorted((self.all.index(a), self.all.index(b)))
        return first, second

    def merge(self, a: MergedComponent, b: MergedComponent, link: Link, joins: list[Join]) -> None:
        """Move the components of `b` into `a`, at the pose of a link."""
        T_a_b = self.T_a_b(a, b, link)
        a.T.update(transformed(b.T, T_a_b))
        a.joins += [*b.joins, *joins]
        for join in joins:
            self.add_path_nodes(join.link)
        self.all.remove(b)

    def cut(self, join: Join) -> None:
        """Split a merged component at a join that alone connects its two sides."""
        merged = self.of_component(self.components(join)[0])
        self.all.remove(merged)
        self._paths.clear()
        edges = [self.components(other) for other in merged.joins]
        for side in bridges.sides_without(edges, merged.joins.index(join)):
            T = {c: merged.T[c] for c in merged.T if c in side}
            inside = [j for j in merged.joins if j is not join and self.components(j)[0] in side]
            self.all.append(MergedComponent(T, inside))

    def components(self, join: Join) -> tuple[int, int]:
        """Return the components that a join connects."""
        return self.component_of[join.link.i], self.component_of[join.link.j]

    def add_path_nodes(self, link: Link) -> None:
        """Add the frames of a link to those that paths are computed for."""
        for frame in (link.i, link.j):
            self._nodes[self.component_of[frame]].add(frame)

    def bridged_from(self, merged: MergedComponent, first: int) -> dict[int, JoinKind]:
        """Return the components that only bridges connect to the first one, and their kind."""

        def reachable(*kinds: JoinKind) -> set[int]:
            nodes, changed = {first}, True
            ends_of_joins = [
                {self.component_of[j.link.i], self.component_of[j.link.j]}
                for j in merged.joins
                if j.kind in kinds
            ]
            while changed:
                neighbours = {c for ends in ends_of_joins if ends & nodes for c in ends}
                changed = not neighbours <= nodes
                nodes |= neighbours
            return nodes

        by_links, by_odometry = reachable("links"), reachable("links", "odometry")
        bridged: dict[int, JoinKind] = dict.fromkeys(merged.T.keys() - by_links, "motion")
        bridged.update(dict.fromkeys(by_odometry - by_links, "odometry"))
        return bridged


def transformed(T: Mapping[int, Float64], T_other: Float64) -> dict[int, Float64]:
    """Return poses (4, 4) of components in another frame."""
    return {c: np.asarray(T_other @ T_c, np.float64) for c, T_c in T.items()}
