"""Pose graphs from measurements between frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.errors import InputError
from tofuse.engine.graph.graph import PoseGraph


@dataclass(frozen=True, eq=False)
class Measured:
    """One measurement between frames i and j: T_i_j and its (6, 6) information."""

    i: int
    j: int
    T_i_j: Float64
    information: Float64


def build_graph(
    ids: Sequence[int],
    poses: Float64,
    sequence: Sequence[Measured],
    loops: Sequence[Measured] = (),
) -> PoseGraph:
    """Build the graph of posed frames and of the measurements between them.

    Parameters
    ----------
    ids
        Indices of the N frames that have a pose.
    poses
        (N, 4, 4) T_world_camera.
    sequence, loops
        Odometry edges, and loop edges; both may be empty.

    Raises
    ------
    InputError
        If an edge names a frame that has no pose.
    """
    position = {int(index): k for k, index in enumerate(ids)}
    edges = [*sequence, *loops]
    for edge in edges:
        for index in (edge.i, edge.j):
            if index not in position:
                raise InputError(
                    f"the edge {edge.i} {edge.j} names frame {index}, which has no pose",
                    where="pose graph",
                )
    m = len(edges)
    return PoseGraph(
        ids=np.array(ids, np.intp),
        poses=np.asarray(poses, float).reshape(-1, 4, 4),
        edges=np.array([(position[e.i], position[e.j]) for e in edges], np.intp).reshape(m, 2),
        measurements=np.array([e.T_i_j for e in edges], float).reshape(m, 4, 4),
        information=np.array([e.information for e in edges], float).reshape(m, 6, 6),
        loop=np.arange(m) >= len(sequence),
    )
