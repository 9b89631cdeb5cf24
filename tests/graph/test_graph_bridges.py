"""Bridges: edges whose removal disconnects a graph."""

from __future__ import annotations

import pytest

from tofuse.engine.loops.merged_components import cut_edges


@pytest.mark.parametrize(
    ("edges", "expected"),
    [
        ([], {}),
        ([(4, 2)], {0: ({4}, {2})}),
        ([(0, 1), (1, 0)], {}),
        ([(0, 1), (1, 2), (2, 0)], {}),
        ([(0, 1), (1, 2), (2, 0), (5, 2), (5, 7), (7, 5)], {3: ({5, 7}, {0, 1, 2})}),
        ([(0, 1), (1, 2)], {0: ({0}, {1, 2}), 1: ({0, 1}, {2})}),
        ([(0, 1), (1, 1), (8, 9)], {0: ({0}, {1}), 2: ({8}, {9})}),
    ],
)
def test_cut_edges_of_graphs(edges, expected) -> None:
    assert cut_edges(edges) == expected
