"""Comprehensive ICP (Almhdie, Leger, Deriche and Ledee 2007): one-to-one pairs."""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import numpy as np

from tofuse.engine.geometry import KdTree
from tofuse.engine.icp import Icp, icp_parts, interfaces
from tofuse.engine.parts import part
from tofuse.lab.methods.variants import Variant

# Initial number of neighbours per query, doubled when all are matched.
_INITIAL_NEIGHBOURS = 8


@part("matcher", "comprehensive", label="validated")
@dataclass(frozen=True)
class Comprehensive(interfaces.Matcher):
    """The shortest pairs, each point in at most one pair.

    The paper writes the distances of all points into a lookup matrix, takes the smallest entry,
    deletes its row and its column, and repeats. A kd-tree gives the same pairs without the matrix:
    each source point proposes its nearest free target point, and the shortest proposal is accepted.
    """

    def prepare(self, target: interfaces.Points) -> interfaces.Search:
        """Build the tree, once for all iterations."""
        return _LookupSearch(KdTree(target.points))


@dataclass(frozen=True, eq=False)
class _LookupSearch:
    tree: KdTree

    def match(self, alignment: interfaces.Alignment, reach: float) -> interfaces.Matches:
        points, size = alignment.transformed, len(self.tree)
        indices, distances2 = self.tree.neighbours(points, min(_INITIAL_NEIGHBOURS, size))
        candidates = dict(enumerate(zip(indices, distances2, strict=True)))
        proposals = [(float(distances2[k, 0]), k, 0) for k in range(len(points))]
        heapq.heapify(proposals)
        matched = np.zeros(size, bool)
        pairs = []
        while proposals:
            distance2, source, rank = heapq.heappop(proposals)
            if distance2 > reach * reach:
                break
            target = int(candidates[source][0][rank])
            if not matched[target]:
                matched[target] = True
                pairs.append((source, target, distance2))
                continue
            rank += 1
            if rank == len(candidates[source][0]) < size:
                index, more_distances2 = self.tree.neighbours(
                    points[source : source + 1], min(2 * rank, size)
                )
                candidates[source] = index[0], more_distances2[0]
            if rank < len(candidates[source][0]):
                heapq.heappush(proposals, (float(candidates[source][1][rank]), source, rank))
        pairs.sort()
        i, j, d2 = np.array(pairs).reshape(-1, 3).T
        return interfaces.Matches(i.astype(np.int64), j.astype(np.int64), np.sqrt(d2))


@part("registration", "cicp", label="validated")
@dataclass(frozen=True)
class Cicp(Variant):
    """ICP with the pairs of a comprehensive lookup matrix (Almhdie et al. 2007).

    Attributes
    ----------
    resolution
        Typical distance between neighbouring points, m.
    points
        Random points of the source, against all of the target.
    max_iterations
        Maximum number of iterations.
    """

    resolution: float = 0.01
    points: int = 1000
    max_iterations: int = 100

    def parts(self) -> Icp:
        """See `Variant.parts`."""
        return Icp(
            self.resolution,
            source=icp_parts.Random(self.points),
            target=icp_parts.All(),
            matcher=Comprehensive(),
            rejectors=(),
            metric=icp_parts.PointToPoint(),
            stopping=icp_parts.SmallStep(max_iterations=self.max_iterations),
        )
