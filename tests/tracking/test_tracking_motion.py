"""Motion model: continued motion passes the gate, a jump does not."""

from __future__ import annotations

import numpy as np
import pytest

from tofuse.engine.geometry import se3
from tofuse.engine.tracking.motion import FrameTime, MotionModel, find_jumps

STEP = se3.exp(np.array([0.03, 0, 0.01, 0, 0.04, 0.01]))


def counted(k):
    """A frame of unknown time."""
    return FrameTime(k, float(k))


def timed(rate):
    return lambda k: FrameTime(k, 100.0 + k / rate)


def walk(count, start=None, step=STEP):
    poses = [np.eye(4) if start is None else start]
    while len(poses) < count:
        poses.append(poses[-1] @ step)
    return poses


def followed(poses, when=counted):
    motion = MotionModel()
    for k, T in enumerate(poses):
        assert not motion.gate_violation(T, when(k))
        motion.update(T, when(k))
    return motion


def elsewhere(T, metres=0.3, angle=0.0):
    return T @ se3.exp(np.array([metres, 0, 0, 0, 0, angle]))


@pytest.mark.parametrize("when", [counted, timed(15.0)])
def test_last_motion_is_extrapolated_over_lost_frames(when) -> None:
    poses = walk(9)
    motion = MotionModel()
    assert motion.predicted_pose(when(0)) is None
    motion.update(poses[0], when(0))
    assert motion.predicted_pose(when(1)) is None
    for k in range(1, 5):
        motion.update(poses[k], when(k))
    np.testing.assert_allclose(motion.predicted_pose(when(5)), poses[5], atol=1e-12)
    np.testing.assert_allclose(motion.predicted_pose(when(7)), poses[7], atol=1e-12)
    assert not motion.gate_violation(poses[7], when(7))
    motion.update(poses[7], when(7))
    np.testing.assert_allclose(motion.predicted_pose(when(8)), poses[8], atol=1e-12)


def test_uneven_timestamps_stay_within_gate() -> None:
    """A camera moves evenly; frames are missing or late."""
    rng = np.random.default_rng(2)
    twist = np.array([0.6, 0, 0.2, 0, 0.9, 0.3])  # per second
    motion, t = MotionModel(), 0.0
    for k in range(30):
        t += rng.uniform(0.03, 0.15)
        T, now = se3.exp(t * twist), FrameTime(k, t)
        assert not motion.gate_violation(T, now)
        if k > 1:
            np.testing.assert_allclose(motion.predicted_pose(now), T, atol=1e-9)
        motion.update(T, now)


def test_smoothed_prediction_is_less_noisy() -> None:
    rng = np.random.default_rng(5)
    true = walk(40)
    noise = np.array([0.004] * 3 + [0.005] * 3)
    motion, last, mean = MotionModel(), [], []
    assert motion.smoothed_pose(counted(0)) is None
    for k, T in enumerate(true):
        motion.update(T @ se3.exp(noise * rng.standard_normal(6)), counted(k))
        if k >= 8:
            back, then = se3.inverse(true[k] @ STEP), counted(k + 1)
            last.append(se3.log(back @ motion.predicted_pose(then)) / noise)
            mean.append(se3.log(back @ motion.smoothed_pose(then)) / noise)
    last, mean = (np.sqrt(np.mean(np.square(off))) for off in (last, mean))
    # The last motion has the noise of two poses, the mean hardly more than the newest pose's.
    assert 1.9 < last < 2.6
    assert mean < 0.65 * last
    motion.interrupt()
    assert motion.smoothed_pose(counted(40)) is None


def test_jump_barely_affects_mean_motion() -> None:
    poses = walk(9)
    motion = followed(poses[:8])
    there = elsewhere(poses[8], 0.5, 0.6)
    motion.update(there, counted(8))
    off = se3.log(se3.inverse(there @ STEP) @ motion.smoothed_pose(counted(9)))
    assert 0.0 < np.linalg.norm(off[:3]) < 0.02
    assert np.linalg.norm(off[3:]) < np.radians(1.3)


@pytest.mark.parametrize(("metres", "angle"), [(0.3, 0.0), (0.0, 0.2)])
@pytest.mark.parametrize("when", [counted, timed(30.0)])
def test_sudden_displacement_violates_gate(metres, angle, when) -> None:
    poses = walk(9)
    motion = followed(poses[:7], when)
    words = motion.gate_violation(elsewhere(poses[7], metres, angle), when(7))
    assert f"{metres:.2f} m and {np.degrees(angle):.0f} degrees" in words
    # The regular motion still passes afterwards.
    assert not motion.gate_violation(elsewhere(poses[8], 0.02), when(8))


