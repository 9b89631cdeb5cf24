"""Refinement of clouds by common planes: against the peaks, a slow reference and the bound."""

from __future__ import annotations

import numpy as np
import pytest

from tofuse.engine.compute.thread_pool import threads
from tofuse.engine.frames.frames import CloudFrame
from tofuse.engine.geometry import se3
from tofuse.engine.graph import build_graph, external_sensors
from tofuse.engine.refinement import plane_kernels
from tofuse.engine.refinement.common_planes import refine_clouds
from tofuse.engine.refinement.plane_refinement import Planes
from tofuse.engine.stored_views.view_store import Spacing, ViewStore
from tofuse.lab.experiments.peaks import PoseErrors, peaks_bound, run_peaks
from tofuse.lab.simulation.peaks import peaks_views


def nudged(poses, size, seed=0):
    """Poses after as many random motions of about `size` m, and as many tenths of rad."""
    steps = np.random.default_rng(seed).normal(size=(len(poses), 6)) * size
    steps[:, 3:] /= 10
    steps[0] = 0
    return poses @ se3.exp(steps)


@pytest.mark.nightly_part
def test_peaks_error_is_near_bound():
    """From the drift of the thesis's method; `benchmarks/peaks.py` has more noise levels."""
    sigma = 0.04
    views, truth = peaks_views(sigma, 1)
    thesis = run_peaks(sigma, 1)
    found = refine_clouds([v.points for v in views], thesis.poses_optimised)
    error = PoseErrors.of(found.poses, truth).position.mean()
    assert error < 1.5 * peaks_bound(sigma)
    assert error < thesis.optimised.position.mean() / 4
    assert found.after.mean() > found.before.mean()
    # It estimates the noise, and the uncertainty of its poses.
    assert found.sigma == pytest.approx(sigma, rel=0.1)
    alone = found.pairs[:, 0] == 0
    rms = np.sqrt(np.trace(found.covariance[alone][:, :3, :3], axis1=1, axis2=2)).mean()
    assert 0.7 < rms / peaks_bound(sigma) < 2


@pytest.mark.nightly
def test_result_is_independent_of_threads():
    views, truth = peaks_views(0.05, 0)
    clouds, start = [v.points[::2] for v in views[:5]], nudged(truth[:5], 0.05)
    found = []
    for count in (1, 2, 3):
        with threads(count):
            found.append(refine_clouds(clouds, start))
    for other in found[1:]:
        np.testing.assert_array_equal(other.poses, found[0].poses)
        np.testing.assert_array_equal(other.covariance, found[0].covariance)


def refined(part, views, poses):
    out = part.start(ViewStore(Spacing()))
    for view, T in zip(views, poses, strict=True):
        out.push(view, T)
    graph = build_graph([v.index for v in views], np.array(poses), [], [])
    return out.finish(graph, external_sensors.SensorPriors())


@pytest.mark.nightly
def test_refinement_is_kept_only_if_views_support_it():
    views, truth = peaks_views(0.05, 2)
    start = nudged(truth[:10], 0.1)
    better = refined(Planes(), views[:10], start)
    assert better.kept
    assert better.support[1] > better.support[0]
    before = PoseErrors.of(start, truth[:10]).position.mean()
    assert PoseErrors.of(better.poses, truth[:10]).position.mean() < before / 3
    assert {(e.i, e.j) for e in better.edges} == {(k, k + 1) for k in range(9)}
    for edge in better.edges:
        assert np.linalg.eigvalsh(edge.information).min() > 0
    assert not refined(Planes(), views[:1], truth[:1]).kept


@pytest.mark.parametrize("count", [2, 10, 20])
def test_distant_clouds_are_not_moved(count):
    views, _ = peaks_views(0.05, 2)
    apart = np.stack([se3.exp(np.array([100.0 * k, 0, 0, 0, 0, 0])) for k in range(count)])
    same = refined(Planes(), views[:count], apart)
    assert not same.kept
    assert same.pairs == 0
    np.testing.assert_array_equal(same.poses, apart)


@pytest.mark.nightly
def test_view_of_another_place_does_not_drag_others():
    views, truth = peaks_views(0.02, 0)
    noise = np.random.default_rng(5).uniform(-8, 8, (2500, 3)).astype(np.float32)
    views[7] = CloudFrame(7, 7.0, noise + np.float32([0, 0, 10]))
    found = refined(Planes(), views, nudged(truth, 0.05))
    others = np.delete(np.arange(20), 7)
    error = PoseErrors.of(found.poses[others], truth[others]).position
    assert error.mean() < 2 * peaks_bound(0.02)


