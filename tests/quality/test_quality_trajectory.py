"""Errors of trajectories with known errors."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tofuse.engine.arrays import Float64
from tofuse.engine.errors import InputError
from tofuse.engine.geometry import se3
from tofuse.engine.quality.trajectory_errors import align, evaluate_trajectory, relative_error


def walk(n: int, seed: int = 0, spread: float = 1.0) -> Float64:
    """A wandering camera: (n, 4, 4)."""
    rng = np.random.default_rng(seed)
    steps = rng.normal(size=(n, 6)) * np.repeat([0.1 * spread, 0.1], 3)
    T = [se3.exp(rng.uniform(-1, 1, 6))]
    for step in steps[1:]:
        T.append(T[-1] @ se3.exp(step))
    return np.stack(T)


def horn(x: Float64, y: Float64) -> tuple[Float64, Float64]:
    """R, t of the best motion of points x onto y by Horn's unit quaternion (1987)."""
    a, b = x - x.mean(0), y - y.mean(0)
    S = a.T @ b
    d = np.array([S[1, 2] - S[2, 1], S[2, 0] - S[0, 2], S[0, 1] - S[1, 0]])
    N = np.empty((4, 4))
    N[0, 0], N[0, 1:], N[1:, 0] = np.trace(S), d, d
    N[1:, 1:] = S + S.T - np.trace(S) * np.eye(3)
    _, v = np.linalg.eigh(N)
    q0, *q = v[:, -1]
    Q = se3.hat(q)
    R = (q0 * q0 - np.dot(q, q)) * np.eye(3) + 2 * np.outer(q, q) + 2 * q0 * Q
    return R, y.mean(0) - R @ x.mean(0)


def test_error_is_zero_up_to_rigid_motion() -> None:
    reference = walk(80)
    estimate = se3.exp([5, -3, 2, 0.4, -2.0, 1.0]) @ reference
    times = np.arange(80) / 30
    result = evaluate_trajectory(times, estimate, times, reference)
    assert result.ate_rms_m < 1e-9
    assert result.rotation_rms_rad < 1e-7
    assert [r.pairs for r in result.relative] == [79, 50]
    assert all(r.translation_rms_m < 1e-9 for r in result.relative)
    assert (result.associated, result.coverage) == (80, 1.0)
    assert result.T_reference_estimate @ estimate == pytest.approx(reference, abs=1e-9)


def test_ate_matches_horn_closed_form() -> None:
    rng = np.random.default_rng(1)
    reference, estimate = walk(50), walk(50)
    estimate[:, :3, 3] += 0.05 * rng.standard_normal((50, 3))
    estimate = se3.exp([1, 2, 3, 0.3, 2.0, -0.4]) @ estimate
    R, t = horn(estimate[:, :3, 3], reference[:, :3, 3])
    distances = np.linalg.norm(estimate[:, :3, 3] @ R.T + t - reference[:, :3, 3], axis=1)
    result = evaluate_trajectory(np.arange(50), estimate, np.arange(50), reference)
    assert result.ate_rms_m == pytest.approx(np.sqrt((distances**2).mean()), rel=1e-9)
    assert result.ate_max_m == pytest.approx(distances.max(), rel=1e-6)


def test_scale_is_not_aligned() -> None:
    x = np.array([-1.0, 0, 1, 0])
    reference = np.tile(np.eye(4), (4, 1, 1))
    reference[:, 0, 3], reference[:, 1, 3] = x, np.roll(x, 1)
    estimate = reference.copy()
    estimate[:, :3, 3] *= 1.1
    result = evaluate_trajectory(np.arange(4), estimate, np.arange(4), reference)
    assert result.ate_rms_m == pytest.approx(0.1)


@pytest.mark.parametrize("kind", ["rail", "spot", "two", "one"])
def test_orientations_resolve_degenerate_positions(kind: str) -> None:
    n = {"two": 2, "one": 1}.get(kind, 20)
    reference = walk(n, seed=3)
    if kind == "rail":
        reference[:, :3, 3] = np.linspace(0, 0.9, n)[:, None] * [0.6, 0.0, 0.8]
    if kind == "spot":
        reference[:, :3, 3] = [1.0, 2.0, 3.0]
    estimate = se3.exp([5, -3, 2, 0.4, -2.0, 1.0]) @ reference
    assert align(estimate, reference) @ estimate == pytest.approx(reference, abs=1e-6)


