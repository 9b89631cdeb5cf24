"""Depth errors that are fixed to the camera, estimated from views of a corner."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from aligned_surfaces import OPTIONS, away, path
from corner_views import CAMERA, SHARP, corner
from refined_submaps import refined
from tofuse.engine.geometry import se3
from tofuse.engine.refinement import fixed_pattern
from tofuse.engine.refinement.joint_alignment import refine
from tofuse.engine.refinement.refinement import Joint
from tofuse.engine.stored_views.view_store import SampledView
from tofuse.engine.views.prepared_view import prepare_view

V, U = np.indices((CAMERA.height, CAMERA.width)) + 0.5
ACROSS, DOWN = np.pi * U / CAMERA.width, np.pi * V / CAMERA.height
PATTERN = 0.004 * np.cos(2 * ACROSS) * np.cos(DOWN) - 0.003 * np.cos(3 * ACROSS)
"""Errors of the depth, m."""
NOISE = 0.002
"""Noise of the depth, m."""
X, Y = (U - 0.5 - CAMERA.cx) / CAMERA.fx, (V - 0.5 - CAMERA.cy) / CAMERA.fy
LENGTHS = np.sqrt(1 + X**2 + Y**2).astype(np.float32)
"""Of the rays at depth 1."""


def views(poses, errors, noise: float = NOISE) -> list[SampledView]:
    """Views of the corner with depth errors, one image for all or one for each."""
    rng = np.random.default_rng(3)
    errors = np.broadcast_to(errors, (len(poses), *PATTERN.shape))
    found = []
    for k, T in enumerate(poses):
        frame = corner(T)
        depth = frame.depth + errors[k] + noise * rng.standard_normal(PATTERN.shape)
        frame = replace(frame, index=k, depth=depth.astype(np.float32))
        found.append(SampledView.of(prepare_view(frame, SHARP), 1500))
    return found


def depth_of_planes(view: SampledView) -> np.ndarray:
    """Where the plane of each pixel meets its ray, NaN without one."""
    along = (view.target[..., :2] * view.projection.rays).sum(-1) + view.target[..., 2]
    distance = view.target[..., 3]
    return np.where(distance != 0, distance / np.where(distance != 0, along, 1), np.nan)


def test_pattern_is_found_from_poses_that_followed_it():
    truth = path(24)
    seen = views(truth, PATTERN)
    chain = np.stack([np.arange(23), np.arange(1, 24)], 1)
    bent = refine(seen, truth, replace(OPTIONS, shared=0.0), pairs=chain).poses
    found = fixed_pattern.estimate(seen, bent, OPTIONS)
    assert np.corrcoef(found.z.ravel(), -PATTERN.ravel())[0, 1] > 0.9
    assert 0.7 < np.sum(found.z * -PATTERN) / np.sum(PATTERN**2) < 1.2
    as_they_are = refine(seen, bent, OPTIONS).poses
    without = refine([found.corrected(view) for view in seen], bent, OPTIONS).poses
    assert away(without, truth) < 0.5 * away(as_they_are, truth)


@pytest.mark.parametrize("submap", [300, 10])
def test_wrong_calibration_is_corrected_before_a_pattern(monkeypatch, submap):
    """Pair by pair a pattern may explain it better; the drift over many views tells."""
    some = fixed_pattern.FixedPattern(np.full(PATTERN.shape, 1e-4, np.float32))
    monkeypatch.setattr(fixed_pattern, "estimate", lambda *_: some)
    truth = path(12)

    def found(focal: float) -> fixed_pattern.FixedPattern:
        camera = replace(CAMERA, fx=focal * CAMERA.fx, fy=focal * CAMERA.fy)
        frames = [replace(corner(T), index=k, camera=camera) for k, T in enumerate(truth)]
        seen = [prepare_view(frame, SHARP) for frame in frames]
        return refined(Joint(submap=submap), seen, truth).pattern

    assert found(1.0) is some
    assert found(1.05).z is None


def test_large_errors_are_not_taken_for_outliers():
    """Where the surfaces of most pixels move little, errors of the rest exceed the scatter."""
    truth = path(24)
    large = 4 * np.where(np.cos(ACROSS) > 0.5, PATTERN, 0.2 * PATTERN)
    found = fixed_pattern.estimate(views(truth, large), truth, OPTIONS)
    assert np.sum(found.z * -large) / np.sum(large**2) > 0.6


def test_errors_of_triangulation_grow_with_the_squared_depth():
    truth, depth = path(24), 3.0

    def found(size):
        errors = [size * PATTERN * (corner(T).depth / depth) ** 2 for T in truth]
        return fixed_pattern.estimate(views(truth, errors, 3 * NOISE), truth, OPTIONS)

    small = found(0.4)
    assert small.power == 2
    at_depth = small.at(np.full(PATTERN.shape, depth, np.float32), small.z, LENGTHS)
    assert np.corrcoef(at_depth.ravel(), -PATTERN.ravel())[0, 1] > 0.8
    assert found(2.0).z is None  # far above the noise


def test_periodic_error_of_the_range_is_found_from_poses_that_followed_it():
    """As of a time-of-flight camera: that of the image alone explains nothing of it."""
    truth = path(24)
    ranges = [corner(T).depth * LENGTHS for T in truth]
    seen = views(truth, [0.003 * np.sin(2 * np.pi * r / 1.2) / LENGTHS for r in ranges])
    chain = np.stack([np.arange(23), np.arange(1, 24)], 1)
    bent = refine(seen, truth, replace(OPTIONS, shared=0.0), pairs=chain).poses
    found = fixed_pattern.estimate(seen, bent, OPTIONS)
    assert found.power == 0
    assert found.z.std() < 0.0003
    at = (np.arange(len(found.profile)) + 0.5) / len(found.profile) * found.reach
    within = at > np.quantile(ranges, 0.05)
    # But for a constant and a scale, which no view shows.
    line = np.column_stack([np.ones(len(at)), at])[within]
    wave = -0.003 * np.sin(2 * np.pi * at[within] / 1.2)
    left = found.profile[within] - wave
    left -= line @ np.linalg.lstsq(line, left, rcond=None)[0]
    assert left.std() < 0.3 * wave.std()
    as_they_are = refine(seen, bent, OPTIONS).poses
    without = refine([found.corrected(view) for view in seen], bent, OPTIONS).poses
    assert away(without, truth) < 0.5 * away(as_they_are, truth)


def test_errors_along_the_range_beyond_those_of_cameras_are_left():
    truth = path(24)
    ranges = [corner(T).depth * LENGTHS for T in truth]
    seen = views(truth, [0.015 * np.sin(2 * np.pi * r / 1.2) / LENGTHS for r in ranges])
    assert not fixed_pattern.estimate(seen, truth, OPTIONS).profile.any()


def test_runs_of_many_views_suffice():
    positions = fixed_pattern.runs(1000)
    assert len(positions) == 8 * 16
    assert (positions[0], positions[-1]) == (0, 999)
    assert list(fixed_pattern.runs(5)) == [0, 1, 2, 3, 4]
    truth = path(48)
    kept = np.concatenate([np.arange(12), np.arange(36, 48)])
    seen = [view for k, view in enumerate(views(truth, PATTERN)) if k in kept]
    found = fixed_pattern.estimate(seen, truth[kept], OPTIONS, kept)
    assert np.corrcoef(found.z.ravel(), -PATTERN.ravel())[0, 1] > 0.9


def test_nothing_is_found_where_errors_differ_from_view_to_view():
    truth = path(24)
    nothing = fixed_pattern.estimate(views(truth, 0.0), truth, OPTIONS)
    assert nothing.z is None or nothing.z.std() < 0.05 * NOISE
    phases = np.random.default_rng(7).uniform(0, 2 * np.pi, (24, 2, 1, 1))
    turning = 0.005 * np.cos(ACROSS + phases[:, 0]) * np.cos(DOWN + phases[:, 1])
    found = fixed_pattern.estimate(views(truth, turning), truth, OPTIONS)
    assert found.z is None or found.z.std() < 0.2 * turning.std()


OF_RANGE = 0.004 * np.sin(np.pi * corner(np.eye(4)).depth * LENGTHS)
PROFILE = -0.004 * np.sin(4 * np.pi * (np.arange(2000) + 0.5) / 2000)


@pytest.mark.parametrize(
    ("errors", "pattern"),
    [
        (PATTERN, fixed_pattern.FixedPattern((-PATTERN).astype(np.float32))),
        (
            OF_RANGE / LENGTHS,
            fixed_pattern.FixedPattern(np.zeros_like(LENGTHS), PROFILE.astype(np.float32), 4.0),
        ),
    ],
    ids=["image", "range"],
)
def test_corrected_view_is_that_of_a_camera_without_errors(errors, pattern):
    (wrong,), (right,) = (views(np.eye(4)[None], e, noise=0.0) for e in (errors, 0.0))
    corrected = pattern.corrected(wrong)
    np.testing.assert_allclose(corrected.points[:, :3], right.points[:, :3], atol=2e-4)
    depth_right, *depths = (depth_of_planes(view) for view in (right, wrong, corrected))
    before, after = (np.nanmedian(np.abs(depth - depth_right)) for depth in depths)
    assert after < 0.1 * before
    assert fixed_pattern.FixedPattern(None).corrected(wrong) is wrong


def test_few_views_and_views_apart_say_nothing():
    apart = se3.exp(np.outer(np.arange(8), [100.0, 0, 0, 0, 0, 0]))
    assert fixed_pattern.estimate(views(path(8), PATTERN), apart, OPTIONS).z is None
    truth = path(24)[:7]
    assert fixed_pattern.estimate(views(truth, PATTERN), truth, OPTIONS).z is None
    assert fixed_pattern.estimate([], truth[:0], OPTIONS).z is None
