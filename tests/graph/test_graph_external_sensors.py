"""Gravity and odometry priors: their weights, and robustness to wrong ones."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from corner_views import SHARP, corner
from tofuse.engine.geometry import se3
from tofuse.engine.graph import external_sensors
from tofuse.engine.graph.external_sensors import (
    GravityEdges,
    OdometryEdges,
    SensorData,
    SensorPriors,
    measure_all,
    with_depth_scale,
    with_sensors,
)
from tofuse.engine.graph.graph import Measured, PoseGraph, build_graph
from tofuse.engine.graph.graph_covariances import GraphCovariances
from tofuse.engine.graph.levenberg import LevenbergMarquardt
from tofuse.engine.refinement.joint_alignment import Priors, refine
from tofuse.engine.stored_views import pair_equation_kernels as kernels
from tofuse.engine.stored_views.pair_equations import RefineOptions
from tofuse.engine.stored_views.view_store import SampledView
from tofuse.engine.views.prepared_view import prepare_view

N = 60
SIGMA = np.array([0.004] * 3 + [0.004] * 3)
STATED = 3 * SIGMA
DOWN = np.array([0.1, 0.97, -0.2]) / np.linalg.norm([0.1, 0.97, -0.2])


def truth() -> np.ndarray:
    """A rotation with some pitching."""
    a = np.linspace(0, 2 * np.pi, N)
    turn = se3.so3_exp(np.stack([0.1 * np.sin(3 * a), a, 0.1 * np.cos(2 * a) - 0.1], 1))
    out = np.tile(np.eye(4), (N, 1, 1))
    out[:, :3, :3] = turn[0].T @ turn
    out[:, :3, 3] = np.stack([np.sin(a), 0 * a, 1 - np.cos(a)], 1)
    return out


def tracked(
    poses: np.ndarray, bias: np.ndarray, seed: int = 0, stated: np.ndarray = SIGMA
) -> PoseGraph:
    """A chain whose steps have noise and a bias, and state their errors."""
    rng = np.random.default_rng([7, seed])
    chain, steps = [poses[0]], []
    for k, (a, b) in enumerate(itertools.pairwise(poses)):
        T = se3.inverse(a) @ b @ se3.exp(bias + SIGMA * rng.standard_normal(6))
        steps.append(Measured(k, k + 1, T, np.diag(stated**-2)))
        chain.append(chain[-1] @ T)
    return build_graph(range(N), np.stack(chain), steps)


def sensed(
    odometry: np.ndarray | None = None,
    gravity: np.ndarray | None = None,
    degenerate: np.ndarray | None = None,
) -> SensorData:
    return SensorData(
        np.arange(N),
        np.arange(N, dtype=float),
        np.full((N, 4, 4), np.nan) if odometry is None else odometry,
        np.full((N, 4), np.nan) if gravity is None else gravity,
        np.zeros(N, np.intp),
        np.zeros(N, bool) if degenerate is None else degenerate,
    )


def seen_down(poses: np.ndarray, sigma: float = 0.02, seed: int = 1) -> np.ndarray:
    rng = np.random.default_rng(seed)
    d = np.einsum("kji,j->ki", poses[:, :3, :3], DOWN) + sigma * rng.standard_normal((N, 3))
    return np.concatenate([d / np.linalg.norm(d, axis=1)[:, None], np.full((N, 1), sigma)], 1)


def tilt(poses: np.ndarray, right: np.ndarray) -> float:
    """Rms angle between the estimated vertical and the true one, rad."""
    d = np.einsum("kij,klj,l->ki", poses[:, :3, :3], right[:, :3, :3], DOWN)
    return float(np.sqrt(((d - DOWN) ** 2).sum(1).mean()))


def ate(poses: np.ndarray, right: np.ndarray) -> float:
    return float(np.sqrt(((poses - right)[:, :3, 3] ** 2).sum(1).mean()))


NODDING = np.array([0, 0, 0, 0.004, 0, 0])


def walked(error: np.ndarray, **stated: Any) -> tuple[np.ndarray, PoseGraph]:
    """The true poses of a walk, and its graph with this error of each step."""
    right = truth()
    return right, tracked(right, error, **stated)


def solved(graph: PoseGraph, measured: SensorPriors) -> np.ndarray:
    return LevenbergMarquardt().optimise(with_sensors(graph, measured)).graph.poses


def test_gravity_removes_roll_and_pitch_drift():
    right, graph = walked(NODDING, stated=STATED)
    measured = measure_all((GravityEdges(),), sensed(gravity=seen_down(right)), graph)
    corrected = solved(graph, measured)
    assert tilt(graph.poses, right) > np.radians(2.5)
    assert tilt(corrected, right) < 0.4 * tilt(graph.poses, right)
    np.testing.assert_array_equal(corrected[0], graph.poses[0])
    assert measured.records[0].used == N
    assert np.degrees(np.arccos(measured.up(graph.with_poses(corrected)) @ -DOWN)) < 1.0
    assert SensorPriors().up(graph) is None
    # Gravity does not constrain heading or position.
    C, free = (
        GraphCovariances(with_sensors(graph, measured)).of_poses,
        GraphCovariances(graph).of_poses,
    )
    assert C[-1, 3, 3] + C[-1, 5, 5] < 0.6 * (free[-1, 3, 3] + free[-1, 5, 5])
    assert C[-1, 4, 4] > 0.5 * free[-1, 4, 4]


def test_accelerated_motion_is_not_taken_for_gravity():
    """For a third of the time the camera is accelerated sideways by a third of g."""
    right, graph = walked(NODDING, stated=STATED)
    lying = seen_down(right)
    lying[20:40, :3] += 0.33 * right[20:40, 0, :3]
    lying[:, :3] /= np.linalg.norm(lying[:, :3], axis=1)[:, None]
    accepted = replace(GravityEdges(), gate=1e9)
    robust = tilt(
        solved(graph, measure_all((GravityEdges(),), sensed(gravity=lying), graph)), right
    )
    plain = tilt(solved(graph, measure_all((accepted,), sensed(gravity=lying), graph)), right)
    assert robust < 0.5 * tilt(graph.poses, right)
    assert robust < 0.7 * plain
    record = measure_all((GravityEdges(),), sensed(gravity=lying), graph).records[0]
    assert 35 <= record.used <= 45


def test_systematic_error_limits_accuracy_of_vertical():
    right, graph = walked(0 * NODDING)
    measured = measure_all(
        (GravityEdges(shared_rad=0.01),), sensed(gravity=seen_down(right)), graph
    )
    assert measured.gravity is not None
    together = (measured.gravity[:, 3] ** -2.0).sum() ** -0.5
    assert 0.0095 < together < 0.0115
    few = sensed(gravity=np.where(np.arange(N)[:, None] < 2, seen_down(right), np.nan))
    none = measure_all((GravityEdges(),), few, graph)
    assert not none
    assert "only 2 frames" in none.records[0].text


def odometer(right: np.ndarray, share: float = 0.01) -> np.ndarray:
    """Poses in another frame, with relative errors of the steps."""
    rng = np.random.default_rng(5)
    out = [se3.exp(np.array([1.0, 2, 3, 0.5, -1, 0.2]))]
    for a, b in itertools.pairwise(right):
        step = se3.inverse(a) @ b
        noise = share * np.repeat([np.linalg.norm(step[:3, 3]), se3.angle(step)], 3)
        out.append(out[-1] @ step @ se3.exp(noise * rng.standard_normal(6)))
    return np.stack(out)


def test_good_odometry_helps_and_wrong_odometry_is_rejected():
    right, graph = walked(0 * NODDING)
    before = ate(graph.poses, right)
    good = measure_all(
        (OdometryEdges(drift_m=0.001, drift_rad=0.001, relative=0.003),),
        sensed(odometer(right)),
        graph,
    )
    assert len(good.steps) == N - 1
    assert ate(solved(graph, good), right) < 0.6 * before
    # Of another camera: other axes, and a scale of 1.5.
    other = odometer(right) @ se3.exp(np.array([0, 0, 0, 0, 1.2, 0]))
    other[:, :3, 3] *= 1.5
    wrong = measure_all((OdometryEdges(),), sensed(other), graph)
    assert not wrong
    assert "not used" in wrong.records[0].text
    assert with_sensors(graph, wrong) is graph


def test_odometry_is_weighted_by_its_actual_errors():
    """Several times the stated noise: it is weighted accordingly, and does no harm."""
    right, graph = walked(0 * NODDING)
    measured = measure_all((OdometryEdges(),), sensed(odometer(right, 0.04)), graph)
    record = measured.records[0]
    assert record.scale is not None
    assert 1.5 < record.scale < 5
    assert ate(solved(graph, measured), right) < 1.1 * ate(graph.poses, right)


def test_odometry_better_than_stated_gets_more_weight():
    right, graph = walked(0 * NODDING)
    measured = measure_all((OdometryEdges(),), sensed(odometer(right)), graph)
    stated = replace(
        measured, steps=tuple(replace(s, information=s.information / 4) for s in measured.steps)
    )
    assert measured.records[0].scale < 0.8
    assert ate(solved(graph, measured), right) < ate(solved(graph, stated), right)


def test_odometry_errors_are_estimated_from_constrained_motion():
    """Frames along a wall: their motion along it is extrapolated."""
    right, graph = walked(0 * NODDING)
    wall = (np.arange(N) >= 10) & (np.arange(N) < 48)
    measurements = graph.measurements.copy()
    measurements[wall[graph.edges[:, 1]]] = np.eye(4)
    poses = np.stack([*itertools.accumulate([graph.poses[0], *measurements], np.matmul)])
    wrong = replace(graph, measurements=measurements).with_poses(poses)
    measured = measure_all((OdometryEdges(),), sensed(odometer(right), degenerate=wall), wrong)
    assert measured.verified
    assert measured.records[0].scale <= 1
    # If degenerate frames are unknown, their errors are attributed to either.
    unmarked = measure_all((OdometryEdges(),), sensed(odometer(right)), wrong)
    scale = unmarked.records[0].scale
    assert scale is None or max(scale, *unmarked.depth_scale) > 1.5
    # With degenerate frames only, the odometry is not verified.
    nearly_all = np.arange(N) >= 8
    measured = measure_all(
        (OdometryEdges(),), sensed(odometer(right), degenerate=nearly_all), graph
    )
    assert measured.steps
    assert not measured.verified


@pytest.mark.parametrize(
    ("factor", "motion", "metric"),
    [(1.0, 1.0, True), (0.5, 1.0, False), (1.0, 0.05, False), (1.0, 0.01, False)],
)
def test_odometry_verifies_depth_unit(factor, motion, metric):
    """If the camera moved, and its tracked path is as long as that of the odometry."""
    right = truth()
    right[:, :3, 3] *= motion
    shorter = right.copy()
    shorter[:, :3, 3] *= factor
    graph = tracked(shorter, 0 * NODDING)
    lenient = OdometryEdges(drift_m=0.01, relative=0.5, limit=100)
    [record] = measure_all((lenient,), sensed(odometer(right)), graph).records
    assert record.scale is not None
    assert record.metric is metric


def test_bent_pairs_that_agree_with_each_other_lose_to_odometry():
    """A refined graph claims far more than its common error allows; odometry drifts little."""
    right, graph = walked(0 * NODDING)
    measured = measure_all((OdometryEdges(),), sensed(odometer(right, 0.002)), graph)
    bent = tracked(right, np.array([0.002, 0, 0, 0, 0.004, 0]))
    pairs = replace(bent, information=100 * bent.information)
    assert with_depth_scale(measured, sensed(odometer(right)), graph).depth_scale == (1.0, 1.0)
    scaled = with_depth_scale(measured, sensed(odometer(right, 0.002)), pairs)
    assert min(scaled.depth_scale) > 5
    assert ate(solved(pairs, measured), right) > 3 * ate(solved(pairs, scaled), right)


def test_jump_of_odometry_is_left_out():
    right, graph = walked(0 * NODDING)
    jumped = odometer(right)
    jumped[30:] = jumped[30:] @ np.eye(4)
    jumped[30:, :3, 3] += [0.5, 0, 0.2]
    measured = measure_all((OdometryEdges(),), sensed(jumped), graph)
    assert {step.i for step in measured.steps} == set(range(N - 1)) - {29}
    # It says nothing about the errors of the others, and is not in longer motions.
    assert measured.is_reliable
    [without] = measure_all((OdometryEdges(),), sensed(odometer(right)), graph).records
    assert measured.records[0].scale == pytest.approx(without.scale, rel=0.1)
    # Nor are there steps across missing odometry or the start of another recording.
    holes = odometer(right)
    holes[10] = np.nan
    parts = (np.arange(N) >= 40).astype(np.intp)
    measured = measure_all((OdometryEdges(),), replace(sensed(holes), parts=parts), graph)
    assert {step.i for step in measured.steps} == set(range(N - 1)) - {9, 10, 39}
    steps = measured.between([0, 4, 8, 12, 39, 42])
    assert [(s.i, s.j) for s in steps] == [(0, 4), (4, 8), (12, 39)]
    np.testing.assert_allclose(steps[1].T_i_j, se3.inverse(holes[4]) @ holes[8], atol=1e-9)


@pytest.mark.parametrize(("factor", "differs"), [(1.0, False), (0.95, True), (1.03, True)])
def test_wrong_radius_of_wheels_is_estimated(factor, differs) -> None:
    """Where images constrain the motion; where they don't, odometry has the right lengths, too."""
    right, graph = walked(0 * NODDING)
    wall = (np.arange(N) >= 30) & (np.arange(N) < 50)
    wheels = odometer(right, 0.005)
    wheels[:, :3, 3] *= factor
    measured = measure_all((OdometryEdges(),), sensed(wheels, degenerate=wall), graph)
    assert measured.verified
    assert (measured.lengths != 1) is differs
    assert measured.lengths == pytest.approx(1 / factor, rel=0.01 if differs else 1e-9)
    assert ("multiplied" in measured.records[0].text) is differs
    true = se3.inverse(right[:-1]) @ right[1:]
    ratio = [
        np.linalg.norm(s.T_i_j[:3, 3]) / np.linalg.norm(true[s.i, :3, 3]) for s in measured.steps
    ]
    assert np.median(ratio) == pytest.approx(1, abs=0.01)


