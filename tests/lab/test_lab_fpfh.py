"""Registration by histograms of normals and consensus of matches, as a part."""

from __future__ import annotations

import numpy as np
import pytest

import tofuse
from pose_errors import pose_error
from registration_scenes import rng, stone, turn
from searched_pair import TRUE, clouds
from tofuse.engine.geometry import se3
from tofuse.lab.methods.fpfh import Fpfh


@pytest.mark.parametrize("degrees", [30, 75, 120, 180])
def test_partially_overlapping_views_under_any_rotation(degrees):
    source, target = clouds()
    turned = turn(rng(degrees).normal(size=3), degrees, centre=np.median(source, 0))
    strange = rng(7).uniform(source.min(0), source.max(0), (len(source) // 10, 3))
    moved = se3.transform(se3.inverse(turned), np.vstack([source, strange]))
    found = tofuse.register(moved, target, method=Fpfh())
    shift, angle = pose_error(found.T_target_source, TRUE @ turned, moved)
    assert shift < 0.01
    assert angle < 0.3
    assert found.margin > 0


def test_cube_has_no_margin():
    """All faces are identical, so that it fits as well after a rotation by 90 degrees."""

    def cube(seed):
        r = rng(seed)
        p = r.uniform(-0.5, 0.5, (3000, 3))
        p[np.arange(3000), r.integers(0, 3, 3000)] = 0.5 * r.choice([-1, 1], 3000)
        return p

    found = tofuse.register(cube(1), cube(0), method=Fpfh(refine=False))
    body = tofuse.register(stone(3000, 1), stone(3000, 0), method=Fpfh(refine=False))
    assert found.margin < 0.1 < 0.25 < body.margin
