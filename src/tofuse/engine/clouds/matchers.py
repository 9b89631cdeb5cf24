"""The closest point of the target to each point of the source (section 2.9.3)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from tofuse.engine.clouds.interfaces import Alignment, Matcher, Matches, Points, Search
from tofuse.engine.clouds.surface_shape import tree_of
from tofuse.engine.geometry import KdTree
from tofuse.engine.parts import part


@part("matcher", "closest-point", label="validated")
@dataclass(frozen=True)
class ClosestPoint(Matcher):
    """The closest point of the target (Besl and McKay 1992), by a kd-tree (section 2.9.5)."""

    takes: ClassVar[frozenset[str]] = frozenset({"range", "cloud"})

    def prepare(self, target: Points) -> Search:
        """Build the tree, once for all iterations: the target doesn't move.

        The tree of a full view is shared by all registrations against it.
        """
        view = target.view
        is_full_view = len(target) == len(view) and bool((np.diff(target.index) == 1).all())
        return _TreeSearch(tree_of(view) if is_full_view else KdTree(target.points))


@dataclass(frozen=True, eq=False)
class _TreeSearch:
    tree: KdTree

    def match(self, alignment: Alignment, reach: float) -> Matches:
        index, squared = self.tree.nearest(alignment.transformed, reach)
        source = np.flatnonzero(index >= 0)
        return Matches(source, index[source], np.sqrt(squared[source]))
