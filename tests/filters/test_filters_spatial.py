"""Filters over neighbours: angle, nearest neighbours; and properties of all filters."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tofuse.engine import parts
from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.filters.base import Filter, apply_filters
from tofuse.engine.filters.outliers import (
    NeighbourFraction,
    NeighbourhoodAngle,
    mean_neighbour_distance,
)
from tofuse.engine.frames.frames import CloudFrame, RangeFrame
from tofuse.engine.geometry import se3
from tofuse.lab.methods.filters_box import Box


def frame(z: Any, focal: float = 230.0, **images: Any) -> RangeFrame:
    z = np.asarray(z, np.float32)
    h, w = z.shape
    camera = Pinhole(w, h, focal, focal, (w - 1) / 2, (h - 1) / 2)
    return RangeFrame(0, 0.0, camera, z, **images)


def line(z: Any, focal: float = 1.0) -> RangeFrame:
    """Two rows, the lower one invalid, so that pixels have neighbours to the sides only."""
    camera = Pinhole(len(z), 2, focal, focal, 0.0, 0.0)
    return RangeFrame(0, 0.0, camera, np.float32([z, [0] * len(z)]))


# Neighbourhood angle -------------------------------------------------------------------------


def is_kept(f: RangeFrame, threshold: float) -> bool:
    """Whether the first pixel's largest angle to a neighbour is at most the threshold, rad."""
    return bool(NeighbourhoodAngle(threshold).mask(f, ())[0, 0])


def test_angle_agrees_with_equation_2_6() -> None:
    rng = np.random.default_rng(0)
    obtuse = 0
    for _ in range(200):
        f = line(rng.uniform(0.5, 5, 2), focal=float(rng.uniform(1, 50)))
        p, n = f.point_image[0].astype(float)
        phi = math.acos(p @ n / np.linalg.norm(p) / np.linalg.norm(n))
        sine = np.linalg.norm(n) / np.linalg.norm(n - p) * math.sin(phi)
        # Beyond 90 degrees if n is further away than the foot of the perpendicular to O p at p.
        if n @ p > p @ p:
            angle = math.pi - math.asin(sine)
            assert is_kept(f, min(angle + 1e-3, math.pi))
            assert not is_kept(f, angle - 1e-3)
            obtuse += 1
        else:
            assert is_kept(f, math.pi / 2)
    assert 50 < obtuse < 150


def test_angle_removes_jump_edges_and_keeps_slopes() -> None:
    """May et al.: points between foreground and background are removed, tilted surfaces kept."""
    step = np.full((20, 30), 2.0)
    step[:, 15:] = 4.0
    step[:, 14] = 2.7  # a mixed pixel
    keep = NeighbourhoodAngle().mask(frame(step), ())
    assert not keep[:, 13:15].any()  # the rim and the mixed pixels
    assert keep[:, :13].all()
    assert keep[:, 15:].all()  # the background, which only has nearer neighbours
    # A wall seen at 15 degrees is kept, at 5 degrees it is removed.
    for grazing, kept in ((15, True), (5, False)):
        u = (np.arange(30) - 14.5) / 230
        z = 2 / (1 - u / math.tan(math.radians(grazing)))
        inside = NeighbourhoodAngle().mask(frame(np.tile(z, (20, 1))), ())[1:-1, 1:-1]
        assert inside.all() == kept
        assert inside.any() == kept


# Nearest neighbours --------------------------------------------------------------------------


def distance_twin(points: np.ndarray, k: int) -> np.ndarray:
    d = np.linalg.norm(points[:, None].astype(float) - points[None].astype(float), axis=2)
    return np.sort(d, axis=1)[:, 1 : k + 1].mean(1)


def cloud_of(seed: int, n: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (n, 3)).astype(np.float32)


@pytest.mark.parametrize("k", [1, 3, 8])
def test_mean_neighbour_distance_matches_brute_force(k: int) -> None:
    points = cloud_of(k, 300)
    points[10] = points[11] = points[12]
    assert mean_neighbour_distance(points, k) == pytest.approx(distance_twin(points, k), abs=1e-12)


def test_mean_neighbour_distance_of_few_points() -> None:
    assert mean_neighbour_distance(np.zeros((0, 3), np.float32), 3).shape == (0,)
    assert mean_neighbour_distance(np.zeros((1, 3), np.float32), 3).tolist() == [np.inf]
    assert mean_neighbour_distance(np.float32([[0, 0, 0], [0, 3, 4]]), 3).tolist() == [5, 5]


