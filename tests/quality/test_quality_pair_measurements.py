"""Independent relative pose measurements of pairs of views."""

from __future__ import annotations

import numpy as np

from tofuse.engine.geometry import se3
from tofuse.engine.quality.pose_deviation import measured_pairs


def test_pairs_measure_true_motion_from_inexact_poses(posed_views) -> None:
    posed, truth = posed_views
    rng = np.random.default_rng(0)
    start = truth @ se3.exp(0.01 * rng.standard_normal((len(truth), 6)))
    graph = measured_pairs(posed, start)
    assert graph.ids.tolist() == list(range(len(truth)))
    assert np.array_equal(graph.poses, start)
    i, j = graph.edges.T
    assert {(k, k + 1) for k in range(len(truth) - 1)} <= set(
        zip(i.tolist(), j.tolist(), strict=True)
    )
    assert (j > i + 1).any()
    e = graph.with_poses(truth).residuals()
    assert np.median(np.linalg.norm(e[:, :3], axis=1)) < 0.004
    # Six if errors are as large as stated.
    assert np.median(np.einsum("mi,mij,mj->m", e, graph.information, e)) < 12
