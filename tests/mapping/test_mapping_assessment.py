"""Errors of the poses that the assessment takes from the earlier stages."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from tofuse.engine.geometry import se3
from tofuse.engine.mapping.assessment import Assessment
from tofuse.engine.mapping.methods import from_method
from tofuse.engine.refinement import Refinement


def test_poses_that_stayed_may_be_where_their_measurements_prefer():
    poses = se3.exp(np.random.default_rng(1).uniform(-1, 1, (8, 6)))
    away = poses @ se3.exp(np.random.default_rng(2).normal(0, 0.01, (8, 6)))
    refinement = Refinement(poses, kept=True, disputed_m=0.003, disputed_rad=0.002)
    assessment = Assessment(from_method("default"), None, None, None, ())

    def moved(before, after) -> tuple[float, float]:
        graphs = [SimpleNamespace(poses=p) for p in (before, after)]
        closed = SimpleNamespace(optimisation=SimpleNamespace(graph=graphs[0]))
        refined = SimpleNamespace(graph=graphs[1], refinement=refinement)
        observed = assessment._observed_errors(closed, refined, None)
        return observed.moved_m, observed.moved_rad

    assert moved(poses, poses) == pytest.approx((0.003, 0.002))
    # Other measurements may have moved them farther.
    assert min(np.divide(moved(poses, away), (0.003, 0.002))) > 2
