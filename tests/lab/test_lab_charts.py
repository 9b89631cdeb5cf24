"""Parametrisations of rotations in pose graphs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tofuse.engine.geometry import se3
from tofuse.engine.graph.graph import Gravity
from tofuse.engine.graph.levenberg import minimise
from tofuse.engine.graph.robust import Settings
from tofuse.lab.methods.charts import Chart, Cosines, Quaternion, descend
from walked_graph import walk

CHARTS = [Quaternion(), Cosines()]


@pytest.mark.parametrize("chart", CHARTS)
@pytest.mark.parametrize("with_gravity", [False, True])
def test_minimum_is_that_of_tangents(chart: Chart, with_gravity: bool) -> None:
    graph, truth, _ = walk(20, 10)
    if with_gravity:
        down = np.swapaxes(truth[:, :3, :3], 1, 2) @ [0.0, 0.0, 1.0]
        graph = replace(graph, gravity=Gravity(np.arange(20), down, np.full(20, 0.01), 1e6))
    least = minimise(graph, Settings("none", tolerance=1e-14))
    found = descend(graph, chart, tolerance=1e-14)
    objective = [chi2.sum() + of_gravity for chi2, of_gravity in found.log]
    assert objective[0] == pytest.approx(least.objective[0])
    assert objective[-1] == pytest.approx(least.objective[-1], rel=1e-9)
    assert objective[-1] < 0.1 * objective[0]
    np.testing.assert_allclose(found.poses[:20], least.graph.poses, atol=1e-6)
    np.testing.assert_array_equal(found.poses[0], graph.poses[0])


@pytest.mark.parametrize("chart", CHARTS)
def test_basis_is_derivative_of_retraction(chart: Chart) -> None:
    rng = np.random.default_rng(0)
    poses = se3.exp(rng.normal(size=(4, 6)))
    P, normal_projector = chart.basis(poses)
    assert P.shape == (4, 6, chart.size)
    # Along directions within the manifold.
    step = rng.normal(size=(4, chart.size, 1))
    step = 1e-5 * np.linalg.solve(np.eye(chart.size) + 1e12 * normal_projector, step)
    moved = se3.log(se3.inverse(poses) @ chart.retract(poses, step[..., 0]))
    np.testing.assert_allclose(moved, (P @ step)[..., 0], atol=1e-8)
    assert np.abs(moved).max() > 1e-6
