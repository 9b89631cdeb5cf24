"""How cameras move: what goes on is expected, what comes out of nowhere has to be confirmed."""

from __future__ import annotations

import numpy as np
import pytest

from tofuse.geometry import se3
from tofuse.odometry.motion import Moment, Motion, is_small, jumps

STEP = se3.exp(np.array([0.03, 0, 0.01, 0, 0.04, 0.01]))


def walk(count, start=None, step=STEP):
    poses = [np.eye(4) if start is None else start]
    while len(poses) < count:
        poses.append(poses[-1] @ step)
    return poses


def followed(poses):
    motion = Motion()
    for T in poses:
        assert not motion.surprise(T, motion.expected)
        assert not motion.follow(T)
    return motion


def elsewhere(T, metres=0.3, angle=0.0):
    return T @ se3.exp(np.array([metres, 0, 0, 0, 0, angle]))


def test_the_last_motion_goes_on_over_lost_frames() -> None:
    poses = walk(9)
    motion = Motion()
    assert motion.expected is None
    motion.follow(poses[0])
    assert motion.expected is None
    for T in poses[1:5]:
        motion.follow(T)
    np.testing.assert_allclose(motion.expected, poses[5], atol=1e-12)
    motion.miss()
    motion.miss()
    np.testing.assert_allclose(motion.expected, poses[7], atol=1e-12)
    assert not motion.surprise(poses[7], motion.expected)
    motion.follow(poses[7])
    np.testing.assert_allclose(motion.expected, poses[8], atol=1e-12)


def test_the_mean_motion_goes_on_more_steadily() -> None:
    rng = np.random.default_rng(5)
    true = walk(40)
    noise = np.array([0.004] * 3 + [0.005] * 3)
    motion, last, mean = Motion(), [], []
    assert motion.steadily is None
    for k, T in enumerate(true):
        motion.follow(T @ se3.exp(noise * rng.standard_normal(6)))
        if k >= 8:
            back = se3.inverse(true[k] @ STEP)
            last.append(se3.log(back @ motion.expected) / noise)
            mean.append(se3.log(back @ motion.steadily) / noise)
    last, mean = (np.sqrt(np.mean(np.square(off))) for off in (last, mean))
    # Of both ends of one motion, and of the newest place, beside hardly more than the latter.
    assert 1.9 < last < 2.6
    assert mean < 0.65 * last
    motion.interrupt()
    assert motion.steadily is None


def test_a_jump_hardly_counts_in_the_mean() -> None:
    poses = walk(9)
    motion = followed(poses[:8])
    there = elsewhere(poses[8], 0.5, 0.6)
    motion.follow(there)
    off = se3.log(se3.inverse(there @ STEP) @ motion.steadily)
    assert 0.0 < np.linalg.norm(off[:3]) < 0.02
    assert np.linalg.norm(off[3:]) < np.radians(1.3)


@pytest.mark.parametrize(("metres", "angle"), [(0.3, 0.0), (0.0, 0.2)])
def test_a_place_out_of_nowhere_is_a_surprise(metres, angle) -> None:
    poses = walk(8)
    motion = followed(poses[:7])
    words = motion.surprise(elsewhere(poses[7], metres, angle), motion.expected)
    assert f"{metres:.2f} m and {np.degrees(angle):.0f} degrees" in words
    # What was expected is still believed after it.
    motion.miss()
    nearly = elsewhere(walk(9)[8], 0.02)
    assert not motion.surprise(nearly, motion.expected)
    assert not motion.follow(nearly)


def test_what_goes_on_from_a_surprise_confirms_it() -> None:
    poses = walk(12)
    motion = followed(poses[:6])
    jumped = [elsewhere(poses[5], 0.5) @ se3.inverse(poses[5]) @ T for T in poses]
    assert motion.surprise(jumped[6], motion.expected)
    motion.miss()
    assert not motion.surprise(jumped[7], motion.expected)
    assert motion.follow(jumped[7])
    np.testing.assert_allclose(motion.expected, jumped[8], atol=1e-12)
    assert not motion.surprise(jumped[8], motion.expected)
    assert not motion.follow(jumped[8])


