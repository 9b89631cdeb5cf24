"""Cut edges (bridges) of a graph: no other edge confirms their measurement."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

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
    remaining = np.array([(row[a], row[b]) for n, (a, b) in enumerate(edges) if n != k], np.intp)
    remaining = remaining.reshape(-1, 2)
    graph = csr_array((np.ones(len(remaining)), tuple(remaining.T)), shape=(len(nodes), len(nodes)))
    _, label = connected_components(graph, directed=False)
    first, second = (
        frozenset(node for node in nodes if label[row[node]] == label[row[end]]) for end in edges[k]
    )
    return first, second
