"""How many points the filters removed."""

from __future__ import annotations

import pytest

from tofuse.engine.filters.base import Removal
from tofuse.engine.mapping.preparation import Counts


def test_filter_used_twice_received_what_reached_it_first() -> None:
    counts = Counts()
    for _ in range(2):
        removals = [Removal("confidence", 100, 10), Removal("edges", 90, 9)]
        counts.add([*removals, Removal("confidence", 81, 2)])
    assert counts.fractions == pytest.approx({"confidence": 0.12, "edges": 0.1})
