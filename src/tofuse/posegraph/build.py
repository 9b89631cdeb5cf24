"""From what odometry and loops measured to a pose graph."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from tofuse.errors import InputError
from tofuse.geometry import se3
from tofuse.odometry.base import Step
from tofuse.posegraph.graph import PoseGraph
from tofuse.posegraph.loops import LoopEdge

Float64 = NDArray[np.float64]

# What is known of a pose that was predicted, not measured: 1 m and 1 rad.
PREDICTED_INFORMATION = np.eye(6)


def graph_of(steps: Mapping[int, Step], loops: Sequence[LoopEdge] = ()) -> PoseGraph:
    """Make the graph of a run.

    Every frame with a pose becomes a vertex, and is joined to the frame it was registered to.
    Where a pose was predicted without a registration the edge is the prediction, nearly without
    weight. The first frame of a part that nothing joins to the rest gets no edge.

    Parameters
    ----------
    steps
        What odometry gave, by frame index, in the order of the frames.
    loops
        Confirmed loops, between frames that have poses.

    Raises
    ------
    InputError
        If a step or loop refers to a frame without a pose.
    """
    poses = {k: s.T_world_camera for k, s in steps.items() if s.T_world_camera is not None}
    edges: list[LoopEdge] = []
    for index, pose in poses.items():
        step = steps[index]
        if step.reference is None:
            continue
        _check(step.reference, poses, f"frame {index} was registered to")
        if step.registration is None:
            T = se3.inverse(poses[step.reference]) @ pose
            edges.append(LoopEdge(step.reference, index, T, PREDICTED_INFORMATION))
        else:
            r = step.registration
            edges.append(LoopEdge(step.reference, index, r.T_target_source, r.information))
    for loop in loops:
        for index in (loop.i, loop.j):
            _check(index, poses, f"the loop {loop.i} {loop.j} names")
    return _graph(
        np.array(list(poses), np.intp),
        np.array(list(poses.values()), float).reshape(-1, 4, 4),
        [*edges, *loops],
        len(edges),
    )


def chain(relative: Float64, loops: Sequence[LoopEdge] = ()) -> PoseGraph:
    """Make the graph of a plain sequence: n - 1 motions T_(k-1)_k in a row, and loops.

    The poses are the products of the motions (eqs 2.9, 3.1, 3.2) with the identity first; ids
    count from 0, and the odometry's information is the unit matrix.
    """
    relative = np.asarray(relative, float)
    edges = [LoopEdge(k, k + 1, T, np.eye(6)) for k, T in enumerate(relative)]
    ids = np.arange(len(relative) + 1)
    return _graph(ids, accumulate(relative), [*edges, *loops], len(edges))


def accumulate(relative: Float64) -> Float64:
    """Poses (n, 4, 4), the identity first, of n - 1 motions T_(k-1)_k (eqs 3.1 and 3.2)."""
    poses = np.empty((len(relative) + 1, 4, 4))
    poses[0] = np.eye(4)
    for k, T in enumerate(relative):
        # Rounding must not build up over thousands of products.
        poses[k + 1] = se3.orthonormalise(poses[k] @ T)
    return poses


def _check(index: int, poses: Mapping[int, Float64], what: str) -> None:
    if index not in poses:
        raise InputError(f"{what} frame {index}, which has no pose", where="pose graph")


def _graph(
    ids: NDArray[np.intp], poses: Float64, edges: Sequence[LoopEdge], sequential: int
) -> PoseGraph:
    position = {int(index): k for k, index in enumerate(ids)}
    m = len(edges)
    return PoseGraph(
        ids=ids,
        poses=poses,
        edges=np.array([(position[e.i], position[e.j]) for e in edges], np.intp).reshape(m, 2),
        measurements=np.array([e.T_i_j for e in edges], float).reshape(m, 4, 4),
        information=np.array([e.information for e in edges], float).reshape(m, 6, 6),
        loop=np.arange(m) >= sequential,
    )
