"""Named combinations of parts: claims of their papers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from registration_scenes import bumpy_ball, error, relief, rng, stone, turn, view
from tofuse.engine import parts
from tofuse.engine.alignment.base import Registrar
from tofuse.engine.errors import InputError, RegistrationError
from tofuse.engine.geometry import se3
from tofuse.engine.icp.icp import Icp
from tofuse.engine.icp.icp_parts import All, MaxDistance, Random, SmallStep
from tofuse.engine.mapping.config import PACKAGES
from tofuse.lab.methods.compatibility import AmplitudeCompatibility
from tofuse.lab.methods.correspondence import ClosestInvariant
from tofuse.lab.methods.variants import (
    GeneralizedIcp,
    Iccp,
    Icpif,
    InTurn,
    PointToPlaneIcp,
    SymmetricIcp,
    Tricp,
)


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


@pytest.mark.slow
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
        plain = vanilla(0.015, 800).register(source, target, np.eye(4), rng())
        assert error(plain, T)[0] > 0.1


def test_tricp_trims_to_given_overlap():
    T = small(0)
    source = view(relief(2000, 2, -0.1, 0.9), T)
    target = view(relief(2000, 1, -0.5, 0.5))
    found = Tricp(0.015, points=500, overlap=0.55).register(source, target, np.eye(4), rng())
    assert found.correspondences == 275
    assert error(found, T)[0] < 0.02


def test_tricp_keeps_all_points_with_full_overlap():
    T = small(3)
    found = Tricp(0.015, points=600).register(
        view(stone(3000, 1, 0.002), T), view(stone(3000, 0, 0.002)), np.eye(4), rng()
    )
    assert found.inlier_ratio > 0.9


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


def test_iccp_finds_correspondences_that_rejector_loses():
    T = se3.exp([0.08, -0.06, 0, 0, 0, 0.05])
    target, source = textured_wall(4000, 0), textured_wall(4000, 1, T)
    first = replace(Iccp(0.015, points=1500, ratio=1.1), max_iterations=1)
    rejecting = replace(
        first.parts(),
        matcher=vanilla(1, 1).matcher,
        rejectors=(MaxDistance(10.0), AmplitudeCompatibility(1.1)),
    )
    compatible = first.register(source, target, np.eye(4), rng())
    rejected = rejecting.register(source, target, np.eye(4), rng())
    assert compatible.inlier_ratio > 0.95
    assert rejected.inlier_ratio < 0.5


def test_iccp_requires_amplitude():
    bare = view(relief(100, 0))
    with pytest.raises(RegistrationError, match="no amplitude"):
        Iccp().register(bare, bare, np.eye(4), rng())


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


def test_named_variants_register():
    T = turn([1, 2, 0.5], 2)
    source, target = view(relief(2500, 1), T), view(relief(2500, 0))
    for method in (PointToPlaneIcp(0.02), SymmetricIcp(0.02), GeneralizedIcp(0.02)):
        found = method.register(source, target, np.eye(4), rng())
        assert found.converged
        assert found.points == 1000
        assert error(found, T)[0] < 0.002
        assert error(found, T)[1] < 0.3


def test_variants_are_configurable_by_name():
    for package in PACKAGES:
        parts.discover(package)
    for name, data in {
        "point-to-plane": {"resolution": 0.05},
        "symmetric": {"points": 500},
        "gicp": {"epsilon": 0.01},
        "tricp": {"overlap": 0.7},
        "iccp": {"ratio": 1.5},
        "icpif": {"features": ["curvature", "moments"]},
        "coarse-to-fine": {"metric": {"part": "symmetric", "loss": "huber"}},
        "in-turn": {"stages": [{"part": "tricp"}, {"part": "gicp"}]},
        "icp": {
            "source": {"part": "normal-space", "points": 300},
            "matcher": {"part": "normal-shooting"},
            "metric": {"part": "gicp"},
            "rejectors": [{"part": "boundary"}, {"part": "trimmed", "overlap": 0.8}],
            "stopping": {"part": "small-step"},
        },
    }.items():
        made = parts.from_dict(Registrar, {"part": name, **data}, where="x.toml")
        assert parts.name_of(made) == name
        assert parts.from_dict(Registrar, parts.to_dict(made), where="x.toml") == made
        assert made.takes == {"range", "cloud"}


def test_matcher_that_needs_images_restricts_inputs():
    made = parts.from_dict(
        Registrar, {"part": "icp", "matcher": {"part": "projection"}}, where="x.toml"
    )
    assert made.takes == {"range"}
    assert InTurn((made, GeneralizedIcp())).takes == {"range"}


@pytest.mark.parametrize(
    "make",
    [
        lambda: Tricp(overlap=0.0),
        lambda: Tricp(smallest=1.0),
        lambda: Tricp(tolerance=0.0),
        lambda: ClosestInvariant(features=()),
        lambda: ClosestInvariant(weight=0.0),
        lambda: InTurn(()),
    ],
)
def test_invalid_options_are_rejected(make):
    with pytest.raises(ValueError, match="must be"):
        make()


def test_wrong_option_in_file_is_reported():
    with pytest.raises(InputError, match="overlap"):
        parts.from_dict(Registrar, {"part": "tricp", "overlap": 2.0}, where="x.toml")
