"""Trajectories of one rig with separate clocks: synchronisation and hand-eye calibration."""

import numpy as np
import pytest

from pose_errors import assert_near
from tofuse.apps.rigs.clocks import lag_between
from tofuse.apps.rigs.hand_eye import Track, clock_of, combined, hand_eye
from tofuse.engine.geometry import se3
from tofuse.lab.simulation.rig import wander
from tofuse.lab.world.paths import rotation

OFFSET = 0.0123


def mounted() -> np.ndarray:
    T = rotation([0.05, 2.1, 0.03])
    T[:3, 3] = [0.09, 0.02, -0.14]
    return T


def tracks(
    seed: int = 0, path=None, millimetres: float = 2.0, degrees: float = 0.07
) -> tuple[Track, Track]:
    """Two cameras with errors that are correlated over half a second, at 30.03 and 30.14 Hz."""
    rng = np.random.default_rng([seed, 7])
    path = path or wander((0, 0, 1.2), (0.9, 0.5), 9.0)
    out = []
    for rate, offset, T in ((30.03, 0.0, np.eye(4)), (30.14, OFFSET, mounted())):
        times = np.arange(240) / rate + 0.4 - offset
        poses = np.stack([path(t + offset) @ T for t in times])
        poses = se3.inverse(poses[0]) @ poses
        errors = rng.normal(size=(240, 6))
        keep = np.exp(-1 / 15)
        for k in range(1, 240):
            errors[k] = keep * errors[k - 1] + np.sqrt(1 - keep**2) * errors[k]
        scale = np.array([millimetres * 1e-3] * 3 + [np.radians(degrees)] * 3)
        out.append(Track(times, poses @ se3.exp(errors * scale)))
    return out[0], out[1]


def test_clocks_are_synchronised_by_rotations() -> None:
    a, b = tracks()
    lag = clock_of(a, b)
    assert lag is not None
    assert lag.certain
    assert lag.seconds == pytest.approx(OFFSET, abs=0.004)


def test_unrelated_signals_determine_no_lag() -> None:
    rng = np.random.default_rng(1)
    times = np.arange(300) / 30
    lag = lag_between(times, rng.normal(size=300), times, rng.normal(size=300))
    assert lag is not None
    assert not lag.certain


def test_short_noise_seldom_determines_a_lag() -> None:
    times = np.arange(15) / 10
    signals = (np.random.default_rng(k).normal(size=(2, 15)) for k in range(300))
    lags = [lag_between(times, first, times, second) for first, second in signals]
    assert sum(lag.certain for lag in lags) <= 6


def test_hand_eye_finds_pose_and_clock() -> None:
    a, b = tracks()
    found = hand_eye(a, b, 0.0)
    assert_near(found.T_a_b, mounted(), 0.006, 0.3)
    assert found.time_offset_s == pytest.approx(OFFSET, abs=0.002)


def test_hand_eye_is_exact_without_errors() -> None:
    a, b = tracks(millimetres=0.0, degrees=0.0)
    found = hand_eye(a, b, 0.0)
    off = se3.inverse(found.T_a_b) @ mounted()
    # The remaining error is that of interpolation between frames.
    assert np.linalg.norm(off[:3, 3]) < 0.0003
    assert found.time_offset_s == pytest.approx(OFFSET, abs=0.0003)


@pytest.mark.nightly
def test_covariance_covers_errors() -> None:
    squares, clocks = [], []
    for seed in range(15):
        a, b = tracks(seed)
        found = hand_eye(a, b, OFFSET)
        clocks.append((found.time_offset_s - OFFSET) / found.time_sigma_s)
        e = se3.log(se3.inverse(found.T_a_b) @ mounted())
        squares.append(e @ np.linalg.solve(found.covariance, e))
    inside = np.mean(np.array(squares) < 12.592)  # 95 % of chi-square with 6 degrees
    assert 0.8 <= inside <= 1.0
    assert np.mean(np.abs(clocks) < 1.96) >= 0.85
    assert 0.7 < np.std(clocks) < 1.3


def test_rotation_about_one_axis_does_not_constrain_height() -> None:
    a, b = tracks(path=lambda t: rotation([0, 0.7 * t + 0.3 * np.sin(2 * t), 0]))
    found = hand_eye(a, b, 0.0)
    # Along the rotation axis, in b's frame.
    axis = found.T_a_b[:3, :3].T @ [0.0, 1.0, 0.0]
    assert np.sqrt(axis @ found.covariance[:3, :3] @ axis) > 0.1


def test_fits_of_the_same_poses_are_not_combined_as_independent_ones() -> None:
    a, b = tracks()
    b = Track(b.times, mounted() @ b.poses)  # in the world of the first camera
    free, common = (hand_eye(a, b, OFFSET, common_world=known) for known in (False, True))
    exact = combined(free, common, np.zeros((6, 6)))
    np.testing.assert_allclose(exact.T_a_b, common.T_a_b, atol=1e-12)
    np.testing.assert_allclose(exact.covariance, common.covariance, rtol=1e-6)
    unknown = combined(free, common, np.eye(6))  # the common world may be deformed in any way
    assert_near(unknown.T_a_b, free.T_a_b, 1e-3, 0.02)
    assert np.trace(unknown.covariance) == pytest.approx(np.trace(free.covariance), rel=0.1)
