"""Joint calibration of a rig: poses, depth offsets, and their covariances.

The scene is made of planes that are rendered exactly, with noise: an open box that four cameras
look into from four sides.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.stats import chi2

from pose_errors import assert_near
from rig_scene import looked_at
from tofuse.apps.rigs.joint import RigView, disagreements, refine_together
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.geometry import se3
from tofuse.engine.stored_views.view_store import SampledView
from tofuse.engine.views.prepared_view import prepare_view
from tofuse.engine.views.view_planes import SurfaceOptions
from tofuse.lab.simulation.rig import camera_ring, relative


def distorted(frame: RangeFrame, by: np.ndarray) -> RangeFrame:
    """Scale the ranges of an image by a field that varies smoothly over it."""
    v, u = np.mgrid[: frame.depth.shape[0], : frame.depth.shape[1]]
    x, y = 2 * u / u.max() - 1, 2 * v / v.max() - 1
    field = np.tensordot(by, np.stack([np.ones_like(x), x, y, x * y]), 1)
    return replace(frame, depth=(frame.depth * (1 + field)).astype(np.float32))


def rig(
    seed: int, offset: float = 0.0, distortion: np.ndarray | None = None
) -> tuple[list[RigView], np.ndarray]:
    rng = np.random.default_rng([seed, 3])
    T = camera_ring((0, 0, 0.2), 1.3, 1.3, 4)
    views = []
    for k in range(4):
        frame = looked_at(T[k], rng, offset if k == 2 else 0.0)
        if distortion is not None:
            frame = distorted(frame, distortion[k])
        views.append(RigView(k, 0, SampledView.of(prepare_view(frame, SurfaceOptions()), 4000)))
    return views, np.stack(relative(T))


def disturbed(poses: np.ndarray, seed: int) -> np.ndarray:
    rng = np.random.default_rng([seed, 4])
    scale = np.array([0.01] * 3 + [np.radians(0.5)] * 3)
    away = rng.normal(size=(len(poses), 6)) * scale
    away[0] = 0
    return poses @ se3.exp(away)


@cache
def found(seed: int):
    views, truth = rig(seed)
    return refine_together(views, disturbed(truth, seed)), truth


def test_camera_poses_are_recovered() -> None:
    placed, truth = found(0)
    assert np.array_equal(placed.poses[0], np.eye(4))
    assert_near(placed.poses, truth, 0.004, 0.15)


def test_covariance_matches_size_of_errors() -> None:
    squares = []
    for seed in range(3):
        placed, truth = found(seed)
        for k in range(1, 4):
            e = se3.log(se3.inverse(placed.poses[k]) @ truth[k])
            squares.append(e @ np.linalg.solve(placed.random_covariance[k][:6, :6], e))
    # Chi-square with 6 degrees of freedom has the median 5.3.
    assert 1.5 < np.median(squares) < 12.0


@pytest.mark.nightly
def test_covariance_includes_systematic_range_errors() -> None:
    """Each camera's ranges are distorted smoothly, as by multipath: the poses absorb it."""
    rng = np.random.default_rng(8)
    by_random, by_all = [], []
    for seed in range(5):
        views, truth = rig(seed, distortion=0.0025 * rng.normal(size=(4, 4)))
        placed = refine_together(views, disturbed(truth, seed))
        for k in range(1, 4):
            e = se3.log(se3.inverse(placed.poses[k]) @ truth[k])
            for found, C in ((by_random, placed.random_covariance), (by_all, placed.covariance)):
                found.append(e @ np.linalg.solve(C[k][:6, :6], e))
    assert np.median(by_random) > 20
    assert np.mean(np.array(by_all) < chi2.ppf(0.95, 6)) > 0.85
    assert np.median(by_all) > 0.5


def test_depth_offset_of_one_camera_is_found() -> None:
    views, truth = rig(1, offset=0.008)
    placed = refine_together(views, disturbed(truth, 1))
    sigma = np.sqrt(placed.random_covariance[2][6, 6])
    assert abs(-placed.offsets[2] - 0.008) < max(3 * sigma, 0.002)
    assert sigma < 0.005
    # Systematic errors would change it by more.
    assert np.sqrt(placed.covariance[2][6, 6]) > 3 * sigma


def test_displaced_camera_increases_disagreement() -> None:
    views, truth = rig(2)
    right = disagreements(views, truth)
    wrong = truth.copy()
    wrong[3, :3, 3] += [0.0, 0.0, 0.02]
    moved = disagreements(views, wrong)
    assert right[0, 1][0] < 0.003
    assert moved[2, 3][0] > 2 * right[2, 3][0]
    assert moved[0, 1] == right[0, 1]


def test_cameras_without_overlap_are_not_calibrated() -> None:
    views, truth = rig(3)
    apart = [v for v in views if v.camera in (0, 1)]
    apart = [apart[0], RigView(1, 1, apart[1].sampled)]  # at another instant
    placed = refine_together(apart, truth[:2])
    assert np.allclose(placed.poses, truth[:2])
    assert not placed.disagreement
