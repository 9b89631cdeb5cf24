"""Pose graphs with the motions that colour images measure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tofuse.engine.color.color_pairs import measured_pairs
from tofuse.engine.color.color_views import SEARCHES, ColorView
from tofuse.engine.graph import Measured, Optimiser, PoseGraph, graph_covariances


def with_color(
    graph: PoseGraph, views: Sequence[ColorView], optimiser: Optimiser
) -> tuple[PoseGraph, tuple[Measured, ...]]:
    """Return the optimised graph with the motions between views, and these edges.

    Each search predicts by the poses of the one before. Motions that contradict the others are
    rejected, as repeated patterns may be mistaken.

    Parameters
    ----------
    graph
        Poses and edges by depth. The views are of some of its frames.
    views
        In the order of time.
    optimiser
        Solves the graph.
    """
    row = {int(index): k for k, index in enumerate(graph.ids)}
    rows = [row[view.index] for view in views]
    poses = graph.poses
    accepted: tuple[Measured, ...] = ()
    for search in SEARCHES:
        measured = measured_pairs(views, poses[rows], search)
        if not measured:
            return graph, ()
        extended = graph.with_poses(poses).with_edges(measured)
        suspected = np.arange(len(extended.edges)) >= len(graph.edges)
        done = optimiser.optimise(replace(extended, loop=suspected))
        weights = np.ones(len(suspected)) if done.weights is None else done.weights
        kept = np.flatnonzero(weights[len(graph.edges) :] >= graph_covariances.MIN_WEIGHT)
        poses, accepted = done.graph.poses, tuple(measured[k] for k in kept.tolist())
    return graph.with_poses(poses).with_edges(accepted), accepted