def test_rotation_error_of_pure_rotation() -> None:
    """Positions are noise and do not constrain the rotation: orientations do."""
    rng = np.random.default_rng(4)
    turn = np.zeros((60, 6))
    turn[:, 4] = np.linspace(0, 2 * np.pi, 60)
    reference = se3.exp(turn)
    estimate = reference @ se3.exp(np.deg2rad(1) * np.repeat([[0, 0, 0, 1, 0, 0]], 60, 0))
    estimate[:, :3, 3] = 0.005 * rng.standard_normal((60, 3))
    reference[:, :3, 3] = 0.005 * rng.standard_normal((60, 3))
    world = se3.exp([0, 0, 0, 0.0, 1.0, 0.5])
    result = evaluate_trajectory(np.arange(60), world @ estimate, np.arange(60), reference)
    assert np.degrees(result.rotation_rms_rad) == pytest.approx(1.0, abs=0.01)


def test_relative_errors_of_known_drift() -> None:
    n = 61
    reference = np.tile(np.eye(4), (n, 1, 1))
    reference[:, 2, 3] = 0.1 * np.arange(n)
    xi = np.zeros((n, 6))
    xi[:, 2] = 0.11 * np.arange(n)  # 1 cm of drift per step
    xi[:, 5] = math.radians(0.2) * np.arange(n)  # 0.2 degrees of roll per step
    estimate = se3.exp(xi)
    one, thirty = relative_error(estimate, reference, 1), relative_error(estimate, reference, 30)
    assert (one.pairs, thirty.pairs) == (60, 31)
    assert one.translation_rms_m == pytest.approx(0.01)
    assert thirty.translation_rms_m == pytest.approx(0.30)
    assert math.degrees(one.rotation_rms_rad) == pytest.approx(0.2)
    assert math.degrees(thirty.rotation_rms_rad) == pytest.approx(6.0)


def test_short_trajectory_has_no_relative_error() -> None:
    T = walk(10)
    result = evaluate_trajectory(np.arange(10), T, np.arange(10), T)
    assert result.relative[1].pairs == 0
    plain = result.to_dict()
    assert plain["rpe"][1]["translation_rms_m"] is None
    assert plain["rpe"][0]["frames"] == 1
    json.dumps(plain, allow_nan=False)


def test_a_single_pose_has_no_errors() -> None:
    """Alignment fits it, whatever it is."""
    T = walk(10)
    result = evaluate_trajectory([3], T[7:8], np.arange(10), T)
    assert result.associated == 1
    assert math.isnan(result.ate_rms_m)
    assert result.to_dict()["rotation_rms_deg"] is None
    json.dumps(result.to_dict(), allow_nan=False)


def test_lost_frames_reduce_coverage_only() -> None:
    T = walk(100)
    times = np.arange(100) / 10
    estimate = T.copy()
    estimate[40:60] = np.nan
    result = evaluate_trajectory(times, estimate, times, T)
    assert result.coverage == pytest.approx(0.8)
    assert result.associated == 80
    assert result.ate_rms_m < 1e-9


def test_coverage_counts_frames_if_known() -> None:
    """A reference with ten times the camera's rate does not add frames."""
    fast = walk(300)
    reference_times = np.arange(300) / 100
    frames = np.concatenate([reference_times[::10], [50.0, 51.0]])  # two without a reference
    kept = np.delete(np.arange(30), [3, 4, 5])
    times, estimate = reference_times[::10][kept], fast[::10][kept]
    plain = evaluate_trajectory(times, estimate, reference_times, fast)
    assert plain.coverage == pytest.approx(27 / 300)
    known = evaluate_trajectory(times, estimate, reference_times, fast, frames)
    assert known.coverage == pytest.approx(27 / 30)


@settings(max_examples=30)
@given(seed=st.integers(0, 10**6))
def test_errors_are_invariant_to_world_frames(seed: int) -> None:
    rng = np.random.default_rng(seed)
    reference = walk(40, seed)
    estimate = reference @ se3.exp(0.02 * rng.standard_normal((40, 6)))
    A, B = se3.exp(rng.uniform(-2, 2, (2, 6)))
    times = np.arange(40)
    one = evaluate_trajectory(times, estimate, times, reference)
    two = evaluate_trajectory(times, A @ estimate, times, B @ reference)
    assert two.ate_rms_m == pytest.approx(one.ate_rms_m, rel=1e-6)
    assert two.rotation_rms_rad == pytest.approx(one.rotation_rms_rad, rel=1e-6)
    assert two.relative[0].translation_rms_m == pytest.approx(one.relative[0].translation_rms_m)


def test_unmatched_trajectories_are_rejected() -> None:
    T = walk(3)
    with pytest.raises(InputError, match=r"no pose is within 0.02 s.*0 to 2 s.*100 to 102 s"):
        evaluate_trajectory([0, 1, 2], T, [100, 101, 102], T)
    with pytest.raises(InputError, match="shape"):
        evaluate_trajectory([0, 1, 2], T[:, :3], [0, 1, 2], T)
    with pytest.raises(InputError, match="2 times for 3 poses"):
        evaluate_trajectory([0, 1], T, [0, 1, 2], T)
