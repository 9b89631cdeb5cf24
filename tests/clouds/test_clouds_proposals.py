"""Proposals of poses: votes on translations, and steps of ICP of many poses at once."""

from __future__ import annotations

import numpy as np
import pytest

from pose_errors import pose_error
from searched_pair import TRUE, clouds
from tofuse.engine.clouds import proposals
from tofuse.engine.clouds.fpfh import DescribedCloud, MatchedPair
from tofuse.engine.clouds.robust_motion import ConsensusOptions, Pairs
from tofuse.engine.frames.frames import CloudFrame
from tofuse.engine.geometry import se3

SIZE = 0.05
T = se3.exp([0.4, -1.2, 0.3, 0.5, -0.9, 1.3])


def matched_pair(source, target):
    """Two described clouds: without pairs, which only motions of consensus sets need."""
    none = np.zeros((0, 3))
    options = ConsensusOptions(distinct_m=4 * SIZE, distinct_rad=0.15)
    return MatchedPair(source, target, SIZE, Pairs(none, none, np.zeros(0)), options)


def hardly_alike(seed, right=0.04):
    """A cloud and one moved by T, in which few points have the same descriptor."""
    rng = np.random.default_rng(seed)
    points, normals = rng.uniform(-2, 2, (1500, 3)), rng.normal(size=(1500, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    source = DescribedCloud(points, normals, rng.random((1500, 12)))
    histograms = rng.random((1500, 12))
    histograms[: int(right * 1500)] = source.histograms[: int(right * 1500)]
    moved = se3.transform(T, points) + rng.normal(0, 0.4 * SIZE, (1500, 3))
    return matched_pair(source, DescribedCloud(moved, normals @ T[:3, :3].T, histograms))


@pytest.mark.parametrize("seed", range(3))
def test_few_right_matches_agree_on_translation_at_inaccurate_rotation(seed):
    # 60 of 7500 votes are right, and at an angle of 3 degrees they differ by up to 0.15 m.
    pair = hardly_alike(seed)
    turned = T[:3, :3] @ se3.so3_exp([0.03, -0.03, 0.03])
    voted = proposals._voted(pair, turned[None])
    error = np.linalg.norm(voted[:, :3, 3] - T[:3, 3], axis=1)
    assert error[0] < 2 * SIZE
    assert (error[1:] > 2 * SIZE).all()  # others are elsewhere


def test_translations_of_rotation_that_was_voted_on_are_not_repeated():
    pair = hardly_alike(0)
    rotations = T[:3, :3] @ se3.so3_exp([[0.0, 0, 0], [0.1, 0, 0], [0.5, 0, 0]])
    voted = proposals._voted(pair, rotations)
    assert np.array_equal(voted[:3, :3, :3], rotations[[0, 0, 0]])
    assert np.array_equal(voted[3:, :3, :3], rotations[[2] * len(voted[3:])])


def test_peaks_are_densest_places_though_cells_divide_them():
    rng = np.random.default_rng(0)
    noise, place = rng.uniform(-3, 3, (4000, 3)), np.array([1.0, 1.0, -2.0])  # at a cell's corner
    votes = np.concatenate([[[-3.0, -3, -3]], noise, place + rng.normal(0, 0.05, (40, 3))])
    peaks = proposals._peaks(votes, 0.1)
    assert len(peaks) == 3
    assert np.linalg.norm(peaks[0] - place) < 0.05
    assert proposals._peaks(votes[:0], 0.1).shape == (0, 3)
    far = np.concatenate([votes, [[1e9, -1e9, 1e9]]])  # stray points cost no memory
    assert np.linalg.norm(proposals._peaks(far, 0.1)[0] - place) < 0.05


def test_poses_settle_where_surfaces_coincide():
    source, target = (CloudFrame.of(points) for points in clouds())
    pair = proposals.matched(source, target, signed=True, options=ConsensusOptions())
    rng = np.random.default_rng(1)
    xi = rng.normal(size=(12, 6)) * ([pair.size] * 3 + [0.05] * 3)
    centre = np.median(pair.source.points, 0)
    moved = settled = TRUE @ se3.about(centre, se3.exp(xi))
    for reach in proposals._REACHES:
        settled = proposals._settled(pair, settled, reach * pair.size)
    before, after = (
        np.array([pose_error(M, TRUE, pair.source.points)[0] for M in poses])
        for poses in (moved, settled)
    )
    assert np.median(after) < 0.25 * np.median(before)
    # A pose without anything in reach stays where it is.
    away = se3.translation([100.0, 0, 0])[None]
    assert np.allclose(proposals._settled(pair, away, pair.size), away)


def test_proposals_are_distinct_and_the_first_is_right():
    source, target = (CloudFrame.of(points) for points in clouds())
    found = proposals.proposals(source, target, signed=True)
    assert pose_error(found.motions[0], TRUE, source.points)[0] < 0.03
    angles = se3.angle(se3.inverse(found.motions[0]) @ found.motions[1:])
    shifts = [pose_error(M, found.motions[0], source.points)[0] for M in found.motions[1:]]
    assert ((angles > 0.1) | (np.array(shifts) > 0.1)).all()
