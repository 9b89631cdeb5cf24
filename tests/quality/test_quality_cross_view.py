"""Images of the same side support poses, free-space violations contradict them, backs do not."""

from __future__ import annotations

import numpy as np
import pytest

from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.compute.thread_pool import threads
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.geometry import se3
from tofuse.engine.quality.cross_view_agreement import (
    CrossViewConsistency,
    PairConsistency,
    compare_views,
    prepare_for_comparison,
    restore_thinned,
)

CAMERA = Pinhole(80, 60, 90.0, 90.0, 39.5, 29.5)
CENTRE = np.array([0.0, 0.0, 1.5])


def ball(T: np.ndarray, index: int, radius: float = 0.4, noise: float = 0.001) -> RangeFrame:
    """A ball without background, seen by a camera at T (4, 4)."""
    v, u = np.mgrid[:60, :80]
    rays = np.stack([(u - 39.5) / 90, (v - 29.5) / 90, np.ones((60, 80))], -1)
    c = (se3.inverse(T) @ np.append(CENTRE, 1))[:3]
    a, b = (rays**2).sum(-1), rays @ c
    root = b * b - a * (c @ c - radius**2)
    z = np.where(root > 0, (b - np.sqrt(np.maximum(root, 0))) / a, 0)
    z += noise * np.random.default_rng([3, index]).standard_normal(z.shape) * (z > 0)
    return RangeFrame(index, 0.1 * index, CAMERA, z.astype(np.float32))


def orbit(count: int) -> np.ndarray:
    """(count, 4, 4) poses on a circle around the ball, facing it."""
    about, back = np.eye(4), np.eye(4)
    about[:3, 3], back[:3, 3] = CENTRE, -CENTRE
    turns = [se3.exp(np.array([0, 0, 0, 0, 2 * np.pi * k / count, 0])) for k in range(count)]
    return np.stack([about @ T @ back for T in turns])


@pytest.fixture(scope="module")
def turned():
    poses = orbit(12)
    return [ball(T, k) for k, T in enumerate(poses)], poses


def compared(frames: list[RangeFrame], poses: np.ndarray) -> CrossViewConsistency:
    return compare_views([prepare_for_comparison(frame) for frame in frames], poses)


def test_opposite_views_of_object_are_consistent(turned) -> None:
    frames, poses = turned
    found = compared(frames, poses)
    assert found.frames == tuple(range(12))
    assert found.support() > 0.99
    assert found.rms_m() < 0.004
    # Opposite views share no side of the surface.
    assert all(min(p.j - p.i, 12 - p.j + p.i) <= 3 for p in found.pairs)
    assert {(k, k + 1) for k in range(11)} <= {(p.i, p.j) for p in found.pairs}


def test_wrong_pose_lowers_support(turned) -> None:
    frames, poses = turned
    wrong = poses.copy()
    wrong[6] = poses[6] @ se3.exp(np.array([0.25, 0, 0, 0, 0, 0]))
    shares = compared(frames, wrong).support_of_views()
    assert np.argmin(shares) == 6
    assert shares[6] < 0.75
    assert (np.delete(shares, [4, 5, 6, 7, 8]) > 0.95).all()
    # With drift in all poses the ball falls apart.
    drift = np.stack(
        [T @ se3.exp(np.array([0, 0, 0.06 * k, 0, 0, 0])) for k, T in enumerate(poses)]
    )
    assert compared(frames, drift).support() < 0.8


def test_result_is_independent_of_threads_and_world_frame(turned) -> None:
    frames, poses = turned
    with threads(1):
        one = compared(frames, poses)
    with threads(3):
        assert compared(frames, poses) == one
    moved = compared(frames, se3.exp(np.array([1, 2, 3, 0.4, 0.5, 0.6])) @ poses)
    assert moved.support() == pytest.approx(one.support(), abs=1e-3)


def test_without_overlap_nothing_is_stated(turned) -> None:
    frames, poses = turned
    assert np.isnan(compared(frames[:1], poses[:1]).support())
    assert np.isnan(CrossViewConsistency((0, 1), (PairConsistency(0, 1, 0.0, 10.0, 0.0),)).rms_m())


def test_restore_thinned_undoes_subsampling_but_not_cropping(turned) -> None:
    (frame, *_), _ = turned
    rng = np.random.default_rng(5)
    left = np.zeros(frame.depth.shape, bool)
    left[:, :40] = True
    thin = frame.keep(left & (rng.random(left.shape) < 0.5))
    again = restore_thinned(frame, thin)
    assert again.valid[:, :39].sum() > 0.99 * frame.valid[:, :39].sum()
    assert not again.valid[:, 41:].any()
    np.testing.assert_array_equal(again.depth[again.valid], frame.depth[again.valid])
