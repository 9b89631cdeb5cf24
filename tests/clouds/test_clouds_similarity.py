"""Clouds of unknown relative scale."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

import tofuse
from registration_scenes import rng, stone
from scanned_flat import scanned
from tofuse.engine.geometry import se3

ANYWHERE = se3.exp([1.0, -0.7, 0.4, 1.9, 0.3, -1.0])
MAP = np.array([500_000.0, 4_000_000.0, 100.0])


@pytest.fixture(scope="module")
def scans():
    """Two scans of a room from different places, and the pose of the second in the first."""
    scan = partial(scanned, noise=0.005, rows=70)
    (T_a, a), (T_b, b) = scan([-2.6, -2.5, 1.3], 0.4, 0), scan([-1.6, -2.2, 1.3], 2.6, 1)
    return b, a, se3.inverse(T_a) @ T_b


def check(found, source, factor, T):
    """The scale is within 5 sigma and 0.3 %, and the points are mapped to their places."""
    assert found.believed, found.reason
    error = abs(found.scale * factor - 1)
    assert error < 0.003
    assert error < 5 * found.scale_sigma * factor
    moved = se3.transform(found.T_target_source, found.scale * factor * source)
    off = np.sqrt(((moved - se3.transform(T, source)) ** 2).sum(1).mean())
    assert off < 0.02


@pytest.mark.parametrize(
    "factor", [0.1, pytest.param(3.0, marks=pytest.mark.nightly),
               pytest.param(30.0, marks=pytest.mark.nightly_part)],
)  # fmt: skip
def test_scale_of_overlapping_scans_is_found(factor, scans):
    source, target, T = scans
    check(tofuse.register(factor * source, target, scale=True), source, factor, T)


@pytest.mark.nightly_part
def test_noise_and_missing_parts(scans):
    """A cloud as of images alone: a part of the room, noisier, in any orientation."""
    source, target, T = scans
    part = source[source[:, 0] > np.percentile(source[:, 0], 25)]
    part = part + rng(3).normal(0, 0.02, part.shape)
    moved = se3.transform(ANYWHERE, part)
    found = tofuse.register(0.2 * moved, target, scale=True)
    check(found, moved, 0.2, T @ se3.inverse(ANYWHERE))


@pytest.mark.nightly
def test_map_coordinates_and_repetition():
    source, target = stone(3000, 1, 0.001), stone(3000, 2, 0.001)
    found = tofuse.register(2 * source, target + MAP, scale=True)
    moved = se3.transform(found.T_target_source, found.scale * 2 * source)
    assert np.linalg.norm(moved - source - MAP, axis=1).max() < 0.02
    again = tofuse.register(2 * source, target + MAP, scale=True)
    assert again.scale == found.scale
    np.testing.assert_array_equal(again.T_target_source, found.T_target_source)


def test_scale_takes_neither_guess_nor_method():
    points = stone(500, 0)
    for options in ({"guess": np.eye(4)}, {"method": "icp"}):
        with pytest.raises(tofuse.InputError, match="does not apply to scale; leave one out"):
            tofuse.register(points, points, scale=True, **options)