def test_what_moves_otherwise_from_a_surprise_does_not() -> None:
    """A mirrored image turns the other way."""
    turn = se3.exp(np.array([0, 0, 0, 0, 0.1, 0]))
    motion = followed(walk(6, step=turn))
    mirrored = walk(8, elsewhere(walk(6, step=turn)[-1], 0.0, 1.0), se3.inverse(turn))
    assert motion.surprise(mirrored[1], motion.expected)
    motion.miss()
    assert motion.surprise(mirrored[2], motion.expected)


def test_after_a_long_loss_the_camera_may_be_anywhere() -> None:
    motion = followed(walk(6))
    for _ in range(3):
        motion.miss()
    assert motion.expected is None
    far = elsewhere(np.eye(4), 5.0, 2.0)
    assert not motion.surprise(far, walk(10)[9])
    assert not motion.follow(far)
    assert motion.expected is None


def test_a_restless_camera_may_be_restless() -> None:
    rng = np.random.default_rng(1)
    poses = [np.eye(4)]
    for _ in range(12):
        step = rng.normal(0, [0.1, 0.1, 0.1, 0.2, 0.2, 0.2])
        poses.append(poses[-1] @ se3.exp(np.array([0.5, 0, 0, 0, 0.4, 0]) + 0.4 * step))
    followed(poses)


def test_jumps_of_a_whole_path() -> None:
    poses = walk(20)
    assert jumps(poses) == []
    shift = elsewhere(np.eye(4), 0.4)
    broken = [*poses[:8], None, *(shift @ T for T in poses[9:])]
    found = jumps(broken)
    assert [k for k, _ in found] == [9]
    assert "0.40 m" in found[0][1]
    assert jumps(broken, {9}) == []
    spike = [*poses[:8], shift @ poses[8], *poses[9:]]
    assert [k for k, _ in jumps(spike)] == [8, 9]


@pytest.mark.parametrize(
    ("seconds", "believed"), [(None, False), (0.1, False), (0.2, False), (0.45, True), (2.0, True)]
)
def test_the_longer_between_frames_the_further_a_motion_may_change(seconds, believed) -> None:
    """0.2 m: what 3 m/s^2 lead to in 0.37 s."""
    poses = walk(8)
    motion = followed(poses[:7])
    words = motion.surprise(elsewhere(poses[7], 0.2), motion.expected, seconds)
    assert (words == "") == believed


def test_after_the_longest_time_not_everything_is_believed() -> None:
    poses = walk(8)
    motion = followed(poses[:7])
    assert motion.surprise(elsewhere(poses[7], 1.5), motion.expected, 60.0)


def test_the_time_over_a_lost_frame_is_that_of_two() -> None:
    poses = walk(9)
    motion = followed(poses[:7])
    motion.miss()
    assert motion.surprise(elsewhere(poses[8], 0.2), motion.expected, 0.4)
    assert not motion.surprise(elsewhere(poses[8], 0.2), motion.expected, 0.9)


def test_frames_that_are_only_counted_have_no_time() -> None:
    assert Moment(5, 0.5).seconds_since(Moment(3, 0.3)) == pytest.approx(0.2)
    assert Moment(5, 5.0).seconds_since(Moment(3, 3.0)) is None
    assert Moment(5, 0.5).seconds_since(None) is None


def test_jumps_know_the_time() -> None:
    poses = walk(20)
    broken = [*poses[:8], *(elsewhere(np.eye(4), 0.3) @ T for T in poses[8:])]
    for rate, found in ((30.0, [8]), (2.0, [])):
        moments = [Moment(k, k / rate) for k in range(20)]
        assert [k for k, _ in jumps(broken, (), moments)] == found


def test_small_motions() -> None:
    assert is_small(np.eye(4))
    assert is_small(elsewhere(np.eye(4), 0.05, 0.06))
    assert not is_small(elsewhere(np.eye(4), 0.07))
    assert not is_small(elsewhere(np.eye(4), 0.0, 0.08))
