"""Pose graphs from measurements between frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tofuse.arrays import Float64
from tofuse.errors import InputError
from tofuse.geometry import se3
from tofuse.posegraph.graph import PoseGraph


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


def chain(relative: Float64, loops: Sequence[Measured] = ()) -> PoseGraph:
    """Build the graph of a sequence of n - 1 consecutive motions T_(k-1)_k, and loops.

    The poses are the products of the motions; ids count from 0, and the information of the
    sequence is the identity.
    """
    sequence = [Measured(k, k + 1, T, np.eye(6)) for k, T in enumerate(relative)]
    return build_graph(range(len(relative) + 1), accumulate(relative), sequence, loops)


def accumulate(relative: Float64) -> Float64:
    """Return poses (n, 4, 4), the identity first, of n - 1 motions T_(k-1)_k (eqs 2.9-3.2)."""
    poses = np.empty((len(relative) + 1, 4, 4))
    poses[0] = np.eye(4)
    for k, T in enumerate(relative):
        # Rounding errors would accumulate over thousands of products.
        poses[k + 1] = se3.orthonormalise(poses[k] @ T)
    return poses
