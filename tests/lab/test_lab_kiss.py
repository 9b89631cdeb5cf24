"""KISS-ICP: the adaptive threshold and the odometry."""

from __future__ import annotations

import numpy as np
import pytest

from registration_scenes import box_walls, rng
from tofuse.engine.frames.frames import CloudFrame
from tofuse.engine.geometry import se3
from tofuse.engine.icp.icp_kernels import transform_points
from tofuse.lab.methods.kiss import AdaptiveThreshold, Kiss


def room(n, seed):
    """A room of 2 by 2 by 4 m with a block in a corner."""
    walls = box_walls(n, seed, walls="xyz", depth=(-1.0, 3.0))
    block = rng(seed, 2).uniform([0.3, 0.2, 1.5], [0.9, 0.9, 2.4], (n // 4, 3))
    side = rng(seed, 3).integers(0, 3, len(block))
    low = np.array([0.3, 0.2, 1.5])
    for axis in range(3):
        block[side == axis, axis] = low[axis]
    return np.vstack([walls, block])


def frames(poses, noise=0.003):
    out = []
    for k, T in enumerate(poses):
        p = transform_points(se3.inverse(T), room(4000, k)) + rng(k, 8).normal(0, noise, (5000, 3))
        out.append(CloudFrame(k, float(k), p.astype(np.float32)))
    return out


def path(n):
    step = se3.exp([0.03, 0.01, 0.02, 0.01, 0.04, 0.0])
    out = [np.eye(4)]
    for _ in range(n - 1):
        out.append(out[-1] @ step)
    return np.array(out)


@pytest.mark.nightly
def test_path_is_tracked_with_default_parameters():
    poses = path(12)
    tracker = Kiss().start(0)
    steps = [tracker.push(f) for f in frames(poses)]
    assert [s.status for s in steps] == ["tracked"] * 12
    gap = se3.log(se3.inverse(poses) @ np.array([s.T_component_camera for s in steps]))
    assert np.linalg.norm(gap[:, :3], axis=1).max() < 0.02
    assert np.linalg.norm(gap[:, 3:], axis=1).max() < 0.02
    last = steps[-1].registration
    assert last is not None
    np.testing.assert_allclose(
        steps[-2].T_component_camera @ last.T_target_source, steps[-1].T_component_camera, atol=1e-9
    )
    assert np.linalg.eigvalsh(last.information).min() > 0


def test_threshold_follows_prediction_errors():
    """Eqs 3 to 5: rms of the sufficiently large deviations; the initial value before any."""
    threshold = AdaptiveThreshold(range_m=5.0, min_delta=0.01, initial_sigma=0.2)
    assert threshold.sigma == 0.2
    threshold.update(np.eye(4))
    assert threshold.sigma == 0.2  # too small to count
    theta, shift = 0.1, 0.05
    threshold.update(se3.exp([0, 0, 0, 0, theta, 0]) + np.pad([[shift]], ((0, 3), (3, 0))))
    delta = 2 * 5 * np.sin(theta / 2) + shift
    assert threshold.sigma == pytest.approx(delta)
    threshold.update(se3.exp([0.3, 0, 0, 0, 0, 0]))
    assert threshold.sigma == pytest.approx(np.sqrt((delta**2 + 0.3**2) / 2))


def test_correspondences_are_within_three_sigma():
    inner = np.stack(np.meshgrid([-1.0, 0, 1], [-1.0, 0, 1], [2.0, 3]), -1).reshape(-1, 3)
    points = np.vstack([inner, [0, 0, 5.0]])  # the last one is out of range
    sigma = 0.02 * np.percentile(np.linalg.norm(points, axis=1), 95)
    for factor, pairs in ((2.9, len(inner)), (3.1, len(inner) - 1)):
        moved = points.copy()
        moved[0, 2] -= factor * sigma
        tracker = Kiss().start(0)
        steps = [tracker.push(CloudFrame.of(p.astype(np.float32))) for p in (points, moved)]
        found = steps[1].registration
        assert found is not None
        assert found.correspondences == pairs
