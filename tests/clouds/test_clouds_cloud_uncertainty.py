"""The covariance of a pose between two clouds."""

from __future__ import annotations

import numpy as np
import pytest

from registration_scenes import bumpy_ball, view
from tofuse.engine.clouds.cloud_agreement import CloudMap
from tofuse.engine.clouds.cloud_uncertainty import cloud_information, cloud_unobservable
from tofuse.engine.frames.frames import CloudFrame
from tofuse.engine.geometry import se3
from tofuse.engine.icp.coarse_to_fine import CoarseToFine

SIZE = 0.05
# 99.9 % of a chi square of six dimensions.
HARDLY_EVER = 22.5


def maps(*clouds):
    return tuple(CloudMap.of(cloud, SIZE, cloud) for cloud in clouds)


def sigma(information):
    """Largest standard deviation of the position and of the angle."""
    C = np.linalg.inv(information)
    return [np.sqrt(np.linalg.eigvalsh(C[k, k])[-1]) for k in (slice(0, 3), slice(3, 6))]


def aligned(seed, bend=0.0, points=4000, noise=0.004):
    """A ball with bumps seen twice, once bent: the maps, and the pose found by ICP."""
    first, second = (bumpy_ball(points, seed + k, noise) for k in (0, 1000))
    first[:, 0] += bend * np.sin(6 * first[:, 1] + seed)
    first[:, 2] += bend * np.sin(5 * first[:, 0] + seed)
    clouds = view(first), view(second)
    start = np.eye(4)
    return maps(*clouds), CoarseToFine().at(SIZE, *clouds, start, start).T_target_source


def nees(seed, bend):
    (source, target), T = aligned(seed, bend)
    xi = se3.log(se3.inverse(T))  # the truth is the identity
    return xi @ cloud_information(source, target, T, np.zeros((0, 6))) @ xi


@pytest.mark.nightly
@pytest.mark.parametrize("bend", [0.0, 0.01])
def test_errors_are_as_large_as_stated(bend):
    found = np.array([nees(seed, bend) for seed in range(4)])
    assert (found < HARDLY_EVER).all()
    assert np.median(found) > 0.1  # nor far smaller


def test_correlated_errors_limit_information():
    few, many = (
        cloud_information(*aligned(0, 0.01, points)[0], np.eye(4), np.zeros((0, 6)))
        for points in (2000, 8000)
    )
    for a, b in zip(sigma(few), sigma(many), strict=True):
        assert b > 0.6 * a  # half of it, if they were independent


def test_wall_constrains_three_directions():
    rng = np.random.default_rng(0)
    walls = [
        CloudFrame.of(np.c_[rng.uniform(-1, 1, (4000, 2)), 2 + rng.normal(0, 0.004, 4000)], index=k)
        for k in range(2)
    ]
    source, target = maps(*walls)
    free = cloud_unobservable(source, target, np.eye(4))
    assert len(free) == 3
    information = cloud_information(source, target, np.eye(4), free)
    for direction in free:
        assert direction @ information @ direction < 1 / 10**2
    towards = np.array([0, 0, 1.0, 0, 0, 0])
    assert towards @ information @ towards > 1 / 0.01**2


def test_motions_that_patches_leave_open_have_no_information():
    rng = np.random.default_rng(0)
    walls = [
        CloudFrame.of(np.c_[rng.uniform(-1, 1, (4000, 2)), np.full(4000, 2.0)], index=k)
        for k in range(2)
    ]
    # Those along an exact plane, though none is excluded.
    information = cloud_information(*maps(*walls), np.eye(4), np.zeros((0, 6)))
    assert np.isfinite(information).all()
    assert information[0, 0] < 1e-2 * information[2, 2]


def test_clouds_that_constrain_no_motion_have_no_information():
    cloud = view(bumpy_ball(2000, 0))
    information = cloud_information(*maps(cloud, cloud), np.eye(4), np.eye(6))
    assert np.diag(information).max() < 1e-2


def test_clouds_without_overlap_have_no_information():
    cloud = view(bumpy_ball(2000, 0))
    source, target = maps(cloud, CloudFrame.of(cloud.points + np.array([30.0, 0, 0])))
    assert len(cloud_unobservable(source, target, np.eye(4))) == 6
    free = np.zeros((0, 6))
    assert np.diag(cloud_information(source, target, np.eye(4), free)).max() < 1e-2


def test_uncertainty_includes_residual_misalignment():
    (source, target), T = aligned(1)
    off = T @ se3.exp([0.01, 0, 0, 0, 0, 0])
    free = np.zeros((0, 6))
    near, far = (cloud_information(source, target, pose, free) for pose in (T, off))
    x = np.array([1.0, 0, 0, 0, 0, 0])
    assert 0.003**2 < x @ np.linalg.inv(far) @ x < 0.03**2
    assert x @ np.linalg.inv(near) @ x < x @ np.linalg.inv(far) @ x