@pytest.mark.nightly
def test_two_sides_of_wall_stay_separate():
    """Two rooms with a thin wall between them, each seen from inside; the rest is seen by both."""
    rng = np.random.default_rng(0)

    def seen(from_x, wall_x):
        wall = np.c_[np.full(1500, wall_x), rng.uniform(-2, 2, (1500, 2))]
        floor = np.c_[rng.uniform(-2.5, 2.5, (1500, 2)), np.full(1500, -2.0)]
        end = np.c_[rng.uniform(-2.5, 2.5, 1500), np.full(1500, 2.5), rng.uniform(-2, 2, 1500)]
        far = np.c_[np.full(300, 2.5), rng.uniform(1.5, 2.5, 300), rng.uniform(-2, 2, 300)]
        points = np.concatenate([wall, floor, end, far]) + rng.normal(0, 0.01, (4800, 3))
        return points - [from_x, 0, 0]

    truth = np.stack([se3.exp([x, 0, 0, 0, 0, 0]) for x in (0.0, 0.3, 2.5, 2.8)])
    truth[:, 0, 3] += -1.5
    views = [
        CloudFrame(k, float(k), seen(T[0, 3], -0.06 if T[0, 3] < 0 else 0.06).astype(np.float32))
        for k, T in enumerate(truth)
    ]
    found = refined(Planes(), views, truth)
    assert np.abs(found.poses[:, :3, 3] - truth[:, :3, 3]).max() < 0.01


def test_clouds_in_the_coordinates_of_a_site_take_part():
    """Far from their origin, and with the same pose: only their points are at other places."""
    views, truth = peaks_views(0.05, 2)
    site = np.array([1000.0, 2000.0, 100.0])
    placed = [
        CloudFrame.of(se3.transform(T, v.points[::5].astype(float)) + site, index=v.index)
        for v, T in zip(views[:4], truth, strict=False)
    ]
    assert refined(Planes(), placed, np.tile(np.eye(4), (4, 1, 1))).views == 4


def boxes_with_strays(count: int) -> tuple[list[np.ndarray], np.ndarray]:
    """Noisy points on the walls of a room, and stray ones in it, as seen from nudged poses."""
    rng = np.random.default_rng(0)
    half = np.array([3.0, 2.0, 1.5])
    poses = nudged(np.tile(np.eye(4), (count, 1, 1)), 0.2)
    clouds = []
    for T in poses:
        walls, strays = rng.uniform(-half, half, (600, 3)), rng.uniform(-half, half, (160, 3))
        wall = np.arange(600) % 3
        walls[np.arange(600), wall] = half[wall] * rng.choice([-1, 1], 600)
        walls += rng.normal(0, 0.004, walls.shape)
        clouds.append(se3.transform(se3.inverse(T), np.concatenate([walls, strays])))
    return clouds, nudged(poses, 0.02, seed=1)


def test_result_does_not_depend_on_the_origin():
    """Nor do cells of so few points that they have no plane."""
    clouds, start = boxes_with_strays(4)
    here = refine_clouds(clouds, start)
    assert here.size > 0
    moved = se3.translation([1.5, 1.0, 0.5])
    there = refine_clouds(clouds, moved @ start)
    np.testing.assert_allclose(se3.inverse(moved) @ there.poses, here.poses, atol=1e-6)
    np.testing.assert_allclose(there.after, here.after, atol=1e-6)


def test_points_without_a_plane_are_no_support():
    x, view = np.array([[1.0, 2.0, 3.0], [1.1, 2.0, 3.0], [1.2, 2.2, 3.0]]), np.array([0, 0, 1])
    start, views = np.array([0, 3]), np.empty(1, np.int64)
    mean, axes, variances = np.empty((1, 3)), np.empty((1, 3, 3)), np.empty((1, 3))
    plane_kernels.fit_cells(x, view, start, mean, axes, variances, views)
    np.testing.assert_allclose(mean[0], x.mean(0))
    support = np.zeros(2)
    plane_kernels.plane_support(x, view, start, mean, axes, views, 0.01, support)
    assert views[0] == 2
    assert not support.any()
