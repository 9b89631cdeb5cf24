"""Coverage of the error bounds; unobservable poses are not bounded."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import tofuse
from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.geometry import se3
from tofuse.engine.graph.graph import Measured, PoseGraph, build_graph
from tofuse.engine.graph.graph_covariances import GraphCovariances
from tofuse.engine.graph.levenberg import LevenbergMarquardt
from tofuse.engine.quality import pose_accuracy as accuracy
from tofuse.engine.quality.pose_accuracy import (
    Accuracy,
    ObservedErrors,
    accuracy_of,
    contradicted_runs,
    covariances_of,
    degenerate_directions,
    scale_of_registrations,
    without_degenerate,
)
from tofuse.engine.quality.trajectory_errors import displacement
from tofuse.engine.stored_views.view_store import PosedView
from tofuse.engine.views.prepared_view import prepare_view
from tofuse.engine.views.view_planes import SurfaceOptions
from tofuse.lab.simulation.effects import Effects
from tofuse.lab.simulation.record import simulate_recording
from walks import round_walk, true_poses

N = 14
TRUE = true_poses(N)
X, TURN = np.eye(6)[:1], np.eye(6)[4:5]


def walk(rng: np.random.Generator | None = None, *, loops=((0, N - 1), (2, 9))) -> PoseGraph:
    return round_walk(N, rng, loops)


def bounded(graph, unobservable, unmeasured=()) -> PoseGraph:
    """The graph of frames that are degenerate in all their pairs."""
    directions = degenerate_directions(graph, unobservable, (), {})
    return without_degenerate(graph, directions, unmeasured)


@pytest.mark.nightly_part
@pytest.mark.parametrize("loops", [(), ((0, N - 1), (2, 9))])
def test_coverage_of_error_bounds(loops) -> None:
    """With noise whose size is known as well as from five errors."""
    rng = np.random.default_rng(11)
    solve = LevenbergMarquardt(robust="none").optimise
    found = np.array(
        [displacement(TRUE, solve(walk(rng, loops=loops)).graph.poses) for _ in range(300)]
    )
    found = found * np.sqrt(5 / rng.chisquare(5, (len(found), 1)))
    bound = accuracy_of(GraphCovariances(walk(loops=loops)), ObservedErrors(), 2.0)
    for column, limit in zip(found.T, (bound.position_m, bound.rotation_rad), strict=True):
        assert 0.91 < np.mean(column < limit) < 0.985
        assert limit < 3 * np.median(column)
    assert bound.assessed
    assert bound.relative == bound.position_m / 2
    assert bound.worst is not None
    assert bound.worst.position_m > bound.position_m
    assert bound.unbounded == ()


@pytest.mark.parametrize(
    ("degrees", "factor"), [(5, accuracy._MODEL_FACTOR), (15, accuracy.COVARIANCE_FACTOR)]
)
def test_covariances_cover_errors_as_normal_ones_would(degrees, factor) -> None:
    """A user takes quantiles of a normal distribution of them."""
    rng = np.random.default_rng(5)
    ratio = np.sqrt(degrees / rng.chisquare(degrees, 20_000))
    errors = ratio[:, None] * rng.standard_normal((len(ratio), 6))
    squares = (errors**2).sum(1) / factor
    assert 0.94 < np.mean(squares < 12.59) < 0.96


def bound_of(*errors: float, **named: Any) -> Accuracy:
    return accuracy_of(GraphCovariances(walk()), ObservedErrors(*errors, **named), 1.0)


def test_scaled_registrations_include_errors_of_the_camera():
    graph = GraphCovariances(walk())
    assert scale_of_registrations(graph, ObservedErrors()) == (1.0, 1.0)
    scale, by_rotation = scale_of_registrations(graph, ObservedErrors(calibration_m=0.2))
    assert scale == pytest.approx(np.sqrt(1 + 0.2**2 / noise_m() ** 2))
    assert by_rotation == 1.0


def test_scaled_covariance_leaves_other_causes():
    observed = ObservedErrors(0.03, 0.02, 0.04, 0.05, 0.06, (0.07, 0.08), 0.09)
    by_odometry = observed.of_other_sensors().mean_squares(np.array([1e-4, 1e-5]))
    np.testing.assert_array_equal(by_odometry["noise"], [1e-4, 1e-5])
    assert not by_odometry["calibration"].any()
    by_images = observed.mean_squares(np.zeros(2))
    for cause in ("refinement", "disagreement"):
        np.testing.assert_array_equal(by_odometry[cause], by_images[cause])


def test_errors_shown_by_recording_are_added_as_variances() -> None:
    plain = bound_of()
    assert plain.limited_by == "noise"
    camera = bound_of(calibration_m=0.2, calibration_rad=0.1)
    # The quantile of the sum is that of noise alone.
    assert camera.position_m**2 - plain.position_m**2 == pytest.approx(
        (plain.position_m * 0.2) ** 2 / noise_m() ** 2
    )
    assert camera.rotation_rad > plain.rotation_rad
    assert camera.limited_by == "calibration"
    # Of what may be an error or not, a third of the square counts.
    for cause, name in (("refinement", "moved_m"), ("disagreement", "excess_m")):
        one = bound_of(**{name: 0.2})
        assert one.position_m == pytest.approx(
            bound_of(calibration_m=0.2 / np.sqrt(3)).position_m, rel=1e-6
        )
        assert one.limited_by == cause
        assert one.rotation_rad == plain.rotation_rad
    assert bound_of(moved_rad=0.1).rotation_rad > plain.rotation_rad
    assert bound_of(range_m=0.2).position_m == pytest.approx(camera.position_m)
    assert bound_of(range_m=0.2).rotation_rad == plain.rotation_rad
    C = covariances_of(GraphCovariances(walk()), ObservedErrors(0.03, 0.02, 0.04))
    np.testing.assert_array_equal(C[0], 0)
    assert np.trace(C[5, :3, :3]) > 0.05**2 / 3


def test_poses_far_apart_share_less_of_an_error_of_the_range() -> None:
    """Of poses within the depth all distances are wrong by the same fraction."""
    depth, shared = 2.0, 0.005
    line = np.outer(np.linspace(0, 1, 40), [0.6, 0.0, 0.8])
    deviation = float(np.linalg.norm(line - line.mean(0), axis=1).mean())
    near = accuracy.error_by_range(0.01 * line, shared, depth)
    rms = float(np.sqrt(((line - line.mean(0)) ** 2).sum(1).mean()))
    assert near == pytest.approx(accuracy._COMMON * shared * 0.01 * rms, rel=0.01)
    assert near > accuracy._COMMON * shared * 0.01 * deviation
    # Over ten depths: sums of a random fraction that is correlated over the depth.
    rng, step = np.random.default_rng(3), 20.0 / 39
    apart = np.abs(np.subtract.outer(np.arange(39), np.arange(39))) * step
    root = np.linalg.cholesky(np.exp(-apart / depth))
    found = []
    for _ in range(2000):
        sums = np.append(0.0, np.cumsum(step * (root @ rng.standard_normal(39))))
        found.append(sums.var())
    far = accuracy.error_by_range(20 * line, shared, depth)
    expected = accuracy._COMMON * shared * float(np.sqrt(np.mean(found)))
    assert far == pytest.approx(expected, rel=0.05)
    assert far < 0.7 * accuracy._COMMON * shared * 20 * rms
    # A camera that comes back has no more of it, and one that only turns has none.
    back = np.concatenate([line, line[::-1]])
    assert accuracy.error_by_range(20 * back, shared, depth) == pytest.approx(far, rel=0.02)
    assert accuracy.error_by_range(0 * line, shared, depth) == 0
    assert accuracy.error_by_range(line, 0.0, depth) == 0


def noise_m() -> float:
    """Rms error by the covariance alone."""
    return float(np.sqrt(accuracy._CovarianceErrors.of_graph(GraphCovariances(walk())).squares[0]))


def test_halves_of_images_measure_errors_of_this_camera() -> None:
    plain, noise = bound_of(), noise_m()
    same, twice, four, less, none = (bound_of(split=(k * noise, 0.0)) for k in (1, 2, 4, 0.1, 0))
    assert same.position_m < 0.85 * plain.position_m  # known better
    assert twice.position_m == pytest.approx(2 * same.position_m)
    assert four.position_m == pytest.approx(4 * same.position_m)
    assert four.rotation_rad == same.rotation_rad < plain.rotation_rad
    # They may also miss errors: smaller ones count as half of the evidence.
    assert less.position_m == pytest.approx(same.position_m * np.sqrt(0.505))
    assert none.position_m == pytest.approx(same.position_m * np.sqrt(0.5))
    assert bound_of(split=None) == plain  # nothing was measured
    # Halves share the error of a correction that was estimated from both.
    assert bound_of(split=(noise, 0.0), corrected=True).position_m == pytest.approx(
        plain.position_m
    )
    C_plain, C_same, C_more, C_less = (
        covariances_of(GraphCovariances(walk()), ObservedErrors(split=split))[5]
        for split in (None, *((k * noise, 0.0) for k in (1, 3, 0.1)))
    )
    assert np.trace(C_same[:3, :3]) < np.trace(C_plain[:3, :3])
    np.testing.assert_allclose(C_more[:3, :3], 9 * C_same[:3, :3])
    np.testing.assert_array_equal(C_more[3:, 3:], C_same[3:, 3:])
    np.testing.assert_allclose(C_less, C_same)


@pytest.mark.parametrize("direction", [X, TURN])
def test_unmeasured_direction_is_unbounded(direction) -> None:
    """Whatever information noise has suggested; frames on both sides stay bounded."""
    graph = walk()
    slide = dict.fromkeys((4, 5, 6), direction)
    a = accuracy_of(GraphCovariances(bounded(graph, slide)), ObservedErrors(), 1.0)
    assert a.unbounded == (4, 5, 6)
    assert a.worst is not None
    assert a.worst.frame in (4, 5, 6)
    worst = a.worst.position_m if direction is X else a.worst.rotation_rad
    assert np.isinf(worst)
    assert np.isinf(a.position_m if direction is X else a.rotation_rad)
    # Edges of other frames are unchanged.
    others = [k for k, (i, j) in enumerate(graph.edges) if not {i, j} & {4, 5, 6}]
    np.testing.assert_array_equal(
        bounded(graph, slide).information[others], graph.information[others]
    )


@pytest.mark.parametrize(("degrees", "neighbours"), [(1, 4), (3, 12)])
def test_slightly_different_directions_do_not_bound_each_other(degrees, neighbours) -> None:
    """A slide along x, whose direction every pair of views knows to some degrees only."""
    rng = np.random.default_rng(3)
    pairs = [(i, j) for i in range(N) for j in range(i + 1, min(i + 1 + neighbours, N))]
    steps = [
        Measured(i, j, se3.inverse(TRUE[i]) @ TRUE[j], np.diag([1e7] * 3 + [1e8] * 3))
        for i, j in pairs
    ]
    graph = build_graph(list(range(N)), TRUE, steps)
    directions = []
    for i, j in pairs:
        slides = {i, j} & set(range(5, 10))
        x = TRUE[j, :3, :3].T @ [1.0, *np.radians(rng.normal(0, degrees, 2))]
        directions.append(np.array([[*x, 0, 0, 0]]) if slides else np.zeros((0, 6)))
    a = accuracy_of(GraphCovariances(without_degenerate(graph, directions)), ObservedErrors(), 1.0)
    assert set(range(5, 10)) <= set(a.unbounded)
    assert not set(range(5)) & set(a.unbounded)


def test_tracking_edge_is_degenerate_with_its_own_frame() -> None:
    """Degeneracy of its keyframe with an earlier one does not affect it."""
    graph = walk()
    own = {
        (i, j) for (i, j), loop in zip(graph.edges.tolist(), graph.loop, strict=True) if not loop
    }
    found = degenerate_directions(graph, {5: X}, own, {})
    assert [tuple(graph.edges[k]) for k, d in enumerate(found) if len(d)] == [(4, 5)]
    either = degenerate_directions(graph, {5: X}, (), {})
    assert [tuple(graph.edges[k]) for k, d in enumerate(either) if len(d)] == [(4, 5), (5, 6)]


@pytest.mark.parametrize(("view", "degenerate"), [("wall", True), ("corner", False)])
def test_degeneracy_depends_on_views_of_pair(view, degenerate) -> None:
    """A frame that is degenerate with its keyframe need not be so with other views."""
    surface = flat_wall() if view == "wall" else surface_of_corner()
    steps = [Measured(0, 1, np.eye(4), np.eye(6) * 1e6)]
    graph = build_graph([0, 1], np.tile(np.eye(4), (2, 1, 1)), steps)
    (found,) = degenerate_directions(
        graph, {1: X}, (), dict.fromkeys((0, 1), PosedView(surface, np.eye(4)))
    )
    assert (len(found) > 0) == degenerate


@pytest.mark.parametrize(("view", "degenerate"), [("wall", True), ("corner", False)])
def test_pairs_across_degenerate_frame_are_aligned_again(view, degenerate) -> None:
    """After a slide in frame 1, frames 0 and 2 overlap wherever the slide ended."""
    surface = flat_wall() if view == "wall" else surface_of_corner()
    steps = [Measured(0, 2, np.eye(4), np.eye(6) * 1e6), Measured(2, 3, np.eye(4), np.eye(6) * 1e6)]
    graph = build_graph(range(4), np.tile(np.eye(4), (4, 1, 1)), steps)
    views = dict.fromkeys(range(4), PosedView(surface, np.eye(4)))
    over, after = degenerate_directions(graph, {1: X}, (), views)
    assert (len(over) > 0) == degenerate
    assert not len(after)


@pytest.mark.parametrize(("corners", "constrained"), [(1, False), (5, True)])
def test_single_constrained_pair_of_degenerate_view_is_chance(corners, constrained) -> None:
    """One constrained pair of 20 would bound the pose; five of 20 are more than by chance."""
    steps = [Measured(k, 20, np.eye(4), np.eye(6) * 1e6) for k in range(20)]
    graph = build_graph(range(21), np.tile(np.eye(4), (21, 1, 1)), steps)
    wall, corner = (PosedView(surface, np.eye(4)) for surface in (flat_wall(), surface_of_corner()))
    views = dict.fromkeys(range(20), wall) | dict.fromkeys([*range(corners), 20], corner)
    found = degenerate_directions(graph, {20: X}, (), views)
    assert [len(d) == 0 for d in found] == [constrained and k < corners for k in range(20)]


def flat_wall():
    return prepare_view(as_frame(np.full((60, 80), 2.0, np.float32), 0), SurfaceOptions())


def surface_of_corner():
    x, y = np.moveaxis(CAMERA.rays(), -1, 0)
    planes = [(0.6, 0.0, 0.8), (-0.6, 0.0, 0.8), (0.0, -0.8, 0.6)]
    z = np.min([1.5 / (a * x + b * y + c) for a, b, c in planes], axis=0)
    return prepare_view(as_frame(z.astype(np.float32), 0), SurfaceOptions())


CAMERA = Pinhole(80, 60, 80.0, 80.0, 39.5, 29.5)


def as_frame(z, index) -> RangeFrame:
    noise = np.random.default_rng(index).normal(0, 0.001, z.shape)
    return RangeFrame(index, float(index), CAMERA, (z + noise).astype(np.float32), "z")


def test_other_directions_of_degenerate_frame_stay_bounded() -> None:
    C = covariances_of(GraphCovariances(bounded(walk(), {5: X})), ObservedErrors())[5]
    sigma = np.sqrt(np.linalg.eigvalsh(C[:3, :3]))
    assert sigma[1] < 0.05
    assert sigma[2] > 1


def test_degenerate_start_leaves_rest_bounded() -> None:
    """Relative to the first frame, all poses would be unbounded."""
    graph = bounded(walk(loops=((2, N - 1),)), {0: X, 1: X})
    assert accuracy_of(GraphCovariances(graph), ObservedErrors(), 1.0).unbounded == (0, 1)


def test_extrapolated_motion_bounds_nothing() -> None:
    graph = walk(loops=())
    a = accuracy_of(GraphCovariances(bounded(graph, {}, [(9, 8)])), ObservedErrors(), 1.0)
    assert set(a.unbounded) in ({*range(9)}, {*range(9, N)})
    assert np.isinf(a.position_m)


def test_disconnected_parts_are_unbounded() -> None:
    graph = walk(loops=())
    keep = np.arange(N - 1) != 8
    columns = {k: getattr(graph, k)[keep] for k in ("edges", "measurements", "information", "loop")}
    a = accuracy_of(GraphCovariances(replace(graph, **columns)), ObservedErrors(), 1.0)
    assert a.assessed
    assert np.isinf(a.position_m)
    assert len(a.unbounded) in (5, 9)


@pytest.mark.nightly_part
@pytest.mark.parametrize("scene", ["wall", pytest.param("corridor", marks=pytest.mark.nightly)])
def test_slide_along_bare_walls_is_unbounded(scene) -> None:
    """Whatever the error happens to be: it was not measured."""
    effects = Effects.none(shot_noise=True)
    recording = simulate_recording(scene, frames=8, every=2, texture=False, effects=effects)
    coarse = {"fusion": {"voxel_m": 0.1}}  # only the poses matter
    d = tofuse.reconstruct(recording, coarse).diagnostics
    degenerate = {f.index for f in d.frames if len(f.unobservable)}
    assert len(degenerate) >= 6
    assert set(d.accuracy.unbounded) >= degenerate
    assert np.isinf(d.accuracy.position_m)
    assert d.verdict == "degraded"
    assert "unobserved_motion" in [r.code for r in d.reasons]
    # With texture the albedo measures it.
    recorded = simulate_recording(scene, frames=8, every=2, effects=effects)
    textured = tofuse.reconstruct(recorded, coarse)
    a = textured.diagnostics.accuracy
    assert a.unbounded == ()
    assert recording.reference is not None
    assert displacement(recording.reference, textured.trajectory)[0] < a.position_m < 0.1


@pytest.mark.parametrize(("slid", "found"), [(0.0, set()), (0.1, {1})])
def test_measurements_across_a_slide_contradict_each_other(slid, found) -> None:
    """Some pairs of views are right, others slid with the frames in between."""
    rng = np.random.default_rng(4)
    sigma = np.repeat([0.01, 0.002], 3)
    n = 40
    true = true_poses(n)
    steps = []
    for i in range(n):
        for j in range(i + 1, min(i + 9, n)):
            error = rng.normal(0, sigma) + slid * np.eye(6)[0] * (i < 20 <= j < 22)
            T_i_j = se3.inverse(true[i]) @ true[j] @ se3.exp(error)
            steps.append(Measured(i, j, T_i_j, np.diag(sigma**-2.0)))
    graph = build_graph(list(range(n)), true, steps)
    assert contradicted_runs(graph, np.array([10, 20, 21]), np.array([0, 1, 1])) == found


def test_single_pose_is_not_assessed() -> None:
    one = build_graph([7], TRUE[:1], [])
    assert accuracy_of(GraphCovariances(one), ObservedErrors(), 1.0) == Accuracy()