def test_unknown_lengths_count_along_runs_that_images_do_not_constrain(monkeypatch) -> None:
    """As an error that all steps of a run share: its end has that of the whole length."""
    steps = np.tile(se3.exp(np.array([0.2, 0, 0, 0, 0, 0.1])), (30, 1, 1))
    is_open = (np.arange(30) >= 5) & (np.arange(30) < 15)
    length = float(np.linalg.norm(steps[0, :3, 3]))
    C = external_sensors._Lengths(1.0, 0.02).covariances(steps, is_open)
    assert not C[~is_open].any()
    assert np.trace(C[is_open].sum(0)) == pytest.approx((0.02 * 10 * length) ** 2)
    right, graph = walked(0 * NODDING)
    wall = np.arange(N) >= 20
    odometry = sensed(odometer(right), degenerate=wall)
    unknown = measure_all((OdometryEdges(),), odometry, graph)
    monkeypatch.setattr(external_sensors, "_LENGTHS", 1e-6)
    known = measure_all((OdometryEdges(),), odometry, graph)
    before, within = (
        [np.linalg.inv(m.steps[k].information)[:3, :3].trace() for m in (known, unknown)]
        for k in (5, 40)
    )
    assert before[1] == pytest.approx(before[0], rel=1e-6)
    assert within[1] > 1.2 * within[0]


