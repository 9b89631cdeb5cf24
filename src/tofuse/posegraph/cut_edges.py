"""Edges that alone hold a graph together: nothing else confirms what they say."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

Edge = tuple[int, int]


def cut_edges(edges: Sequence[Edge]) -> dict[int, tuple[frozenset[int], frozenset[int]]]:
    """Find the edges without which a graph falls apart.

    Parameters
    ----------
    edges
        Pairs of nodes, of any numbers. Several edges between the same two confirm each other.

    Returns
    -------
    By position of such an edge the nodes that are connected with its first end without it, and
    those that are connected with its second one.
    """
    nodes = sorted({node for edge in edges for node in edge})
    row = {node: k for k, node in enumerate(nodes)}
    ends = np.array([(row[a], row[b]) for a, b in edges], np.intp).reshape(-1, 2)
    parallel = Counter(frozenset(edge) for edge in edges)
    found = {}
    for k, (a, b) in enumerate(edges):
        if a == b or parallel[frozenset((a, b))] > 1:
            continue
        rest = np.delete(ends, k, axis=0)
        graph = csr_array((np.ones(len(rest)), tuple(rest.T)), shape=(len(nodes), len(nodes)))
        _, label = connected_components(graph, directed=False)
        first, second = label[row[a]], label[row[b]]
        if first != second:
            found[k] = (
                frozenset(node for node in nodes if label[row[node]] == first),
                frozenset(node for node in nodes if label[row[node]] == second),
            )
    return found