def test_gate_violation_starts_at_limits() -> None:
    poses = walk(8)
    motion = followed(poses[:7])
    far, angle = motion.gate(counted(7))
    assert not motion.gate_violation(elsewhere(poses[7], 0.99 * far), counted(7))
    assert motion.gate_violation(elsewhere(poses[7], 1.01 * far), counted(7))
    assert not motion.gate_violation(elsewhere(poses[7], 0.0, 0.99 * angle), counted(7))
    assert motion.gate_violation(elsewhere(poses[7], 0.0, 1.01 * angle), counted(7))


def test_motion_after_accepted_jump_passes_gate() -> None:
    poses = walk(12)
    motion = followed(poses[:6])
    jumped = [elsewhere(poses[5], 0.5) @ se3.inverse(poses[5]) @ T for T in poses]
    assert motion.gate_violation(jumped[6], counted(6))
    motion.interrupt()
    for k in (6, 7, 8, 9):
        assert not motion.gate_violation(jumped[k], counted(k))
        motion.update(jumped[k], counted(k))
    np.testing.assert_allclose(motion.predicted_pose(counted(10)), jumped[10], atol=1e-12)


def test_gate_is_unbounded_after_long_loss_of_unknown_duration() -> None:
    motion = followed(walk(6))
    far = elsewhere(np.eye(4), 5.0, 2.0)
    assert motion.gate_violation(far, counted(6))
    assert not motion.gate_violation(far, counted(12))
    assert np.isinf(motion.gate(counted(12))).all()


def test_jumps_of_path_are_found() -> None:
    poses, moments = walk(20), [counted(k) for k in range(20)]
    assert find_jumps(poses, moments) == []
    shift = elsewhere(np.eye(4), 0.4)
    broken = [*poses[:8], None, *(shift @ T for T in poses[9:])]
    found = find_jumps(broken, moments)
    assert [k for k, _ in found] == [9]
    assert "0.40 m" in found[0][1]
    assert find_jumps(broken, moments, {9}) == []
    spike = [*poses[:8], shift @ poses[8], *poses[9:]]
    assert find_jumps(spike, moments)[0][0] == 8


@pytest.mark.parametrize(
    ("seconds", "usual"), [(None, False), (0.1, False), (0.2, False), (0.45, True), (2.0, True)]
)
def test_gate_widens_with_frame_interval(seconds, usual) -> None:
    """0.2 m: the displacement by 3 m/s^2 in 0.37 s."""
    poses = walk(8)
    when = counted if seconds is None else timed(1 / seconds)
    words = followed(poses[:7], when).gate_violation(elsewhere(poses[7], 0.2), when(7))
    assert (words == "") == usual


def test_frame_numbers_are_not_timestamps() -> None:
    assert FrameTime(5, 0.5).seconds_since(FrameTime(3, 0.3)) == pytest.approx(0.2)
    assert FrameTime(5, 5.0).seconds_since(FrameTime(3, 3.0)) is None
    assert FrameTime(5, 5.0).since(FrameTime(3, 3.0)) == 2
    assert FrameTime(5, 0.5).since(FrameTime(3, 0.3)) == pytest.approx(0.2)
    # Constant timestamps carry no information.
    assert FrameTime(5, 0.3).seconds_since(FrameTime(3, 0.3)) is None
    assert FrameTime(5, 0.3).since(FrameTime(3, 0.3)) == 2


def test_new_component_inherits_velocity() -> None:
    poses = walk(10)
    motion = followed(poses[:6])
    motion.change_frame()
    motion.update(np.eye(4), counted(6))
    step = se3.inverse(poses[5]) @ poses[6]
    np.testing.assert_allclose(motion.predicted_pose(counted(7)), step, atol=1e-12)
    assert motion.velocity_is_inherited
    assert motion.normalised_deviation(elsewhere(np.eye(4), 2.0, 1.0), counted(7)) == 0
    # A motion observed in the new component replaces it.
    motion.update(step, counted(7))
    assert not motion.velocity_is_inherited


@pytest.mark.parametrize(
    ("metres", "angle", "possible"), [(0.3, 0.5, True), (0.5, 0.0, False), (0.0, 0.9, False)]
)
def test_hand_held_speed_limits_feasible_motion(metres, angle, possible) -> None:
    when = timed(10.0)
    motion = followed(walk(3), when)
    assert motion.is_feasible(elsewhere(walk(3)[2], metres, angle), when(3)) is possible


def test_deviation_is_normalised_by_usual_deviation() -> None:
    rng = np.random.default_rng(2)
    poses = [T @ se3.exp(np.array([*rng.normal(0, 0.01, 3), 0, 0, 0])) for T in walk(12)]
    motion = followed(poses[:11])
    expected = motion.predicted_pose(counted(11))
    usual = motion.normalised_deviation(elsewhere(expected, 0.02), counted(11))
    assert 0 < usual < 2
    assert motion.normalised_deviation(elsewhere(expected, 0.2), counted(11)) == pytest.approx(
        10 * usual
    )
    assert MotionModel().normalised_deviation(np.eye(4), counted(0)) == 0


