"""Poses of earlier results are adopted as they are, and constrain degenerate registrations."""

from __future__ import annotations

import numpy as np
import pytest

from made_rooms import at, seen
from tofuse.engine.geometry import se3
from tofuse.engine.tracking.given import GivenPoses, StatedPose, StatedPoses

WALK = [at(-0.4 + 0.04 * k, 0.1, 0.02 * k) for k in range(4)]
# A camera that faces one bare wall at close range.
BARE = [at(-0.2 + 0.04 * k, 1.2, 0.0, pitch=0.0) for k in range(3)]
SMALL = np.diag([0.002**2] * 3 + [0.001**2] * 3)


def tracked(path, covariance=None, **scene):
    stated = {
        k: StatedPose("tracked", "", T, component=2, covariance=covariance)
        for k, T in enumerate(path)
    }
    tracker = StatedPoses(stated, GivenPoses()).start(0)
    return [tracker.push(seen(T, k, **scene)) for k, T in enumerate(path)]


def bare(covariance=None):
    return tracked(BARE, covariance, boxes=(), spots=0)


def test_stated_poses_keep_their_component() -> None:
    for step, T in zip(tracked(WALK), WALK, strict=True):
        np.testing.assert_array_equal(step.T_component_camera, T)
        assert step.component == 2


def test_given_poses_start_at_identity() -> None:
    tracker = GivenPoses().start(0)
    steps = [tracker.push(seen(T, k), T) for k, T in enumerate(WALK)]
    for step, T in zip(steps, WALK, strict=True):
        np.testing.assert_allclose(step.T_component_camera, se3.inverse(WALK[0]) @ T, atol=1e-12)


def test_earlier_result_constrains_degenerate_registration() -> None:
    assert len(bare()[1].registration.unobservable) > 0
    found = bare(SMALL)[1].registration
    assert len(found.unobservable) == 0
    np.testing.assert_allclose(found.T_target_source, se3.inverse(BARE[0]) @ BARE[1], atol=1e-12)
    sigma = np.sqrt(np.diag(np.linalg.inv(found.information)))
    assert sigma[:3] == pytest.approx(np.sqrt(2) * 0.002, rel=0.1)


def test_unbounded_earlier_result_adds_no_constraint() -> None:
    unbounded = SMALL.copy()
    unbounded[0, 0] = 4.0
    alone, found = bare()[1].registration, bare(unbounded)[1].registration
    np.testing.assert_array_equal(found.information, alone.information)
    assert len(found.unobservable) == len(alone.unobservable)


def test_frame_without_stated_pose_is_lost() -> None:
    stated = {0: StatedPose("tracked", "", WALK[0]), 1: StatedPose("lost", "too dark")}
    tracker = StatedPoses(stated, GivenPoses()).start(0)
    steps = [tracker.push(seen(WALK[0], k)) for k in range(3)]
    assert [step.status for step in steps] == ["tracked", "lost", "lost"]
    assert steps[1].reason == "too dark"
    assert steps[2].reason == "no pose was given"
