"""Which of many things are connected, directly or by way of others."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tofuse.engine.arrays import Bool, Intp

# Slices of an image (H, W) for all pairs of neighbours: along the rows, and along the columns.
NEIGHBOURS: tuple[tuple[Any, Any], ...] = ((np.s_[:, 1:], np.s_[:, :-1]), (np.s_[1:], np.s_[:-1]))


def parts_of(count: int, pairs: ArrayLike) -> Intp:
    """Return the (count,) number of the part of each thing, in the order of their first ones.

    `pairs` (M, 2) are positions of things that are connected.
    """
    from scipy import sparse  # takes long to import

    i, j = np.asarray(pairs, np.intp).reshape(-1, 2).T
    graph = sparse.coo_array((np.ones(len(i), bool), (i, j)), shape=(count, count))
    return np.asarray(sparse.csgraph.connected_components(graph, directed=False)[1], np.intp)


def parts_of_image(shape: tuple[int, ...], connected: Iterable[Bool]) -> Intp:
    """Return the (H, W) number of the part of each pixel, in the order of their first ones.

    `connected` are masks of the pairs of `NEIGHBOURS`.
    """
    pixel = np.arange(np.prod(shape)).reshape(shape)
    pairs = [
        np.stack([pixel[a][mask], pixel[b][mask]], 1)
        for (a, b), mask in zip(NEIGHBOURS, connected, strict=True)
    ]
    return parts_of(pixel.size, np.concatenate(pairs)).reshape(shape)
