"""Named combinations of parts: claims of their papers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from registration_scenes import bumpy_ball, error, relief, rng, turn, view
from tofuse.engine.geometry import se3
from tofuse.engine.icp.icp import Icp
from tofuse.engine.icp.icp_parts import All, Random, SmallStep
from tofuse.lab.methods.variants import Iccp, Icpif, Tricp


def vanilla(resolution, points, steps=100):
    """ICP of Besl and McKay: no rejection."""
    return Icp(
        resolution,
        source=Random(points),
        target=All(),
        rejectors=(),
        stopping=SmallStep(1e-3, steps),
    )


def small(seed):
    T = turn(rng(seed).normal(size=3), 6)
    T[:3, 3] += rng(seed, 50).normal(0, 0.02, 3)
    return T


@pytest.mark.nightly
@pytest.mark.parametrize("overlap", [0.5, 0.65])
def test_tricp_estimates_overlap_and_motion_with_outliers(overlap):
    low = 0.5 - overlap  # of the source, where the target ends at 0.5
    for k in range(2):
        T = small(k)
        target = view(relief(3000, 1, -0.5, 0.5))
        source = view(relief(3000, 2, low, low + 1, outliers=150), T)
        true_fraction = (se3.transform(T, source.points[:3000])[:, 0] < 0.5).sum() / 3150
        found = Tricp(0.015, points=800).register(source, target, np.eye(4), rng())
        assert found.inlier_ratio == pytest.approx(true_fraction, abs=0.06)
        assert error(found, T)[0] < 0.015
        assert error(found, T)[1] < 1.5
        assert error(vanilla(0.015, 800).register(source, target, np.eye(4), rng()), T)[0] > 0.1


def textured_wall(n, seed, T=None):
    """A flat wall with a pattern of amplitude, and 2 % of noise."""
    r = rng(seed)
    x, y = r.uniform(-0.5, 0.5, (2, n))
    pattern = 0.8 * np.sin(9 * x + 2 * y) + 0.8 * np.cos(7 * y - 3 * x)
    amplitude = 200 * np.exp(pattern) * (1 + r.normal(0, 0.02, n))
    points = np.column_stack([x, y, np.full(n, 1.5)]) + r.normal(0, 0.001, (n, 3))
    return view(points, T, amplitude=amplitude.astype(np.float32))


def test_iccp_registers_textured_wall_where_icp_slides():
    T = se3.exp([0.04, -0.03, 0, 0, 0, 0.05])
    for k in range(3):
        target, source = textured_wall(4000, k), textured_wall(4000, 100 + k, T)
        iccp = Iccp(0.015, points=1500, ratio=1.1)
        found = iccp.register(source, target, np.eye(4), rng())
        plain = replace(iccp, ratio=1e9).register(source, target, np.eye(4), rng())
        assert error(found, T)[0] < 0.006
        assert error(found, T)[1] < 0.3
        assert error(plain, T)[0] > 0.012


@pytest.mark.parametrize("features", [("moments",), ("curvature",), ("curvature", "moments")])
def test_icpif_converges_from_larger_rotations_than_icp(features):
    target = view(bumpy_ball(4000, 0, 0.001), origin=(0, 0, 2))
    invariant, plain = [], []
    for k in range(4):
        T = turn(rng(k + 10).normal(size=3), 60)
        source = view(bumpy_ball(4000, 1, 0.001), T, origin=(0, 0, 2))
        method = Icpif(0.03, points=500, features=features)
        invariant.append(error(method.register(source, target, np.eye(4), rng()), T)[1])
        if features == ("moments",):
            found = vanilla(0.03, 500).register(source, target, np.eye(4), rng())
            plain.append(error(found, T)[1])
    assert max(invariant) < 6
    assert min(plain, default=90) > 20