def test_slip_within_the_errors_of_each_step_is_left_out(monkeypatch) -> None:
    """Then as much slip is expected where images can't show it."""
    monkeypatch.setattr(external_sensors, "_COMPARED", 15)  # as of a longer recording
    right, graph = walked(0 * NODDING)
    wall = np.arange(N) >= 50
    wheels = odometer(right, 0.002)
    slow = se3.exp(np.array([0, 0, 0.03, 0, 0, 0]))
    steps = se3.inverse(wheels[:-1]) @ wheels[1:]
    steps[21:25] = steps[21:25] @ slow
    slipping = np.stack([*itertools.accumulate([wheels[0], *steps], np.matmul)])
    plain, slipped = (
        measure_all((OdometryEdges(),), sensed(odometry, degenerate=wall), graph)
        for odometry in (wheels, slipping)
    )
    assert len(plain.steps) == N - 1
    assert set(range(N - 1)) - {step.i for step in slipped.steps} == {21, 22, 23, 24}
    assert slipped.verified
    last = [np.linalg.inv(m.steps[-1].information)[2, 2] for m in (plain, slipped)]
    assert last[1] - last[0] > 0.9 * 4 * 0.03**2 / 50


def test_poses_of_a_robot_base_are_named() -> None:
    right, graph = walked(0 * NODDING)
    T_body_camera = se3.inverse(se3.exp(np.array([0.3, 0, 0.2, 0, 0, 0])))
    T_body_camera[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    base = odometer(right) @ se3.inverse(T_body_camera)
    measured = measure_all((OdometryEdges(),), sensed(base), graph)
    assert not measured.steps
    assert "turned by 120 degrees" in measured.records[0].text
    unrelated = measure_all((OdometryEdges(),), sensed(odometer(right[::-1])), graph)
    assert "turned" not in unrelated.records[0].text


def test_loops_may_contradict_odometry_by_several_times_its_errors() -> None:
    right, graph = walked(0 * NODDING)
    wall = np.arange(N) >= 40
    measured = measure_all((OdometryEdges(),), sensed(odometer(right), degenerate=wall), graph)
    doubted = measured.doubted(measured.steps)
    np.testing.assert_allclose(doubted[7].information * 25, measured.steps[7].information)
    assert replace(measured, verified=False).doubted(measured.steps) == []


@pytest.mark.parametrize(("wrong", "verified"), [(2, True), (8, False)])
def test_odometry_that_is_mostly_wrong_bounds_nothing(wrong, verified) -> None:
    """Where images don't constrain the motion, nothing tells its wrong steps from right ones."""
    right, graph = walked(0 * NODDING)
    wall = np.arange(N) >= 13
    jumping = odometer(right)
    for k in range(1, wrong + 1):
        jumping[k:, :3, 3] += [0.5, 0, 0.2]
    odometry = OdometryEdges(scale=1.0)
    measured = measure_all((odometry,), sensed(jumping, degenerate=wall), graph)
    assert {step.i for step in measured.steps} == set(range(wrong, N - 1))
    assert measured.verified == verified


def test_odometry_from_the_same_depth_is_no_evidence():
    """It has the errors of the tracked motion, except where that is extrapolated."""
    graph = tracked(truth(), 0 * NODDING)
    same = odometer(graph.poses, 0.0005)
    measured = measure_all((OdometryEdges(),), sensed(same), graph)
    assert not measured.steps
    assert not measured.is_reliable
    assert "computed from it" in measured.records[0].text
    wall = (np.arange(N) >= 20) & (np.arange(N) < 24)
    measured = measure_all((OdometryEdges(),), sensed(same, degenerate=wall), graph)
    assert {step.i for step in measured.steps} == {19, 20, 21, 22, 23}
    # Independent odometry differs by the errors of tracking, however good it is itself.
    assert len(measure_all((OdometryEdges(),), sensed(truth()), graph).steps) == N - 1


def test_odometry_with_known_errors_counts_where_the_path_rests_on_it():
    graph = tracked(truth(), 0 * NODDING)
    same = sensed(odometer(graph.poses, 0.0005))
    known = measure_all((OdometryEdges(scale=0.5),), same, graph)
    assert len(known.steps) == N - 1
    assert known.verified
    assert known.records[0].scale == 0.5
    stated = measure_all((OdometryEdges(scale=1.0),), same, graph)
    np.testing.assert_allclose(known.steps[3].information, 4 * stated.steps[3].information)


def test_missing_sensors_change_nothing():
    graph = tracked(truth(), NODDING)
    measured = measure_all((GravityEdges(), OdometryEdges()), sensed(), graph)
    assert not measured
    assert measured.records == ()
    assert with_sensors(graph, measured) is graph


def test_refinement_takes_unconstrained_tilt_from_gravity():
    """Views of a bare wall, invariant to rotation about its normal and translation along it."""
    poses = se3.exp(np.linspace(0, 0.2, 6)[:, None] * np.array([1.0, 0, 0, 0, -0.5, 0]))
    views = []
    for k, T in enumerate(poses):
        frame = replace(corner(T), index=k)
        assert frame.keep(np.zeros_like(frame.valid)).camera is frame.camera
        rays = frame.camera.rays()
        n = T[:3, :3].T @ np.array([0, 0, 1.0])
        z = (2.0 - T[2, 3]) / (rays @ n[:2] + n[2])
        frame = replace(frame, depth=z.astype(np.float32), amplitude_image=None)
        views.append(SampledView.of(prepare_view(frame, SHARP), 800))
    rolled = poses.copy()
    for k in range(6):
        rolled[k] = rolled[k] @ se3.exp(np.array([0, 0, 0, 0, 0, 0.02 * k]))
    options = RefineOptions(photometric=False)
    down = np.array([0, 1.0, 0])
    gravity = measure_all(
        (GravityEdges(),),
        SensorData(
            np.arange(6),
            np.arange(6.0),
            np.full((6, 4, 4), np.nan),
            np.concatenate(
                [np.einsum("kji,j->ki", poses[:, :3, :3], down), np.full((6, 1), 0.01)], 1
            ),
            np.zeros(6, np.intp),
            np.zeros(6, bool),
        ),
        build_graph(range(6), rolled, []),
    ).gravity_of(range(6))
    priors = replace(Priors.none(), gravity=gravity)
    free = refine(views, rolled, options)
    corrected = refine(views, rolled, options, priors=priors)

    def off(found: np.ndarray) -> float:
        return float(se3.angle(se3.inverse(poses[-1]) @ found[-1]))

    assert off(free.poses) > 0.05
    assert off(corrected.poses) < 0.01
    # Without priors: the same to the last bit.
    same = refine(views, rolled, options, priors=Priors.none(), calibrate=[kernels.FOCAL])
    again = refine(views, rolled, options, calibrate=[kernels.FOCAL])
    np.testing.assert_array_equal(same.poses, again.poses)
