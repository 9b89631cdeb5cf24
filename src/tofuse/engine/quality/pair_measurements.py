"""Independent measurements of relative poses from pairs of overlapping views."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tofuse.engine.alignment import covariance, projective
from tofuse.engine.arrays import Float64, Intp
from tofuse.engine.compute import run_chunks
from tofuse.engine.geometry import se3
from tofuse.engine.graph import PoseGraph, measured_graph
from tofuse.engine.quality.pose_accuracy import without_degenerate
from tofuse.engine.refinement import joint_alignment
from tofuse.engine.stored_views import PosedView, SampledView, overlaps, pair_equations
from tofuse.engine.views import PreparedView

_ALIGNMENT = projective.ProjectiveOptions()
# Pairs are selected as in joint refinement.
_PAIRS = pair_equations.RefineOptions()


def measured_pairs(views: Sequence[PosedView[PreparedView]], poses: Float64) -> PoseGraph:
    """Align every pair of views that overlap, and each view with the one before it.

    The poses only select the pairs and initialise their alignments.

    Parameters
    ----------
    views
        In the order of their frames.
    poses
        (N, 4, 4) T_world_camera.

    Returns
    -------
    A graph of the frames with these poses, every edge with the covariance of its alignment
    (`registration.uncertainty`). Degenerate directions of a pair have almost no information.
    """
    pairs = _overlapping(views, poses)
    surfaces = [view.view for view in views]
    T_i_j = se3.inverse(poses[pairs[:, 0]]) @ poses[pairs[:, 1]]

    def work(start: int, stop: int) -> list[tuple[Float64, Float64, Float64]]:
        results = []
        for (i, j), T in zip(pairs[start:stop].tolist(), T_i_j[start:stop], strict=True):
            target = [projective.Target(surfaces[i], np.eye(4))]
            aligned = projective.align(surfaces[j], target, T, _ALIGNMENT)
            C = covariance(surfaces[j], target, aligned, _ALIGNMENT)
            results.append((aligned.T_world_source, C, aligned.unobservable * projective.UNITS))
        return results

    results = [result for chunk in run_chunks(work, len(pairs), 64) for result in chunk]
    ids = [view.index for view in views]
    edges = [
        measured_graph.Measured(ids[i], ids[j], T, np.asarray(np.linalg.inv(C), np.float64))
        for (i, j), (T, C, _) in zip(pairs.tolist(), results, strict=True)
    ]
    return without_degenerate(
        measured_graph.build_graph(ids, poses, edges), [degenerate for _, _, degenerate in results]
    )


def _overlapping(views: Sequence[PosedView[PreparedView]], poses: Float64) -> Intp:
    """Return (M, 2) positions i < j of the views that are compared."""
    sampled = [SampledView.of(view.view, _PAIRS.points) for view in views]
    pairs = joint_alignment.spread_evenly(
        overlaps(sampled, poses, _PAIRS.overlap)[0], _PAIRS.neighbours
    )
    later = np.arange(1, len(views))
    consecutive = np.stack([later - 1, later], 1)
    return np.unique(np.concatenate([pairs, consecutive]), axis=0)
