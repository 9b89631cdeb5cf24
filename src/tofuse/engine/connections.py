"""Which of many things are connected, directly or by way of others."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from tofuse.engine.arrays import Intp


def parts_of(count: int, pairs: ArrayLike) -> Intp:
    """Return the (count,) number of the part of each thing, in the order of their first ones.

    `pairs` (M, 2) are positions of things that are connected.
    """
    from scipy import sparse  # takes long to import

    i, j = np.asarray(pairs, np.intp).reshape(-1, 2).T
    graph = sparse.coo_array((np.ones(len(i), bool), (i, j)), shape=(count, count))
    return np.asarray(sparse.csgraph.connected_components(graph, directed=False)[1], np.intp)
