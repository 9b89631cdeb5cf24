"""Frames connected to the rest by a single link are reported."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from tofuse.engine.alignment.base import Link, Registration
from tofuse.engine.graph.graph import LoopRecord
from tofuse.engine.loops.merged_components import Join
from tofuse.engine.mapping.assessment import single_link_frames
from tofuse.engine.mapping.tracked_graph import TrackedGraph

FOUND = Registration(np.eye(4), True, 5, 100, 100, 0.1, 0.01, np.eye(6))
# Frames 0 to 8, three in each component.
POSED = [
    SimpleNamespace(record=SimpleNamespace(index=k), step=SimpleNamespace(component=k // 3))
    for k in range(9)
]


def join(i, j, kind="links", defines_pose=True):
    return Join(Link(i, j, FOUND, True, "made"), kind, defines_pose)


def loop(i, j, accepted=True):
    return LoopRecord(i, j, accepted, "made")


@pytest.mark.parametrize(
    ("joins", "loops", "expected"),
    [
        ([], [], ()),
        ([join(2, 3), join(5, 6)], [], (3, 4, 5, 6, 7, 8)),
        ([join(2, 3), join(1, 4, defines_pose=False), join(5, 6)], [], (6, 7, 8)),
        ([join(6, 5), join(2, 3), join(1, 4)], [], (6, 7, 8)),
        ([join(2, 3), join(5, 6)], [loop(0, 8)], ()),
        ([join(2, 3), join(5, 6)], [loop(0, 8, accepted=False)], (3, 4, 5, 6, 7, 8)),
        # The same two views again, and a loop within a component.
        ([join(2, 3), join(5, 6)], [loop(3, 2), loop(6, 8), loop(4, 7)], (3, 4, 5, 6, 7, 8)),
        ([join(2, 3, "motion"), join(5, 6)], [], (6, 7, 8)),
    ],
)
def test_frames_behind_a_single_link(joins, loops, expected) -> None:
    assert single_link_frames(TrackedGraph(POSED, {}, joins), loops) == expected