def test_neighbour_fraction_removes_most_distant() -> None:
    points = cloud_of(0, 401)
    f = CloudFrame.of(points)
    keep = NeighbourFraction(0.5, 3).mask(f, ())
    distance = distance_twin(points, 3)
    assert keep.sum() == 201
    assert distance[keep].max() <= distance[~keep].min()
    assert NeighbourFraction(0.0).mask(f, ()).all()
    assert not NeighbourFraction(1.0).mask(f, ()).any()
    assert NeighbourFraction(0.29).mask(CloudFrame.of(cloud_of(1, 100)), ()).sum() == 71


def test_neighbour_fraction_breaks_ties_by_order() -> None:
    # On a regular grid all inner points have the same distance.
    x, y = np.meshgrid(np.arange(8.0), np.arange(8.0))
    points = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3)
    keep = NeighbourFraction(0.5, 2).mask(CloudFrame.of(points), ())
    assert np.flatnonzero(keep).tolist() == list(range(32))


@settings(max_examples=25)
@given(seed=st.integers(0, 10**6), n=st.integers(2, 80), k=st.integers(1, 6))
def test_neighbour_distance_is_invariant_to_order_and_frame(seed: int, n: int, k: int) -> None:
    points = cloud_of(seed, n)
    rng = np.random.default_rng([seed, 1])
    order = rng.permutation(n)
    distance = mean_neighbour_distance(points, k)
    assert np.array_equal(mean_neighbour_distance(points[order], k), distance[order])
    moved = se3.transform(se3.exp(rng.uniform(-2, 2, 6)), points).astype(np.float32)
    assert mean_neighbour_distance(moved, k) == pytest.approx(distance, abs=2e-6)
    share = NeighbourFraction(0.4, k)
    keep = share.mask(CloudFrame.of(points), ())
    if len(np.unique(distance)) == n:
        assert np.array_equal(share.mask(CloudFrame.of(points[order]), ()), keep[order])


# All of them ---------------------------------------------------------------------------------


def every_filter() -> list[Filter]:
    for package in ("tofuse.engine.filters", "tofuse.lab.methods"):
        parts.discover(package)
    box = Box((-1.0, -1.0, 0.5), (1.0, 1.0, 3.0))
    known = parts.registered("filter")
    # Filters with a file or with a fit to a recording have tests of their own.
    others = {"mask", "background"}
    return [box if name == "box" else cls() for name, cls in known.items() if name not in others]


@settings(max_examples=30)
@given(seed=st.integers(0, 10**6), size=st.tuples(st.integers(2, 12), st.integers(2, 12)))
def test_no_filter_adds_or_moves_points(seed: int, size: tuple[int, int]) -> None:
    rng = np.random.default_rng(seed)

    def random_frame() -> RangeFrame:
        z = rng.choice([0.0, np.nan, np.inf, -1.0, 0.7, 2.0, 5.0], size) * rng.uniform(0.9, 1, size)
        amplitude = rng.choice([0.0, 100.0, 65535.0], size).astype(np.float32)
        confidence = rng.integers(0, 8, size).astype(np.uint8)
        return frame(z, amplitude_image=amplitude, confidence_image=confidence)

    history, f = [random_frame() for _ in range(3)], random_frame()
    cloud = CloudFrame.of(f.points)
    for item in every_filter():
        left, (removal,) = apply_filters([item], f, history)
        assert item.mask(f, history).shape == f.valid.shape
        assert not (left.valid & ~f.valid).any()
        assert np.array_equal(left.depth[left.valid], f.depth[left.valid])
        assert removal.received == len(f)
        assert removal.removed == len(f) - len(left)
        if "cloud" in item.takes:
            assert len(apply_filters([item], cloud)[0]) <= len(cloud)


@pytest.mark.parametrize("z", [np.zeros((4, 4)), np.eye(4)[:1].repeat(2, 0) * [[1], [0]]])
def test_empty_and_single_pixel_frames_are_filtered(z: np.ndarray) -> None:
    f = frame(z)
    for item in every_filter():
        left, _ = apply_filters([item], f, [f])
        assert len(left) <= len(f) <= 1
