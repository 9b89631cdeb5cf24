"""Refinement over all overlapping views, on views of a corner with exact poses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from aligned_surfaces import OPTIONS, away, drifted, path, surfaces
from corner_views import SHARP, corner
from tofuse.engine.geometry import se3
from tofuse.engine.graph import external_sensors
from tofuse.engine.graph.graph import build_graph
from tofuse.engine.graph.graph_covariances import GraphCovariances
from tofuse.engine.quality.pose_accuracy import ObservedErrors, accuracy_of
from tofuse.engine.refinement.joint_alignment import (
    MAX_LOSS,
    Bodies,
    refine,
    spread_evenly,
    support_fell,
    support_of,
)
from tofuse.engine.refinement.refinement import (
    Joint,
    NoRefinement,
    propagate_poses,
    with_unsupported_views_fixed,
    without_errors,
)
from tofuse.engine.stored_views import pair_equation_kernels as kernels
from tofuse.engine.stored_views.view_store import SampledView, Spacing, ViewStore, overlaps
from tofuse.engine.views.prepared_view import prepare_view


@pytest.fixture(scope="module")
def swing():
    truth = path(12)
    return [SampledView.of(s, 1500) for s in surfaces(truth, noise=0.005)], truth


def test_drift_is_removed_by_joint_refinement(swing):
    views, truth = swing
    start = drifted(truth)
    found = refine(views, start, OPTIONS)
    assert away(start, truth) > 0.04
    assert away(found.poses, truth) < 0.006
    assert np.array_equal(found.poses[0], start[0])
    assert found.moved[-1] < found.moved[0] / 20
    assert found.after.of_views(12).min() > found.before.of_views(12).max() - 0.05
    # The measurement of each pair is near the joint solution.
    i, j = found.pairs.T
    together = se3.inverse(found.poses[i]) @ found.poses[j]
    assert np.abs(se3.log(se3.inverse(found.measured) @ together)).max() < 0.02
    assert np.linalg.eigvalsh(found.information).min() > 0


def test_only_given_pairs_are_compared(swing):
    views, truth = swing
    start = drifted(truth)
    chain = np.stack([np.arange(11), np.arange(1, 12)], 1)
    found = refine(views, start, OPTIONS, pairs=chain)
    np.testing.assert_array_equal(found.pairs, chain)
    assert away(found.poses, truth) < 0.2 * away(start, truth)
    # A view without pairs stays.
    alone = refine(views, start, OPTIONS, pairs=chain[:-1])
    np.testing.assert_allclose(alone.poses[-1], start[-1], atol=1e-12)


@pytest.mark.nightly_part
def test_camera_errors_are_estimated_where_observable():
    truth = path(12)
    views = [SampledView.of(s, 1500) for s in surfaces(truth, offset=0.05)]
    start = drifted(truth)
    plain = refine(views, start, OPTIONS)
    found = refine(views, start, OPTIONS, calibrate=[kernels.OFFSET])
    assert found.errors[kernels.OFFSET] == pytest.approx(0.05, abs=0.01)
    assert away(found.poses, truth) < 0.5 * away(plain.poses, truth)
    # A correct camera is found to have no errors.
    good = [SampledView.of(s, 1500) for s in surfaces(truth)]
    none = refine(good, start, OPTIONS, calibrate=[kernels.OFFSET, kernels.FOCAL])
    assert np.abs(none.errors).max() < 0.01


def test_camera_errors_are_removed_from_points():
    T = np.eye(4)
    right, wrong = corner(T), corner(T, offset=0.05)
    found = without_errors(wrong.points.astype(np.float32), {"offset": 0.05})
    np.testing.assert_allclose(found, right.points, atol=1e-5)
    wide = right.points * np.array([1 / 1.02, 1 / 1.02, 1])
    np.testing.assert_allclose(
        without_errors(wide.astype(np.float32), {"focal": 0.02}), right.points, atol=1e-5
    )
    half = (right.points / 1.01).astype(np.float32)
    np.testing.assert_allclose(without_errors(half, {"scale": 0.01}), right.points, atol=1e-5)


def test_overlapping_views_show_the_same_side(swing):
    views, truth = swing
    pairs, shares = overlaps(views, truth, 0.3)
    assert (pairs[:, 0] < pairs[:, 1]).all()
    assert ((shares >= 0.3) & (shares <= 1)).all()
    assert {(0, 1), (0, 11)} <= set(map(tuple, pairs.tolist()))
    turned = truth.copy()
    turned[5] = turned[5] @ se3.exp(np.array([0, 0, 0, 0, np.pi, 0]))
    assert 5 not in overlaps(views, turned, 0.3)[0]


def test_partners_are_spread_evenly():
    pairs = np.array([(i, 9) for i in range(9)] + [(3, 4)])
    pairs = pairs[np.lexsort((pairs[:, 0], pairs[:, 1]))]
    kept = spread_evenly(pairs, 3)
    assert kept[kept[:, 1] == 9, 0].tolist() == [0, 4, 8]
    assert (3, 4) in map(tuple, kept.tolist())
    assert len(spread_evenly(pairs[:0], 3)) == 0


def test_frames_in_between_are_interpolated():
    before = path(9)
    at = np.array([0, 4, 8])
    step = se3.exp(np.array([0.1, 0, 0, 0, 0, 0]))
    after = before[at].copy()
    after[1:] = step @ after[1:]
    found = propagate_poses(before, at, after)
    np.testing.assert_allclose(found[at], after, atol=1e-12)
    np.testing.assert_allclose(found[6], step @ before[6], atol=1e-12)
    moved = found[:5, 0, 3] - before[:5, 0, 3]
    np.testing.assert_allclose(moved, [0, 0.025, 0.05, 0.075, 0.1], atol=1e-9)


def refiner(part, views, poses):
    store = ViewStore(Spacing())
    out = part.start(store)
    for view, T in zip(views, poses, strict=True):
        store.push(view, T)
        out.push(corner(T), T)
    graph = build_graph(range(len(poses)), np.array(poses), [], [])
    return out.finish(graph, external_sensors.SensorPriors())


def test_refinement_is_kept_only_if_views_support_it():
    truth = path(12)
    views = surfaces(truth, noise=0.005)
    start = drifted(truth)
    better = refiner(Joint(), views, start)
    assert better.kept
    assert better.support[1] > better.support[0]
    assert away(better.poses, truth) < 0.006
    assert better.moved_m > 0.03
    assert {(e.i, e.j) for e in better.edges} >= {(0, 1), (1, 2)}
    # Views without overlap stay where they are.
    apart = np.stack([se3.exp(np.array([100.0 * k, 0, 0, 0, 0, 0])) for k in range(12)])
    same = refiner(Joint(), views, apart)
    assert not same.kept
    assert not same.edges
    np.testing.assert_array_equal(same.poses, apart)
    np.testing.assert_array_equal(refiner(NoRefinement(), views, start).poses, start)


def test_support_that_falls_by_chance_in_all_views_alike_says_nothing():
    alike = np.linspace(-0.0012, -0.0004, 36)
    assert not support_fell(alike)
    assert support_fell(alike - 0.5 * MAX_LOSS)
    assert support_fell(np.where(np.arange(36) < 9, -0.2, 0.01))


def test_poses_that_followed_errors_of_the_camera_are_refined():
    """Consecutive views fit best where the path bends with an error fixed to the camera."""
    truth, (v, u) = path(12), np.indices(corner(np.eye(4)).depth.shape) / 8.0
    views = surfaces(truth, noise=0.003, bias=0.01 * np.sin(u + 0.5) * np.cos(v))
    chain = np.stack([np.arange(11), np.arange(1, 12)], 1)
    sampled = [SampledView.of(view, 1500) for view in views]
    bent = refine(sampled, truth, replace(OPTIONS, shared=0.0), pairs=chain).poses
    found = refiner(Joint(), views, bent)
    assert away(bent, truth) > 0.015
    assert found.kept
    assert away(found.poses, truth) < 0.5 * away(bent, truth)
    # The views support each other less than before, but for what such errors explain.
    refined = refine(sampled, bent, OPTIONS)
    without = support_of(sampled, refined.poses, replace(refined, shared=None), OPTIONS)
    assert support_fell(without.of_views(12) - refined.before.of_views(12))
    again = support_of(sampled, refined.poses, refined, OPTIONS)
    np.testing.assert_allclose(again.score, refined.after.score, rtol=1e-4)


def test_shared_pixel_error_counts_once_in_joint_refinement():
    """A single alignment would take it for motion; over many views it differs."""
    truth = path(4)
    shared = np.full(corner(truth[0]).depth.shape, 0.01, np.float32)
    frames = [replace(corner(T), index=k, shared_sigma_image=shared) for k, T in enumerate(truth)]
    views = [prepare_view(frame, SHARP) for frame in frames]
    whole = [view.with_pixel_variance() for view in views]
    np.testing.assert_array_equal(whole[0].plane_variance, views[0].pixel_variance)
    assert whole[0].with_pixel_variance() is whole[0]
    found = refiner(Joint(), views, truth)
    # A hundred pixels that share their error weigh more than one pixel.
    wary = refine([SampledView.of(view, 1500) for view in views], truth, OPTIONS)
    once = refine([SampledView.of(view, 1500) for view in whole], truth, OPTIONS)
    np.testing.assert_allclose(found.poses, once.poses, atol=1e-12)
    gained = np.linalg.det(once.information) / np.linalg.det(wary.information)
    assert gained.min() > 10


def test_view_that_loses_support_stays_with_neighbours():
    """One view is of another place: it must not be moved to fit what it cannot."""
    truth = path(12)
    views = surfaces(truth, noise=0.002)
    strange = surfaces(truth @ se3.exp(np.array([0, 0, -0.5, 0.3, 0, 0])))[6]
    views[6] = replace(strange, index=6)
    found = refiner(Joint(), views, drifted(truth))
    others = np.delete(np.arange(12), 6)
    assert away(found.poses[others], truth[others]) < 0.012


def test_first_view_stays_though_it_lost_support():
    """It is not at the origin where the first frame has no stored view."""
    before = se3.exp(np.arange(1, 4)[:, None] * np.array([0.3, 0.1, 0, 0, 0.2, 0]))
    after = before @ se3.exp(np.array([[0] * 6, [0.01] * 6, [0.02] * 6]))
    lost = np.array([True, False, False])
    out = with_unsupported_views_fixed(before, after, lost)
    np.testing.assert_allclose(out[0], before[0], atol=1e-12)
    np.testing.assert_allclose(
        se3.inverse(out[0]) @ out[1], se3.inverse(before[0]) @ before[1], atol=1e-12
    )
    motion = se3.inverse(after[1]) @ after[2]
    np.testing.assert_allclose(se3.inverse(out[1]) @ out[2], motion, atol=1e-12)


def test_pairs_of_a_view_do_not_accumulate_information():
    """However many pairs a view has, their joint information is that of a few."""
    truth = path(12)
    views = surfaces(truth, noise=0.005)
    known = {}
    for neighbours in (2, 10):
        found = refiner(Joint(neighbours=neighbours), views, drifted(truth))
        graph = build_graph(range(12), found.poses, found.edges)
        known[neighbours] = (
            len(found.edges),
            accuracy_of(GraphCovariances(graph), ObservedErrors(), 1.0).position_m,
        )
    assert known[10][0] > 2 * known[2][0]
    assert known[10][1] > 0.7 * known[2][1]


def test_rigidly_mounted_views_move_together():
    """Two cameras on a rig see the corner one after the other; each instant has one pose."""
    instants = path(8)
    mounted = se3.exp(np.array([[0.0] * 6, [0.05, 0.02, -0.03, 0.1, 0.25, -0.05]]))
    truth = (instants[:, None] @ mounted[None]).reshape(-1, 4, 4)
    views = [SampledView.of(s, 1500) for s in surfaces(truth, noise=0.005)]
    bodies = Bodies(np.repeat(np.arange(8), 2), np.tile(mounted, (8, 1, 1)))
    start = bodies.view_poses(drifted(instants))
    found = refine(views, start, OPTIONS, bodies=bodies)
    assert away(start, truth) > 0.03
    assert away(found.poses, truth) < 0.005
    # No pair is of one instant, and cameras keep their poses in the rig.
    assert (found.pairs[:, 0] // 2 != found.pairs[:, 1] // 2).all()
    assert {(i % 2, j % 2) for i, j in found.pairs.tolist()} == {(0, 0), (0, 1), (1, 0), (1, 1)}
    between = se3.inverse(found.poses[::2]) @ found.poses[1::2]
    np.testing.assert_allclose(between, np.tile(mounted[1], (8, 1, 1)), atol=1e-12)
    np.testing.assert_array_equal(found.poses[0], start[0])
    # Half as many unknowns: more accurate than independent views.
    free = refine(views, start, OPTIONS)
    error = [np.linalg.norm((p - truth)[:, :3, 3], axis=1) for p in (found.poses, free.poses)]
    assert np.sqrt((error[0] ** 2).mean()) < np.sqrt((error[1] ** 2).mean())
