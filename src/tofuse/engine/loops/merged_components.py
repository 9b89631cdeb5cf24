"""Merged components: those joined so far, in a common frame, and the paths through them.

Gaps between parts of a recording that were tracked separately, and the motion over them.

The motion of the camera during a gap is bounded. It is measured by external odometry, or can be
extrapolated from both sides if the gap is short.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from tofuse.engine.alignment import Link, Registration
from tofuse.engine.arrays import Bool, Float64, Intp
from tofuse.engine.connections import parts_of
from tofuse.engine.geometry import retract, se3, twist_between
from tofuse.engine.normal import MEDIAN_OF_NORMAL
from tofuse.engine.search import DISTINCT_M, DISTINCT_RAD
from tofuse.engine.stored_views import PosedView
from tofuse.engine.tracking import HANDHELD
from tofuse.engine.views import PreparedView

View = PosedView[PreparedView]

# Largest error of a guess from which alignments converge: fraction of the depth, and rad.
CONVERGENCE = 0.1
# Motions on either side of a gap that bound the camera's speed within it, and the factor on their
# maximum.
_SPEED_SAMPLES, _SPEED_FACTOR = 20, 3.0
# Largest standard deviation of an extrapolated motion: fraction of the depth, and rad.
_MAX_SIGMA, _MAX_SIGMA_RAD = 0.02, np.radians(2.0)
# Poses at each end for the extrapolation, and minimum number of motions for a comparison with
# odometry.
_EXTRAPOLATED, _MIN_COMPARED = 5, 10


@dataclass(frozen=True, eq=False)
class TrackedComponent:
    """A component as tracked.

    Attributes
    ----------
    component
        Its number.
    frames
        (N,) indices, ascending.
    times
        (N,) s.
    poses
        (N, 4, 4) T_component_camera.
    views
        The stored views of its frames.
    recording
        Number of its recording, or (N,) of that of each frame, if several are merged: no motion is
        known between these.
    odometry
        (N, 4, 4) T_odometry_camera by external odometry, NaN where there is none; None without any.
    """

    component: int
    frames: Intp
    times: Float64
    poses: Float64
    views: tuple[View, ...]
    recording: int | Intp = 0
    odometry: Float64 | None = None

    @cached_property
    def depth(self) -> float:
        """Median depth of its views, m."""
        return float(np.median([v.depth for v in self.views])) if self.views else 1.0

    @cached_property
    def recordings(self) -> Intp:
        """(N,) number of the recording of each frame."""
        return np.broadcast_to(np.asarray(self.recording, np.intp), self.frames.shape)

    def part(self, chosen: Bool) -> TrackedComponent:
        """Return the component without some of its frames (N,), but with all of its views."""
        odometry = None if self.odometry is None else self.odometry[chosen]
        return replace(
            self,
            frames=self.frames[chosen],
            times=self.times[chosen],
            poses=self.poses[chosen],
            recording=self.recordings[chosen],
            odometry=odometry,
        )


def successions(
    a: TrackedComponent, b: TrackedComponent
) -> Iterator[tuple[TrackedComponent, TrackedComponent]]:
    """Yield the frames of the earlier component up to where the other one follows, and those after.

    Several times if one was joined across the other before; but not between two recordings.
    """
    frames = np.concatenate([a.frames, b.frames])
    order = np.argsort(frames)
    is_b = order >= len(a.frames)
    recordings = np.concatenate([a.recordings, b.recordings])[order]
    follows = (is_b[1:] != is_b[:-1]) & (recordings[1:] == recordings[:-1])
    for k in np.flatnonzero(follows).tolist():
        before, after = (b, a) if is_b[k] else (a, b)
        last = frames[order[k]]
        yield before.part(before.frames <= last), after.part(after.frames > last)


def motion_over(
    before: TrackedComponent, after: TrackedComponent, T: Mapping[int, Float64]
) -> Float64:
    """Return the motion (4, 4) from the end of one component to the start of another.

    `T` are their poses (4, 4) in a common frame, by component.
    """
    end = T[before.component] @ before.poses[-1]
    return np.asarray(se3.inverse(end) @ T[after.component] @ after.poses[0], np.float64)


def end_speeds(component: TrackedComponent, *, end: bool) -> Float64:
    """Return (n, 2) speeds, m/s and rad/s, of the motions next to the start, or to the end."""
    window = slice(-_SPEED_SAMPLES, None) if end else slice(None, _SPEED_SAMPLES)
    poses, times = component.poses[window], component.times[window]
    if len(poses) < 2:
        return np.zeros((0, 2))
    elapsed = np.maximum(np.diff(times), 1e-9)
    speeds = se3.lengths(se3.inverse(poses[:-1]) @ poses[1:]) / elapsed[:, None]
    return speeds[np.diff(component.recordings[window]) == 0]


def largest_motion(before: TrackedComponent, after: TrackedComponent) -> Float64:
    """Return the (2,) largest possible motion, m and rad, in a gap; infinite if unknown."""
    speeds = np.concatenate([end_speeds(before, end=True), end_speeds(after, end=False)])
    if len(speeds) < _SPEED_SAMPLES // 4:
        return np.full(2, np.inf)
    elapsed = max(float(after.times[0] - before.times[-1]), 0.0)
    return np.asarray(np.maximum(_SPEED_FACTOR * speeds.max(0), HANDHELD) * elapsed)


def odometry_over(before: TrackedComponent, after: TrackedComponent) -> Link | None:
    """Return the motion over a gap by odometry; None without any, or if it is too uncertain.

    Its errors are those of the tracked motions on both sides, and grow as in a random walk.
    """
    elapsed = float(after.times[0] - before.times[-1])
    if before.odometry is None or after.odometry is None or elapsed <= 0:
        return None
    T = np.asarray(se3.inverse(before.odometry[-1]) @ after.odometry[0], np.float64)
    all_errors, lengths, intervals = [], [], []
    for side, odometry in ((before, before.odometry), (after, after.odometry)):
        tracked = se3.inverse(side.poses[:-1]) @ side.poses[1:]
        measured = se3.inverse(odometry[:-1]) @ odometry[1:]
        all_errors.append(se3.log(se3.inverse(tracked) @ measured))
        lengths.append(se3.lengths(measured))
        intervals.append(np.diff(side.times))
    errors = np.concatenate(all_errors)
    valid = np.isfinite(errors).all(1)
    if valid.sum() < _MIN_COMPARED or not np.isfinite(T).all():
        return None
    step_count = max(elapsed / max(float(np.median(np.concatenate(intervals))), 1e-9), 1.0)
    # Errors of odometry are in proportion to the motion.
    typical = np.median(np.concatenate(lengths)[valid], axis=0) * step_count
    excess = np.maximum(se3.lengths(T) / np.maximum(typical, 1e-9), 1.0)
    step_sigma = np.median(np.abs(errors[valid]), axis=0) / MEDIAN_OF_NORMAL
    sigma = step_sigma * np.sqrt(step_count) * np.repeat(excess, 3)
    limit = np.repeat([CONVERGENCE * before.depth, CONVERGENCE], 3)
    if (sigma > limit).any():
        return None
    return _link_over_gap(before, after, T, np.maximum(sigma, 0.1 * limit), "bridged by odometry")


def extrapolated(before: TrackedComponent, after: TrackedComponent) -> Link | None:
    """Return the motion over a gap, extrapolated from both sides; None if it is too uncertain."""
    elapsed = float(after.times[0] - before.times[-1])
    n = _EXTRAPOLATED
    if min(len(before.frames), len(after.frames)) < n or elapsed <= 0:
        return None

    def velocities(component: TrackedComponent, window: slice) -> Float64:
        poses, times = component.poses[window], component.times[window]
        return np.stack(
            [
                twist_between(poses[k], poses[k + 1]) / max(float(times[k + 1] - times[k]), 1e-9)
                for k in range(len(poses) - 1)
            ]
        )

    v, w = velocities(before, slice(-n, None)), velocities(after, slice(None, n))
    interval = float(np.median(np.diff(np.concatenate([before.times[-n:], after.times[:n]]))))
    velocity_changes = np.concatenate([np.diff(v, axis=0), np.diff(w, axis=0)])
    # A random walk of the velocity, observed at both ends.
    random_walk = np.sqrt((velocity_changes**2).mean(0)) * np.sqrt(
        max(elapsed / max(interval, 1e-9), 1.0)
    )
    difference = np.abs(v[-2:].mean(0) - w[:2].mean(0))
    sigma = np.hypot(0.5 * random_walk, 0.5 * difference) * elapsed
    limit = np.repeat([_MAX_SIGMA * before.depth, _MAX_SIGMA_RAD], 3)
    if (sigma > limit).any():
        return None
    T = retract(np.eye(4), 0.5 * (v[-2:].mean(0) + w[:2].mean(0)) * elapsed)
    method = "bridged by the motion before and after the gap"
    return _link_over_gap(before, after, T, np.maximum(sigma, 0.1 * limit), method)


def _link_over_gap(
    before: TrackedComponent, after: TrackedComponent, T: Float64, sigma: Float64, method: str
) -> Link:
    """Return the link, given T (4, 4) from the frame after to the one before, and (6,) sigmas."""
    registration = Registration(T, True, 0, 0, 0, np.nan, np.nan, np.diag(1 / sigma**2))
    return Link(
        int(before.frames[-1]), int(after.frames[0]), registration, certain=False, how=method
    )


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
        return np.asarray(merged.T[self.component_of[frame]] @ self._poses[frame], np.float64)

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
        lengths = se3.change_of_view(motion, depth)
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
        """Return the change of view between those of two links, on the side where it is larger."""
        distances = []
        for merged, i, k in zip((a, b), self.ends(a, link), self.ends(a, other), strict=True):
            T = se3.inverse(self.T_merged(merged, i)) @ self.T_merged(merged, k)
            distances.append(float(se3.change_of_view(T, self.depth_of(i))))
        return max(distances)

    def views_of(self, merged: MergedComponent) -> list[View]:
        """Return the views of a merged component."""
        return [view for i, view in self.views.items() if self.component_of[i] in merged.T]

    def of_same_recording(
        self, a: MergedComponent, b: MergedComponent
    ) -> Iterator[tuple[TrackedComponent, TrackedComponent]]:
        """Yield where tracked components of one recording follow each other, see `successions`."""
        for c, d in itertools.product(a.T, b.T):
            yield from successions(self.tracked[c], self.tracked[d])

    def positions(self, a: MergedComponent, b: MergedComponent) -> tuple[int, int]:
        """Return the positions of two merged components, ascending."""
        first, second = sorted((self.all.index(a), self.all.index(b)))
        return first, second

    def merge(self, a: MergedComponent, b: MergedComponent, link: Link, joins: list[Join]) -> None:
        """Move the components of `b` into `a`, at the pose of a link."""
        a.T.update(transformed(b.T, self.T_a_b(a, b, link)))
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
        for side in sides_without(edges, merged.joins.index(join)):
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


Edge = tuple[int, int]


Sides = tuple[frozenset[int], frozenset[int]]


def cut_edges(edges: Sequence[Edge]) -> dict[int, Sides]:
    """Find the edges without which a graph is disconnected.

    Parameters
    ----------
    edges
        Pairs of nodes, of any numbers. Parallel edges confirm each other.

    Returns
    -------
    `sides_without` of each such edge, by its position.
    """
    parallel = Counter(frozenset(edge) for edge in edges)
    single = [k for k, (a, b) in enumerate(edges) if a != b and parallel[frozenset((a, b))] == 1]
    sides_of = {k: sides_without(edges, k) for k in single}
    return {k: sides for k, sides in sides_of.items() if not sides[0] & sides[1]}


def sides_without(edges: Sequence[Edge], k: int) -> Sides:
    """The nodes that are connected with either end of edge k without it."""
    nodes = sorted({node for edge in edges for node in edge})
    row = {node: n for n, node in enumerate(nodes)}
    remaining = [(row[a], row[b]) for n, (a, b) in enumerate(edges) if n != k]
    label = parts_of(len(nodes), remaining)
    first, second = (
        frozenset(node for node in nodes if label[row[node]] == label[row[end]]) for end in edges[k]
    )
    return first, second
