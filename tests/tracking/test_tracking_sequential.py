"""Frames chained one to the next, as in section 3.3 of the thesis."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest

from tofuse.engine.alignment.base import Registrar, Registration
from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.errors import RegistrationError
from tofuse.engine.frames.frames import CloudFrame, RangeFrame
from tofuse.engine.geometry import se3
from tofuse.engine.icp.icp import algorithm_1
from tofuse.engine.tracking.pairwise import SEED_STAGE, Sequential
from tofuse.lab.simulation.peaks import peaks_views


def cloud(index, points=50):
    return CloudFrame.of(np.random.default_rng(index).normal(size=(points, 3)), index=index)


def found(T, share=0.5):
    return Registration(np.asarray(T), True, 5, int(share * 1000), 1000, 0.1, 0.01, np.eye(6))


@dataclass(frozen=True)
class Scripted(Registrar):
    """Returns the given motions, ratios or errors one after the other, and records the calls."""

    answers: list
    asked: list = field(default_factory=list)

    @property
    def takes(self):
        return frozenset({"cloud"})

    def register(self, source, target, guess, rng):
        self.asked.append((source.index, target.index, np.array(guess), rng.integers(1 << 30)))
        answer = self.answers[len(self.asked) - 1]
        if isinstance(answer, Exception):
            raise answer
        return answer if isinstance(answer, Registration) else found(answer)


MOTIONS = se3.exp(np.random.default_rng(1).normal(0, 0.3, (6, 6)))


def test_previous_guess_is_last_motion_even_across_lost_frame():
    lost = RegistrationError("too bad")
    registrar = Scripted([MOTIONS[0], MOTIONS[1], lost, found(MOTIONS[2], 0.0), MOTIONS[3]])
    tracker = Sequential(registrar, "previous").start(0)
    for k in range(6):
        tracker.push(cloud(k))
    expected = [np.eye(4), MOTIONS[0], MOTIONS[1], MOTIONS[1], MOTIONS[1]]
    for (_, _, guess, _), want in zip(registrar.asked, expected, strict=True):
        np.testing.assert_array_equal(guess, want)
    assert [(s, t) for s, t, _, _ in registrar.asked] == [(1, 0), (2, 1), (3, 2), (4, 2), (5, 2)]


def test_odometry_guess_is_relative_pose():
    registrar = Scripted(list(MOTIONS))
    tracker = Sequential(registrar, "odometry").start(0)
    poses = list(se3.exp(np.random.default_rng(2).normal(size=(6, 6))))
    poses[3] = None
    poses[5] = np.full((4, 4), np.nan)
    for k in range(6):
        tracker.push(cloud(k), poses[k])
    guesses = [guess for _, _, guess, _ in registrar.asked]
    np.testing.assert_allclose(guesses[0], se3.inverse(poses[0]) @ poses[1])
    np.testing.assert_allclose(guesses[1], se3.inverse(poses[1]) @ poses[2])
    for missing in (2, 3, 4):
        np.testing.assert_array_equal(guesses[missing], np.eye(4))


@pytest.mark.parametrize("guess", ["previous", "odometry"])
def test_another_recording_begins_without_a_guess(guess):
    registrar = Scripted(list(MOTIONS))
    tracker = Sequential(registrar, guess).start(0)
    tracker.interrupt()
    for k, T in enumerate(MOTIONS[:3]):
        if k == 2:
            tracker.interrupt()
        tracker.push(cloud(k), T)
    np.testing.assert_array_equal(registrar.asked[-1][2], np.eye(4))


def test_lost_frame_has_reason_and_next_uses_last_tracked():
    registrar = Scripted(
        [MOTIONS[0], RegistrationError("no overlap"), found(MOTIONS[1], 0.019), MOTIONS[2]]
    )
    tracker = Sequential(registrar, min_inlier_ratio=0.02).start(0)
    steps = [tracker.push(cloud(k)) for k in range(5)]
    assert [s.status for s in steps] == ["tracked", "tracked", "lost", "lost", "tracked"]
    assert steps[2].T_component_camera is None
    assert steps[2].reason == "not registered to frame 1: no overlap"
    assert steps[3].T_component_camera is None
    assert "1.9 %" in steps[3].reason
    assert steps[4].reference == 1
    np.testing.assert_allclose(steps[4].T_component_camera, MOTIONS[0] @ MOTIONS[2], atol=1e-12)


def test_frames_without_points_are_lost():
    camera = Pinhole(width=8, height=6, fx=8, fy=8, cx=3.5, cy=2.5)
    invalid = RangeFrame(1, 0.1, camera, np.zeros((6, 8), np.float32))
    empty = CloudFrame.of(np.zeros((0, 3)), index=2)
    single = CloudFrame.of(np.ones((1, 3)), index=3)
    tracker = Sequential().start(0)
    # Before there is a first frame, and after it.
    for first in (4, 9):
        for frame in (invalid, empty, single):
            step = tracker.push(frame)
            assert step.status == "lost"
            assert step.reason == f"{len(frame)} valid points, 10 are needed"
            assert step.T_component_camera is None
        if first == 4:
            step = tracker.push(cloud(first, points=2000))
            assert step.status == "tracked"
            np.testing.assert_array_equal(step.T_component_camera, np.eye(4))


def test_degenerate_registration_loses_frame():
    points = np.outer(np.linspace(0, 1, 50), [1, 1, 1])
    tracker = Sequential(algorithm_1(1.0)).start(0)
    assert tracker.push(CloudFrame.of(points, index=4)).status == "tracked"
    for frame, why in (
        (CloudFrame.of(points, index=5), "lie on a line"),
        (CloudFrame.of(points + 100, index=6), "only 0 corresponding points"),
    ):
        step = tracker.push(frame)
        assert step.status == "lost"
        assert step.reason.startswith("not registered to frame 4: ")
        assert why in step.reason
        assert step.reference == 4


def test_each_pair_has_its_own_random_stream():
    registrar = Scripted(list(MOTIONS))
    tracker = Sequential(registrar).start(12)
    for index in (3, 5, 9):
        tracker.push(cloud(index))
    for source, target, _, draw in registrar.asked:
        want = np.random.default_rng([12, SEED_STAGE, source, target]).integers(1 << 30)
        assert draw == want


def test_rotations_stay_orthonormal_over_long_sequences():
    # A registrar whose motions are rotations only to 1e-6, as single precision would give.
    skewed = se3.exp([0.01, 0, 0, 0.02, 0.01, 0.03])
    skewed[:3, :3] *= 1 + 1e-6
    tracker = Sequential(Scripted([skewed] * 3000)).start(0)
    frame = cloud(0)
    for _ in range(3000):
        step = tracker.push(frame)
    R = step.T_component_camera[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)


def room_views(count, seed=0):
    """Views of a camera in front of three walls that moves 15 mm and 0.5 degrees per frame."""
    T = se3.exp(np.arange(count)[:, None] * [0.012, -0.005, 0.008, 0.004, 0.008, -0.003])
    views = []
    for k in range(count):
        rng = np.random.default_rng([seed, k])
        points = rng.uniform(-0.5, 0.5, (12_000, 3))
        points[np.arange(12_000), rng.integers(0, 3, 12_000)] = 0.5
        points += np.array([0, 0, 1.5]) + rng.normal(0, 0.002, points.shape)
        views.append(CloudFrame.of(se3.transform(se3.inverse(T[k]), points), index=k))
    return views, T


@pytest.mark.parametrize("guess", ["identity", "previous"])
def test_camera_is_tracked(guess):
    views, T = room_views(8)
    tracker = Sequential(algorithm_1(points=4000), guess).start(0)
    for view, truth in zip(views, T, strict=True):
        step = tracker.push(view)
        assert step.status == "tracked"
        xi = se3.log(se3.inverse(truth) @ step.T_component_camera)
        assert np.linalg.norm(xi[:3]) < 0.03
        assert np.linalg.norm(xi[3:]) < 0.02


@pytest.mark.nightly
def test_peaks_is_tracked_at_low_noise_and_drifts_at_high_noise():
    """Section 5.6: "ICP does well on its own" below 0.05 m of noise, and not above."""

    def mean_error(sigma):
        errors = []
        for seed in range(2):
            views, T = peaks_views(sigma, seed)
            tracker = Sequential(algorithm_1(1.0, None), "previous").start(seed)
            poses = np.array([tracker.push(v).T_component_camera for v in views])
            errors.append(np.linalg.norm(poses[:, :3, 3] - T[:, :3, 3], axis=1).mean())
        return np.mean(errors)

    assert mean_error(0.02) < 0.04
    assert mean_error(0.08) > 1
