"""Feature-based registration without a guess: sample consensus, and images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import tofuse
from pose_errors import pose_error
from ray_casting import rays_at, to_plane
from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.clouds.robust_motion import ConsensusOptions, Pairs, motions_of
from tofuse.engine.clouds.robust_motion import consensus as consensus_of
from tofuse.engine.errors import RegistrationError
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.geometry import se3
from tofuse.lab.methods.features import Features
from tofuse.lab.methods.sample_consensus import (
    SampleOptions,
    information_of,
    weakly_constrained_directions,
)

CAMERA = Pinhole(176, 132, 200.0, 200.0, 87.5, 65.5)
METHODS = ("samples", "compatible")


def poster(T_world_camera, *, seed=0, noise=0.004, plain=False):
    """A corner of two walls and a floor with round spots of any brightness, and noise."""
    o, d = rays_at(T_world_camera, CAMERA)
    d = d.reshape(-1, 3)
    depth, light = np.full(len(d), 9.0), np.ones(len(d))
    walls = [((0.5, 0, 0.866), 2.6), ((-0.6, 0, 0.8), 2.8), ((0, 0.9, 0.436), 1.9)]
    for k, (normal, distance) in enumerate(walls):
        n = np.array(normal)
        z = to_plane(o, d, n, distance)
        hit = z < depth
        p = o + z[hit, None] * d[hit]
        u = np.cross(n, [0.3, 0.9, 0.1])
        u /= np.linalg.norm(u)
        spots = np.random.default_rng([5, k])
        at, size = spots.uniform(-2.5, 2.5, (150, 2)), spots.uniform(0.04, 0.16, 150)
        level = spots.uniform(0.3, 2.0, 150)
        flat = np.column_stack([p @ u, p @ np.cross(n, u)])
        inside = np.linalg.norm(flat[:, None] - at, axis=2) < size
        depth[hit] = z[hit]
        light[hit] = np.where(inside.any(1), level[np.argmax(inside, 1)], 1.0)
    rng = np.random.default_rng([6, seed])
    length = np.linalg.norm(d, axis=1)
    depth = depth * (1 + noise * rng.standard_normal(len(depth)) / length)
    light = light * (1 + 0.02 * rng.standard_normal(len(depth)))
    r2 = (depth * length) ** 2
    amplitude = 4000 * (np.ones_like(light) if plain else light) / r2
    depth, amplitude = (x.reshape(132, 176).astype(np.float32) for x in (depth, amplitude))
    return RangeFrame(seed, float(seed), CAMERA, depth, "z", amplitude_image=amplitude)


FIRST = np.eye(4)
# 25 degrees and 0.45 m away.
SECOND = se3.exp(np.array([0.4, 0.1, 0.2, -0.05, -0.42, 0.08]))
TRUE = se3.inverse(FIRST) @ SECOND


@pytest.fixture(scope="module")
def images():
    """Source and target."""
    return poster(SECOND, seed=1), poster(FIRST, seed=2)


def made_pairs(right, wrong, *, seed=0, sigma=0.01, spread=1.0):
    """Pairs of which some are inliers; the others join random points."""
    rng = np.random.default_rng([8, seed])
    T = se3.exp(rng.normal(0, 0.8, 6))
    p = rng.uniform(-spread, spread, (right + wrong, 3)) + np.array([0, 0, 3])
    q = se3.transform(T, p)
    q[right:] = rng.permutation(rng.uniform(-spread, spread, (wrong, 3)) + q.mean(0))
    s = np.full(right + wrong, sigma) if np.isscalar(sigma) else sigma
    q += s[:, None] * rng.standard_normal(q.shape)
    return Pairs(p, q, s**2), T


def consensus(pairs, options, rng):
    return consensus_of(pairs, options, options.motions(rng))


# Consensus


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(("right", "wrong"), [(60, 0), (40, 60), (30, 120)])
def test_inliers_are_separated_from_outliers(method, right, wrong):
    for seed in range(3):
        pairs, T = made_pairs(right, wrong, seed=seed)
        missed = np.linalg.norm(se3.transform(T, pairs.source) - pairs.target, axis=1)
        most = np.count_nonzero(missed < 0.03)  # three standard deviations
        found = consensus(pairs, SampleOptions(method=method), np.random.default_rng(seed))
        shift, turn = pose_error(found[0].T_target_source, T)
        assert shift < 0.03
        assert turn < 0.6
        assert np.count_nonzero(found[0].inliers[:right]) >= 0.95 * most
        assert np.count_nonzero(found[0].inliers[right:]) <= 0.05 * wrong
        # No rival comes close.
        assert all(rival.count < 0.5 * right for rival in found[1:])


@pytest.mark.parametrize("seed", range(4))
def test_one_inlier_in_fifty_pairs_is_enough(seed):
    """So few that sets of compatible pairs must be small to have no outliers."""
    pairs, T = made_pairs(10, 500, seed=seed)
    shift, turn = pose_error(consensus_of(pairs, ConsensusOptions())[0].T_target_source, T)
    assert shift < 0.06
    assert turn < 2


def motion_of(pairs):
    """Least squares motion of all pairs, weighted by their inverse variances."""
    return motions_of(pairs.source[None], pairs.target[None], 1 / pairs.variance[None])[0]


@pytest.mark.parametrize("method", METHODS)
def test_pairs_are_weighted_by_their_noise(method):
    """Half of the points are much noisier: they are inliers too, but have little weight."""
    sigma = np.where(np.arange(80) % 2, 0.003, 0.05)
    errors = []
    for seed in range(5):
        pairs, T = made_pairs(80, 0, seed=seed, sigma=sigma)
        found = consensus(pairs, SampleOptions(method=method), np.random.default_rng(0))[0]
        assert found.inliers.mean() > 0.85
        assert found.inliers[sigma > 0.01].mean() > 0.8
        weighted = se3.transform(se3.inverse(T) @ found.T_target_source, pairs.source)
        same = Pairs(pairs.source, pairs.target, np.full(80, 1e-4))
        alike = se3.transform(se3.inverse(T) @ motion_of(same), pairs.source)
        errors.append([np.linalg.norm(x - pairs.source, axis=1).mean() for x in (weighted, alike)])
    mine, plain = np.mean(errors, axis=0)
    assert mine < 0.4 * plain


def test_least_squares_motion_is_minimum():
    """No small motion decreases the weighted sum."""
    pairs, _ = made_pairs(12, 0, sigma=np.linspace(0.01, 0.1, 12))
    T = motion_of(pairs)

    def cost(T):
        r = se3.transform(T, pairs.source) - pairs.target
        return float(((r**2).sum(1) / pairs.variance).sum())

    for axis in range(6):
        for step in (-1e-4, 1e-4):
            assert cost(T @ se3.exp(step * np.eye(6)[axis])) > cost(T)


def test_information_is_inverse_covariance():
    pairs, T = made_pairs(40, 0, sigma=np.linspace(0.002, 0.03, 40))
    rng = np.random.default_rng(4)
    exact = se3.transform(T, pairs.source)
    xi = []
    for _ in range(300):
        noisy = exact + np.sqrt(pairs.variance)[:, None] * rng.standard_normal(exact.shape)
        xi.append(se3.log(se3.inverse(T) @ motion_of(replace(pairs, target=noisy))))
    stated = np.linalg.inv(information_of(replace(pairs, target=exact), T))
    seen = np.cov(np.array(xi).T)
    whitened = np.linalg.inv(np.linalg.cholesky(stated))
    assert np.abs(np.linalg.eigvalsh(whitened @ seen @ whitened.T) - 1).max() < 0.4


def test_collinear_points_leave_rotation_about_line_unconstrained():
    along = np.linspace(-1, 1, 30)[:, None] * [1.0, 0, 0] + [0, 0, 2.0]
    pairs = Pairs(along, along, np.full(30, 1e-4))
    (loose,) = weakly_constrained_directions(information_of(pairs, np.eye(4)))
    # Rotation about the line through z = 2, which also translates the camera.
    expected = np.array([0, 2.0, 0, 1.0, 0, 0])
    assert abs(loose @ expected) / np.linalg.norm(expected) > 0.999


@pytest.mark.parametrize("method", METHODS)
def test_inconsistent_pairs_are_rejected(method):
    pairs, _ = made_pairs(0, 40)
    with pytest.raises(RegistrationError, match="of 40 pairs of points not even 10 agree"):
        consensus(pairs, SampleOptions(method=method, inliers=10), np.random.default_rng(0))


# Images


@pytest.mark.parametrize("detector", ["sift", "orb", "fast"])
def test_distant_images_are_registered_without_guess(images, detector):
    found = tofuse.register(*images, method=Features(detector))
    shift, turn = pose_error(found.T_target_source, TRUE)
    assert shift < (0.08 if detector == "orb" else 0.05)  # localizes to a pixel of a coarse image
    assert turn < 1.5
    assert found.margin > 0.2
    assert found.correspondences >= 10
    assert np.linalg.eigvalsh(found.information).min() > 0


def test_colour_images_are_registered(images):
    colored = []
    for k, frame in enumerate(images):
        r2 = frame.radial_range**2
        level = np.clip(frame.amplitude_image * r2 / 4000 * 110, 0, 255).astype(np.uint8)
        image = np.dstack([level] * 3)
        colored.append(replace(frame, amplitude_image=None, color_image=image, index=k))
    found = tofuse.register(*colored, method=Features(channel="color"))
    assert pose_error(found.T_target_source, TRUE)[0] < 0.05
    np.testing.assert_array_equal(
        found.T_target_source, tofuse.register(*colored, method=Features()).T_target_source
    )
    with pytest.raises(RegistrationError, match="has no amplitude"):
        tofuse.register(*colored, method=Features(channel="albedo"))


def test_contradicted_pose_is_rejected(images):
    """The amplitude matches the other view, but the surfaces do not."""
    source, target = images
    mirrored = replace(target, depth=target.depth[:, ::-1].copy())
    with pytest.raises(RegistrationError, match="agree"):
        tofuse.register(source, mirrored, method=Features())
