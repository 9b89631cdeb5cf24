"""Refinement in submaps, compared with that of all views at once; search for pairs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from aligned_surfaces import away, drifted, path, surfaces
from refined_submaps import refined
from tofuse.engine.compute.spill import Scratch
from tofuse.engine.refinement.calibration_check import CalibrationCheck, combine_checks
from tofuse.engine.refinement.refinement import Joint
from tofuse.engine.refinement.submaps import partition, submaps
from tofuse.engine.stored_views.view_store import candidate_pairs
from tofuse.engine.views.view_descriptors import (
    mutual_dissimilarity,
    pairwise_dissimilarity,
    similar_views,
)

COUNT = 40


@pytest.fixture(scope="module")
def swing() -> tuple[list, np.ndarray]:
    truth = path(COUNT)
    return surfaces(truth, noise=0.005), truth


@pytest.mark.nightly_part
def test_submaps_match_refinement_of_all_views(swing) -> None:
    views, truth = swing
    start = drifted(truth)
    whole, parts = (refined(Joint(submap=n), views, start) for n in (COUNT, 14))
    assert parts.kept
    assert away(start, truth) > 0.15
    assert away(whole.poses, truth) < 0.004
    assert away(parts.poses, truth) < 0.006
    assert parts.views == COUNT
    assert parts.support[1] > parts.support[0]
    assert abs(parts.support[1] - whole.support[1]) < 0.02
    np.testing.assert_array_equal(parts.poses[0], start[0])
    # All views show one place: some pairs across submaps are left out.
    assert 0.5 * whole.pairs < parts.pairs < whole.pairs
    assert {i for e in parts.edges for i in (e.i, e.j)} == set(range(COUNT))


@pytest.mark.nightly
def test_memory_limit_does_not_change_result(swing, tmp_path: Path) -> None:
    views, truth = swing
    some = [views[:12], drifted(truth)[:12]]
    for submap in (12, 10):
        much = refined(Joint(submap=submap), *some)
        little = refined(Joint(submap=submap), *some, Scratch(200_000, tmp_path))
        np.testing.assert_array_equal(much.poses, little.poses)
        assert [e.i for e in much.edges] == [e.i for e in little.edges]


def test_places_are_divided_into_equal_parts() -> None:
    places = np.random.default_rng(0).random((1000, 3)) * [40, 10, 2]
    label = partition(places, 300)
    counts = np.bincount(label)
    assert len(counts) == 4
    assert counts.max() - counts.min() <= 2
    # Each is a section of the path: as wide as a quarter of it.
    assert max(np.ptp(places[label == k, 0]) for k in range(4)) < 12
    assert (partition(places[:300], 300) == 0).all()
    np.testing.assert_array_equal(partition(np.zeros((10, 3)), 4), partition(np.zeros((10, 3)), 4))


def test_every_pair_is_in_at_most_one_submap() -> None:
    rng = np.random.default_rng(1)
    places = np.stack([np.linspace(0, 50, 500), rng.random(500), rng.random(500)], 1)
    i, j = np.triu_indices(500, 1)
    near = j - i <= 6
    pairs = np.stack([i[near], j[near]], 1)
    found = submaps(places, pairs, 100)
    assert len(found) == 5
    asked = np.concatenate([s.pairs for s in found])
    assert len(np.unique(asked, axis=0)) == len(asked)
    assert len(asked) == len(pairs)  # borders are narrow here, so that none is left out
    for s in found:
        assert np.isin(s.pairs, s.views).all()
        assert len(s.views) <= 125
    assert len(np.unique(np.concatenate([s.views for s in found]))) == 500


def test_views_of_nearby_places_are_compared() -> None:
    rng = np.random.default_rng(2)
    there = np.stack([np.linspace(0, 200, 1000), np.zeros(1000), np.zeros(1000)], 1)
    middles = np.concatenate([there, there[::-1]]) + 0.01 * rng.standard_normal((2000, 3))
    i, j = candidate_pairs(middles)
    assert (i < j).all()
    assert len(i) < 2000 * 1999 / 8
    pairs = set(zip(i.tolist(), j.tolist(), strict=True))
    assert all((k, 1999 - k) in pairs for k in range(990))  # the way back
    assert all((j - 1, j) in pairs for j in range(1, 2000))
    # The same for the newest view alone, except for distant views that select it.
    a, b = candidate_pairs(middles, 1999)
    assert set(b.tolist()) == {1999}
    assert {(0, 1999), (1998, 1999)} <= set(zip(a.tolist(), b.tolist(), strict=True))
    assert len(candidate_pairs(middles[:50])[0]) == 50 * 49 // 2  # few are all compared


@pytest.mark.nightly
def test_descriptor_index_finds_most_similar_views() -> None:
    rng = np.random.default_rng(4)
    places = rng.normal(0, 0.3, (200, 2, 15, 24)).astype(np.float32)
    # 200 places, each revisited later, rotated by two cells and with noise.
    first, again = places[:, :, 3:12, 6:18], places[:, :, 3:12, 4:16]
    noise = 0.02 * rng.standard_normal(again.shape).astype(np.float32)
    descriptors = np.concatenate([first, again + noise])
    descriptors[rng.random(descriptors.shape) < 0.05] = np.nan
    i, j = similar_views(descriptors, 0.25)
    pairs = set(zip(i.tolist(), j.tolist(), strict=True))
    assert sum((k, k + 200) in pairs for k in range(200)) > 180
    assert len(pairs) < 0.5 * 400 * 399 / 2
    far = pairwise_dissimilarity(descriptors, i, j, 0.25)
    some = (i % 4 == 0) & (j % 4 == 0)
    mutual = mutual_dissimilarity(list(descriptors[::4]), 0.25)
    np.testing.assert_allclose(far[some], mutual[i[some] // 4, j[some] // 4], atol=0.06)
    true = np.array([b == a + 200 for a, b in zip(i, j, strict=True)])
    assert far[true].max() < far[~true].min()


def test_submaps_share_camera_errors() -> None:
    quiet, alarm = (CalibrationCheck(), CalibrationCheck(alarm=True, errors={"focal": 0.05}))
    other = CalibrationCheck(alarm=True, errors={"focal": 0.04})
    assert not combine_checks([]).alarm
    assert not combine_checks([quiet, alarm]).alarm
    assert combine_checks([quiet, alarm, other]).errors == {"focal": 0.05}