def turning(count):
    """Poses of a camera that starts to rotate fast at the last one."""
    poses = walk(count)
    poses[-1] = poses[-1] @ se3.exp(np.array([0, 0, 0, 0, 0.5, 0]))
    return poses


@pytest.mark.parametrize(("drift", "proven"), [(0.0, True), (0.1, False)])
def test_reliable_odometry_predicts_rotation(drift, proven) -> None:
    rng = np.random.default_rng(3)
    poses = turning(12)
    shaken = [T @ se3.exp(np.array([0, 0, 0, *rng.normal(0, 0.01, 3)])) for T in poses]
    world = se3.exp(np.array([1.0, 2.0, 3.0, 0.4, 0.5, 0.6]))
    sensed = [world @ T @ se3.exp([0, 0, 0, 0, drift * k, 0]) for k, T in enumerate(shaken)]
    motion = MotionModel()
    for k in range(11):
        motion.set_odometry(sensed[k])
        motion.update(shaken[k], counted(k))
    assert motion.gate_violation(shaken[11], counted(11))
    motion.set_odometry(sensed[11])
    assert (not motion.gate_violation(shaken[11], counted(11))) is proven
    if proven:
        off = se3.inverse(motion.predicted_pose(counted(11))) @ shaken[11]
        assert se3.angle(off) < 1e-9


def test_odometry_predicts_position_along_degenerate_directions() -> None:
    """A sudden slide along a wall: the tracked motion equals the predicted one."""
    rng = np.random.default_rng(4)
    poses = [
        se3.exp(np.array([0.05 * max(k - 5, 0), *rng.normal(0, 0.001, 3), 0.01 * k, 0]))
        for k in range(20)
    ]
    world = se3.exp(np.array([1.0, 2.0, 3.0, 0.4, 0.5, 0.6]))
    motion = MotionModel()
    for k, T in enumerate(poses):
        motion.set_odometry(world @ T)
        slides = k > 5
        predicted = motion.predicted_pose(counted(k)) if slides else T
        motion.update(predicted, counted(k), degenerate=slides)
    np.testing.assert_allclose(predicted, poses[-1], atol=1e-9)


def test_odometry_worse_than_constant_velocity_is_ignored() -> None:
    """Frozen poses of a device that lost tracking; and the first motion, which nothing predicts."""
    poses = walk(12)
    motion = MotionModel()
    for k, T in enumerate(poses[:11]):
        motion.set_odometry(np.eye(4))
        motion.update(T, counted(k))
    motion.set_odometry(np.eye(4))
    np.testing.assert_allclose(motion.predicted_pose(counted(11)), poses[11], atol=1e-9)
    # Farther than a hand moves a camera between two frames.
    first = MotionModel()
    for far, expected in ((0.1, True), (3.0, False)):
        first.set_odometry(np.eye(4))
        first.update(np.eye(4), timed(30.0)(0))
        first.set_odometry(se3.exp(np.array([far, 0, 0, 0, 0, 0])))
        assert (first.predicted_pose(timed(30.0)(1)) is not None) is expected
        first.interrupt()


def test_odometry_after_gap_is_not_used() -> None:
    poses = walk(13)
    motion = MotionModel()
    for k in range(12):
        motion.set_odometry(None if k == 11 else poses[k])
        motion.update(poses[k], counted(k))
    motion.set_odometry(se3.exp(np.array([0, 0, 0, 0, 1.0, 0])))
    np.testing.assert_allclose(motion.predicted_pose(counted(12)), poses[12], atol=1e-12)


@pytest.mark.parametrize(
    ("noise", "jump", "frames", "trusted"),
    [(0.0, 0.0, 12, True), (0.05, 0.0, 12, False), (0.0, 0.5, 12, False), (0.0, 0.0, 3, False)],
)
def test_odometry_is_trusted_if_it_predicted_better_and_did_not_jump(
    noise, jump, frames, trusted
) -> None:
    rng = np.random.default_rng(5)
    shaken = [T @ se3.exp(np.array([*rng.normal(0, 0.01, 6)])) for T in walk(frames)]
    sensed = [T @ se3.exp(np.array([*rng.normal(0, noise, 6)])) for T in shaken]
    sensed[-1] = sensed[-1] @ se3.exp(np.array([jump, 0, 0, 0, 0, 0]))
    motion = MotionModel()
    for k in range(frames - 1):
        motion.set_odometry(sensed[k])
        motion.update(shaken[k], counted(k))
    motion.set_odometry(sensed[-1])
    T = motion.trusted_odometry_pose(counted(frames - 1))
    assert (T is not None) is trusted
    if trusted:
        np.testing.assert_allclose(T, shaken[-1], atol=1e-9)
